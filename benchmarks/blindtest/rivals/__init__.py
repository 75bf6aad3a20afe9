"""Rival methods, one file each: a function from a log to an answer."""

from benchmarks.blindtest.rivals.black_box import black_box
from benchmarks.blindtest.rivals.likelihood_bic import likelihood_bic
from benchmarks.blindtest.rivals.random_guess import random_guess
from benchmarks.blindtest.rivals.sparse_regression import sparse_regression

__all__ = ["black_box", "likelihood_bic", "random_guess", "sparse_regression"]
