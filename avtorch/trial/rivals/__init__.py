"""Who else could be asked: one file each, a function from a log to an answer."""

from avtorch.trial.rivals.likelihood_bic import likelihood_bic
from avtorch.trial.rivals.random_guess import random_guess

__all__ = ["likelihood_bic", "random_guess"]
