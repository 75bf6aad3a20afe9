"""The interface of an estimator in a stream of windows."""

from __future__ import annotations

from typing import Any, Protocol

from avtorch.inference.belief import Belief
from avtorch.inference.form import Rows, WindowLikelihood


class Estimator(Protocol):
    """Takes the windows of many vehicles one after another and keeps a belief about them.

    A window that is not excited leaves the belief of its vehicle as it was.

    Example:
        >>> from avtorch.inference import JerkForm
        >>> from avtorch.inference.estimators import Estimator, make_estimator
        >>> filters: list[Estimator] = [make_estimator(name, JerkForm()) for name in ("ekf", "ukf")]
        >>> [f.belief.names for f in filters]
        [('T_L', 'K_L', 'sigma'), ('T_L', 'K_L', 'sigma')]
    """

    @property
    def belief(self) -> Belief:
        """The belief after the last window; before the first, the first prior."""
        ...

    def take(self, rows: Rows, likelihood: WindowLikelihood) -> Belief:
        """Take in one window: its rows, each column ``(vehicle, time)``, and what the form makes of them."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors and names, from which a resumed estimator continues bit for bit."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...
