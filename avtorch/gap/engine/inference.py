"""From drives to the posterior over sets of effects: the engine's whole way, step by step."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from avtorch.gap.engine.average import ModelAverage, average, examined_sets
from avtorch.gap.engine.coordinates import EFFECTS, base_name
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import evaluate_evidence
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.gear_shifts import refined_shift_speeds, shift_speeds
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.outliers import sensor_outliers, without_outliers
from avtorch.gap.engine.priors import ONE_CHANNEL_HZ
from avtorch.gap.engine.recorder import aligned, base_fit
from avtorch.gap.engine.search import Search
from avtorch.gap.simulator.plant import GapPlant

Progress = Callable[[str, int, int], None]


RANDOM = ("gust", "road_grade", "outliers")
"""Causes that chance decides and that no plant of the engine has: they are in the noise's spectrum and tails."""


@dataclass(frozen=True, eq=False)
class Inference:
    """The posterior of a car's drives: `base`, the `search` and its `average`."""

    base: Hypothesis
    search: Search
    average: ModelAverage

    @property
    def data(self) -> DriveData:
        """The drives as they were judged: in phase, without outliers."""
        return self.base.data


def infer(
    data: DriveData,
    *,
    baseline: GapPlant | None = None,
    effects: Collection[str] = (*EFFECTS, *RANDOM),
    most: int | None = None,
    prior: Mapping[str, float] | None = None,
    stop: Callable[[], bool] | None = None,
    progress: Progress | None = None,
) -> Inference:
    """The posterior over sets of `effects` beyond a `baseline` (None: GLVD), at most `most` of them in a set.

    `prior`: weights of causes; `stop()`: ends the search where it returns True; `progress(step, done, of)`.
    """
    told = progress or (lambda *_: None)
    told("recorder", 0, 1)
    base = base_fit(data, baseline)
    later = aligned(base)
    if later is not None:
        data = later
        base = base_fit(data, baseline)
    told("outliers", 0, 1)
    gears = "gear_shift" in effects
    cleaned = cleaned_drives(base, gears=gears)
    if cleaned is not None:
        data = cleaned
        base = base_fit(data, baseline)
    if data.channel_count == 1:
        data = data.below(ONE_CHANNEL_HZ)
        base = base_fit(data, baseline, alone=True)
    base.base = base
    evaluate_evidence(base)
    if gears:
        base.shift_speeds = shift_speeds(base)[0]
        evaluate_evidence(base.evaluate())
    search = Search(base, effects, stop=stop, progress=progress, most=min(most or 4, 4))
    search.run()
    told("average", 0, 1)
    named = [e for e in effects if not e.startswith("~")]
    found = average(examined_sets(search), effects=[*named, *map(base_name, named)], most=most, prior=prior)
    return Inference(search.base, search, found)


def cleaned_drives(base: Hypothesis, *, gears: bool = False) -> DriveData | None:
    """The drives of a fitted base with outliers of the accelerometer replaced; None where there are hardly any. What a
    gear shift does is none, if `gears` may shift."""
    h = base
    if gears:
        speeds, nats = shift_speeds(base)
        if len(speeds) and nats > 6:
            shifting = base.copy()
            shifting.shift_speeds = speeds
            shifting = fit(shifting.with_effect("gear_shift", (0.6, 0.5)), 5, 0.1)
            if shifting.log_likelihood > base.log_likelihood + 10:
                h = refined_shift_speeds(shifting)
    found = sensor_outliers(h)
    if found.nats <= 10 or found.flags.mean() >= 0.2:
        return None
    return base.data.with_accel(without_outliers(base.data, found.errors, found.flags))
