"""Errors of rollouts over horizons, from those of one long rollout.

A rollout begun anew in the middle of a drive starts at what is measured there: of the acceleration at the measured one,
of the speed at the measured one with the actuator where the commands have brought it. What the long rollout was wrong
by at that moment `t0` is then gone: of the speed for good, of the acceleration it would have died away with the lag
anyway. So the errors are `e(t) - e(t0) exp(-(t - t0) / T_L)` and `e(t) - e(t0)`, where `e` is the long one's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

HORIZONS_S = (0.5, 2.0, 10.0)
USUAL = {"accel": None, "speed": 10.0}
"""Horizon by witness that goes without saying: the speed of a whole drive's rollout wanders off whatever the model."""


@dataclass(frozen=True)
class Measure:
    """One way to measure: of a `witness`, over rollouts of `horizon_s` [s]; None: the whole drive's."""

    witness: str
    horizon_s: float | None

    @property
    def name(self) -> str:
        usual = USUAL[self.witness]
        over = "" if self.horizon_s == usual else "_whole" if self.horizon_s is None else f"_{self.horizon_s:g}s"
        return f"rollout_rmse_{self.witness}{over}"

    def of(self, errors: Float, dt: float, lag: float) -> Float:
        """Errors (..., row) of rollouts within a block, from those of a long one (..., row) of this witness.

        `dt` [s] between rows, `lag` [s] of the actuator. Where a horizon does not fit into the block it is as long as
        the block.
        """
        if self.horizon_s is None:
            return errors
        rows, length = errors.shape[-1], max(2, round(self.horizon_s / dt))
        at = np.arange(rows)
        # what is left at the end is a shorter one, or joins the last
        first = np.minimum(at - at % length, max(0, (rows - length // 5) // length * length))
        begun = errors[..., first]
        if self.witness == "accel":
            begun = begun * np.exp(-(at - first) * dt / lag)
        return errors - begun


def measures(witnesses: Iterable[str]) -> tuple[Measure, ...]:
    """All that these witnesses allow: a speed known at the start of a drive says little at its end."""
    return tuple(Measure(w, h) for w in witnesses for h in (*HORIZONS_S, None))
