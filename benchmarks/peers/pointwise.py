"""The jerk density without its sums: the case of SGLD on a likelihood without sufficient statistics."""

from __future__ import annotations

from torch import Tensor

from avtorch.inference import JerkPoints, jerk_log_likelihood


class PointwiseDensity:
    """The log density of `JerkPoints`, evaluated row by row also where the whole window is asked for."""

    names = ("T_L", "K_L", "sigma")

    def __init__(self, a: Tensor, u: Tensor, jerk: Tensor) -> None:
        self._rows = (a, u, jerk)
        self._points = JerkPoints(a, u, jerk)

    @property
    def windows(self) -> int:
        return self._points.windows

    @property
    def points(self) -> int:
        return self._points.points

    def constrain(self, z: Tensor) -> Tensor:
        return z.exp()

    def select(self, index: Tensor) -> PointwiseDensity:
        return PointwiseDensity(*(x[index] for x in self._rows))

    def log_prob(self, z: Tensor) -> Tensor:
        return self._points.prior.log_prob(z) + jerk_log_likelihood(*z.exp().unbind(-1), *self._rows)

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        part = jerk_log_likelihood(*z.exp().unbind(-1), *(x[:, index] for x in self._rows))
        return self._points.prior.log_prob(z) + self.points / len(index) * part

    def initial(self) -> Tensor:
        return self._points.initial()
