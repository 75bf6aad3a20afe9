"""Estimators behind one interface, by the names that `estimate`, the stream and the command line take: SGLD's loop,
importance sampling and the modes alone of the same posteriors, least squares and joint Kalman filters."""

from __future__ import annotations

import inspect
from typing import Any

from avtorch.errors import InputError
from avtorch.inference.estimator import Estimator, WindowedEstimator
from avtorch.inference.estimators.kalman import JointEKF, JointUKF
from avtorch.inference.estimators.other_posteriors import ImportanceSampling, MaximumAPosteriori
from avtorch.inference.estimators.rls import RecursiveLeastSquares
from avtorch.inference.form import Form
from avtorch.inference.sequential import SequentialInference

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

ESTIMATORS: dict[str, type[Estimator]] = {
    "sgld": SequentialInference,
    "importance": ImportanceSampling,
    "map": MaximumAPosteriori,
    "rls": RecursiveLeastSquares,
    "ekf": JointEKF,
    "ukf": JointUKF,
}
"""By name: SGLD over windows, importance sampling and the modes alone of the same posteriors, recursive least squares,
joint extended and unscented Kalman filter.

Example:
    >>> from avtorch.inference.estimators import ESTIMATORS
    >>> list(ESTIMATORS)
    ['sgld', 'importance', 'map', 'rls', 'ekf', 'ukf']
"""

_OF_THE_FORM = ("self", "form", "names", "noise_prior", "vehicles", "options")


def make_estimator(name: str, form: Form, *, vehicles: int = 1, **options: Any) -> Estimator:
    """The estimator called ``name`` for rows of ``form``.

    ``options`` are its own: those of :class:`SequentialInference` for ``sgld`` and ``map``, ``forgetting`` for ``rls``,
    ``drift`` and ``noise`` for ``ekf`` and ``ukf``, and ``actuation_prior``, ``kept`` and ``seed`` for all.

    Raises `InputError` for an unknown name, an option that the estimator does not have, or one out of range.
    """
    made = ESTIMATORS.get(name)
    if made is None:
        raise InputError(f"estimator: {name!r} is none of {', '.join(ESTIMATORS)}")
    known = _options(made)
    for option in options:
        if option not in known:
            raise InputError(f"{option}: the estimator {name!r} has no such option; it has {', '.join(known)}")
    if issubclass(made, WindowedEstimator):
        return made(form, vehicles=vehicles, **options)
    assert issubclass(made, SequentialInference)
    options.setdefault("settings", form.sampler)
    return made(vehicles=vehicles, names=form.names, noise_prior=form.noise_prior, **options)


def _options(made: type) -> list[str]:
    """Keywords of a class and of those it hands its ``options`` on to."""
    named: list[str] = []
    for each in made.__mro__[:-1]:
        if "__init__" in vars(each):
            named += [p for p in inspect.signature(vars(each)["__init__"]).parameters if p not in _OF_THE_FORM]
    return list(dict.fromkeys(named))
