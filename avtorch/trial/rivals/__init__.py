"""Rival methods, one file each: a function from a log to an answer."""

from avtorch.trial.rivals.black_box import black_box
from avtorch.trial.rivals.likelihood_bic import likelihood_bic
from avtorch.trial.rivals.random_guess import random_guess
from avtorch.trial.rivals.sparse_regression import sparse_regression

__all__ = ["black_box", "likelihood_bic", "random_guess", "sparse_regression"]
