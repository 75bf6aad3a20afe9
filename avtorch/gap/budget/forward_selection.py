"""Which effects, and how many: forward, with exchange and removal, by the blocks that were held out.

An effect enters if the blocks that were held out agree on it as surely as one effect by itself would have to
(`held_out_evidence`): while several are missing, each hides the others, and none would pass a stricter test. Of the
effects that explain the same, as far as the blocks can tell, the simplest is added, and the others are its aliases; so
is one that explains most of the same with far fewer parameters. Once one has entered, each of those before it has to
hold its place without it. Then each may be exchanged for another (`exchange`), and has to hold its place under the
noise of what all of them leave (`own_noise`). Which of them are likely enough to be named is decided at the end, once
the gap is known (`likely_parts`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import LATENESS, EffectModel
from avtorch.gap.budget.entry import observable
from avtorch.gap.budget.exchange import exchanged, taken_over
from avtorch.gap.budget.flexible_regression import has_places, left_over
from avtorch.gap.budget.next_step import next_step
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.budget.own_noise import judged, own_noise
from avtorch.gap.budget.redundancy import without_the_redundant
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Selection, Step, one_by_one
from avtorch.gap.search.checkpoint import Checkpoint
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant

MOST_PARTS = 8
"""Effects that a selection may hold. On no recording or simulated drive tried do as many stay."""
_ROUNDS = 12  # of entering, as effects may leave again


def select(
    record: AnalysisRecord,
    base: GapPlant,
    kinds: Sequence[type[Effect]],
    *,
    begun: Selection | None = None,
    most: int = MOST_PARTS,
    progress: Callable[[str, int, int], None] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Selection:
    """The effects of `kinds` that `base` lacks on these drives, or has with other parameters than the car.

    At `most` so many, with every step on the way. `begun`: a selection of the same record, which is continued.
    `checkpoint`: keeps the steps, of the same logs and baseline; those that it has are not made again.
    """
    kinds = observable(kinds, record)
    if begun is None:
        fitting, start = baseline_noise(record, base)
        begun = Selection(fitting, (Step(start, fitting.hold_out(start)),))
    fitting, bare, now = begun.fitting, begun.steps[0], begun.last
    entered = {s.entered: s for s in begun.steps if s.entered is not None}
    settled = None
    for number in range(_ROUNDS):
        if len(now.fit.model.names) >= most:
            break
        chosen = next_step(fitting, now, kinds, progress, f"effect {number + 1}", checkpoint)
        if chosen is None:
            break
        step = taken_over(fitting, chosen, entered, kinds, checkpoint)
        entered[step.fit.model.names[-1]] = step
        now, _ = without_the_redundant(fitting, step, spared=step.entered)
        settled = step.entered if now is chosen else None
    if len(now.fit.model.names) > 1:
        now, others = exchanged(fitting, now, kinds, progress, checkpoint, settled=settled)
        entered |= others
    now, _ = without_the_redundant(fitting, now)
    if not now.fit.model.names:
        return Selection(fitting, (bare,), len(kinds))
    judging = own_noise(now.fit)
    now, evidence = judged(fitting, judging, now.fit)
    aliases = {name: entered[name].aliases for name in now.fit.model.names}
    return Selection(fitting, (bare, *one_by_one(fitting, now, evidence, aliases)), len(kinds), judging)


def baseline_noise(record: AnalysisRecord, base: GapPlant) -> tuple[RobustFit, Fit]:
    """The noise of these drives, and the bare baseline under it."""
    bare = EffectModel(record, base)
    starts = np.array(
        [
            bare.coordinates({"T_L": np.array(lag), LATENESS: np.array(late)})
            for lag in (-2.0, -1.0, 0.0, 1.0)
            for late in (-1.0, 0.0, 1.0)
        ]
    )
    whitening = NoiseWhitening.band(record, record.measured - record.measured[:, record.counts].mean(-1, keepdims=True))
    fit = RobustFit(whitening).fit(bare, starts)
    fit = RobustFit(NoiseWhitening.band(record, fit.residuals)).fit(bare, fit.z[None])
    start = RobustFit(NoiseWhitening.band(record, fit.residuals))
    fitting, settled = _settled(start, fit, starts)
    if not has_places(settled):
        return fitting, settled
    # with the place the noise is smaller in any case, and a road has to show by that noise
    other, along = _settled(start, fit, starts, places=True)
    return (other, along) if _road_shows(other, along) else (fitting, settled)


def _road_shows(fitting: RobustFit, bare: Fit) -> bool:
    """Whether blocks that were held out agree on a force along the road."""
    before = fitting.hold_out(bare)
    for kind in observable(EFFECTS.values(), fitting.whitening.record):
        if not issubclass(kind, Integrated) or kind.name in {e.name for e in bare.model.base.effects}:
            continue
        model = bare.model.with_effect(kind)
        fit = fitting.fit(model, model.coordinates(bare.known)[None])
        if fitting.evidence(before, fitting.hold_out(fit)).of_entry > 0:
            return True
    return False


def _settled(fitting: RobustFit, fit: Fit, starts: FloatArray, *, places: bool = False) -> tuple[RobustFit, Fit]:
    """The noise that a regression leaves over, on the `places` too, and the baseline under it, by turns."""
    for _ in range(3):
        fitting = RobustFit(NoiseWhitening.autoregressive(fit.model.record, left_over(fitting, fit, places=places)))
        fit = fitting.fit(fit.model, np.concatenate([fit.z[None], starts]), iterations=12)
    return fitting, fit
