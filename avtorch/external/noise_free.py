"""A chain of effects beside an output without noise: a hypothesis whose errors have a size that is given.

    log L = -1/2 sum_c |R_c|² / s_c²

with coefficients R (channel, frame, bin) below 10 Hz and the size s (channel,) [m/s²] of what is left: least squares.
There is no recorder but a lateness of the speed, half a step of some integrators. Frames held out say whether an effect
is there: the fit is linearised, so that a fold costs one solution of its normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import EFFECTS
from avtorch.gap.engine.gauss_newton import fit, jacobian, prior_terms, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten

_LATE_S = 0.1  # either way, of the speed against the acceleration: a step of the slowest simulators
_FOLDS = 6


@dataclass(eq=False)
class NoiseFree(Hypothesis):
    """A hypothesis about a simulator's output, whose errors have the size `sd` (channel,) [m/s²] and no colour."""

    sd: FloatArray = field(default_factory=lambda: np.ones(1))

    @property
    def free(self) -> list[str]:
        """Names of the coordinates that a fit moves: lag and gain, the speed's lateness, those of the effects."""
        late = ["speed_delay"] if self.data.channel_count == 2 else []
        return ["T_L", "K_L", *late, *(c.name for e in self.effects for c in EFFECTS[e].coordinates)]

    def limits(self, name: str) -> tuple[float, float]:
        return (-_LATE_S, _LATE_S) if name == "speed_delay" else super().limits(name)

    def copy(self) -> Self:
        other = super().copy()
        other.sd = self.sd
        return other

    def with_sd(self, sd: FloatArray) -> Self:
        """The same hypothesis with errors of another size."""
        other = self.copy()
        other.sd = sd
        return other.evaluate()

    def fitted(self, iterations: int = 8) -> Self:
        """The hypothesis at its best, changed in place."""
        fit(self, iterations)
        return self

    def evaluate(self) -> Self:
        self.predicted = self.response()
        self.residual = self.data.measured - self.predicted
        self.covariance = np.broadcast_to(np.diag(self.sd**2), (self.data.band_count, len(self.sd), len(self.sd)))
        self.log_likelihood = -0.5 * float((whiten(self.data, self.covariance, self.residual) ** 2).sum())
        return self

    @property
    def errors(self) -> FloatArray:
        """Root mean square (channel,) [m/s²] of what is left."""
        return np.sqrt((self.residual**2).sum((1, 2)) / (self.data.frame_count * self.data.frame_rows))

    @property
    def held_out(self) -> float:
        """Root mean square of what is left of frames that the fit did not see, over `sd`, to first order."""
        names, data = self.free, self.data
        by_frame = (data.channel_count, data.frame_count, data.bin_count)
        W = whitened_jacobian(self, jacobian(self, names)).reshape(len(names), *by_frame)
        r = whiten(data, self.covariance, self.residual).reshape(by_frame)
        precision, pull = prior_terms(self, names)
        each = np.einsum("icfk,jcfk->fij", W, W, optimize=True)
        scores = np.einsum("icfk,cfk->fi", W, r, optimize=True)
        fold = np.arange(data.frame_count) % min(_FOLDS, data.frame_count)
        total = 0.0
        for k in range(int(fold.max()) + 1):
            own = fold == k
            A = each[~own].sum(0) + np.diag(precision)
            step = np.linalg.lstsq(A, scores[~own].sum(0) + pull, rcond=None)[0]
            total += float(((r[:, own] - np.tensordot(step, W[:, :, own], 1)) ** 2).sum())
        return float(np.sqrt(total / r.size))
