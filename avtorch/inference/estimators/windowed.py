"""What the recursive estimators share: they work on the rows of the excited windows."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from torch import Tensor

from avtorch.inference.belief import Belief, Summary
from avtorch.inference.estimator import Estimator
from avtorch.inference.form import Form, Rows, WindowLikelihood


class WindowedEstimator(Estimator):
    """An estimator that works on the rows of the excited windows.

    `form`: what is measured; the belief has its parameters. Takes the other arguments of :class:`Estimator`.
    """

    def __init__(self, form: Form, **options: Any) -> None:
        super().__init__(form.names, form.noise_prior, **options)
        self.form = form

    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """Take in one window of every vehicle; those that are not excited keep their belief."""
        index = likelihood.excited.nonzero().squeeze(-1)
        if len(index):
            excited = {name: rows[name][index] for name in ("usable", *self.form.columns)}
            found, converged = self._learn({"time": rows["time"], **excited}, index)
            self.belief = self.belief.updated(likelihood.excited, index, found, converged)
        else:
            self.belief = self.belief.unused(likelihood.excited)
        return self.belief

    @abstractmethod
    def _learn(self, rows: Rows, index: Tensor) -> tuple[Summary, Tensor]:
        """The summary of the vehicles ``index`` from their rows, and where it may be used, ``(vehicle,)`` bool."""
