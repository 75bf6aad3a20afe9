"""Estimators behind one interface: SGLD's loop, importance sampling and the modes alone of the same posteriors, least
squares and joint Kalman filters."""

from avtorch.inference.estimator import Estimator
from avtorch.inference.estimators.choose import ESTIMATORS, make_estimator
from avtorch.inference.estimators.kalman import JointEKF, JointUKF
from avtorch.inference.estimators.other_posteriors import ImportanceSampling, MaximumAPosteriori
from avtorch.inference.estimators.rls import RecursiveLeastSquares

__all__ = [
    "ESTIMATORS",
    "Estimator",
    "ImportanceSampling",
    "JointEKF",
    "JointUKF",
    "MaximumAPosteriori",
    "RecursiveLeastSquares",
    "make_estimator",
]
