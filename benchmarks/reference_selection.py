"""The simplest selection that any engine has to beat: held-out forward selection on low-passed acceleration.

No noise model: residuals of rollouts against measured accelerations are low-passed at 1 Hz and squared. Four of five
blocks of 10 s are fitted and the fifth is predicted; an effect enters while its gain over blocks is two standard errors
and 3 % of the error or more, four effects at most. A road's free course is not among the candidates.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import LATENESS, EffectModel
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.budget.robust_fit import RobustFit
from avtorch.gap.budget.score_test import ScoreTest
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import plant
from avtorch.io import Log

BLOCK_S = 10.0
FOLDS = 5
ERRORS, LEAST, MOST = 2.0, 0.03, 4
_FEWEST = 7  # blocks, in short drives
_GAUSSIAN = 1e6  # values that the prior of a block's noise counts as: its size is then the same in all


class LeastSquares(RobustFit):
    """Fits that weigh all blocks alike."""

    def __post_init__(self) -> None:
        super().__post_init__()
        values = self.whitening.lengths * len(self.whitening.taps) * self.whitening.share
        object.__setattr__(self, "prior", _GAUSSIAN * values)
        object.__setattr__(self, "half", 0.5 * _GAUSSIAN * values)


def selected(logs: Sequence[Log]) -> dict[str, dict[str, float]]:
    """Parameters by effect, in the order in which they entered."""
    block_s = min(BLOCK_S, sum(log.seconds for log in logs) / _FEWEST)
    record, base = AnalysisRecord.of(logs, block_s=block_s), plant()
    bare = EffectModel(record, base)
    starts = [bare.coordinates({"T_L": np.array(lag), LATENESS: np.array(0.0)}) for lag in (-2.0, -1.0, 0.0, 1.0)]
    fitting = LeastSquares(NoiseWhitening.band(record, record.measured), FOLDS)
    first = fitting.fit(bare, np.array(starts))
    fitting = LeastSquares(NoiseWhitening.band(record, first.residuals), FOLDS)
    now = fitting.fit(bare, first.z[None])
    held = fitting.hold_out(now)
    least = LEAST * float(held.nats.sum())
    kinds = [kind for kind in EFFECTS.values() if _tried(kind, record)]
    while len(now.model.names) < MOST:
        test, best = ScoreTest.at(fitting, now), None
        for kind in kinds:
            if kind.name in now.model.names:
                continue
            candidate = test.candidate(kind)
            fit = fitting.fit(candidate.model, candidate.starts)
            after = fitting.hold_out(fit)
            gain = held.nats - after.nats
            sure = gain.sum() > ERRORS * gain.std(ddof=1) * np.sqrt(len(gain)) and gain.sum() > least
            if sure and (best is None or after.nats.sum() < best[1].nats.sum()):
                best = (fit, after)
        if best is None:
            break
        now, held = best
    values = {key: float(value.mean()) for key, value in now.model.values(now.z).items()}
    return {
        name: {key.partition(".")[2]: value for key, value in values.items() if key.startswith(f"{name}.")}
        for name in now.model.names
    }


def _tried(kind: type[Effect], record: AnalysisRecord) -> bool:
    if kind.random or issubclass(kind, Integrated) or (kind.needs_speed and not record.has_speed):
        return False
    return kind.place != "sensor" or len(record.channels) == 2
