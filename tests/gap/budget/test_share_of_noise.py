"""How much of the noise the random effects make that the likelihood names."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from avtorch import Leader, diagnose, simulate
from avtorch.gap import EFFECTS, Outliers, plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.flexible_regression import left_over
from avtorch.gap.budget.forward_selection import baseline_noise
from avtorch.gap.budget.selection_step import Selection, Step
from avtorch.gap.budget.share_of_noise import share_of_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from tests.gap.budget.cars import log_of


def winner(noise: NoiseModel, effects: tuple[str, ...] = (), onset: int | None = None, **more: Any) -> Any:
    hypothesis = SimpleNamespace(effects=[EFFECTS[name] for name in effects], record=SimpleNamespace(rows=1000))
    fitted = SimpleNamespace(noise=noise)
    return cast(Any, SimpleNamespace(hypothesis=hypothesis, noise=fitted, gust_onset=onset, tails=None, **more))


@pytest.fixture(scope="module")
def selection() -> Selection:
    fitting, bare = baseline_noise(AnalysisRecord.for_budget([log_of(seconds=60.0)]), plant([]))
    return Selection(fitting, (Step(bare, fitting.hold_out(bare)),))


def test_a_force_is_compared_with_what_the_selection_leaves(selection: Selection) -> None:
    counts = selection.fitting.whitening.record.counts
    left = float(np.std(left_over(selection.fitting, selection.last.fit).mean(0)[counts]))
    whole = share_of_noise(EFFECTS["gust"], winner(NoiseModel(force_sd=0.5 * left)), selection)
    late = share_of_noise(EFFECTS["gust"], winner(NoiseModel(force_sd=0.5 * left), onset=600), selection)
    assert (whole, late) == (pytest.approx(0.25), pytest.approx(0.1))
    assert share_of_noise(EFFECTS["gust"], winner(NoiseModel(force_sd=3 * left)), selection) == 1.0


def test_a_force_beside_other_parts_is_none_that_is_left(selection: Selection) -> None:
    assert share_of_noise(EFFECTS["gust"], winner(NoiseModel(), ("dead_time",)), selection) is None


def test_lost_messages_have_none(selection: Selection) -> None:
    assert share_of_noise(EFFECTS["command_hold"], winner(NoiseModel()), selection) is None


@pytest.mark.slow
def test_outliers_have_their_share_of_the_readings_errors(fresh_seed: int) -> None:
    """A sensor's noise of 0.05 m/s², 2 % of whose readings are off by 8 times that."""
    drive = simulate(Leader.default(start=60.0, duration=100.0, dt=0.02), plant=plant([], sigma=0.05)).log()
    rng = np.random.default_rng(fresh_seed)
    assert drive.accel is not None
    assert drive.speed is not None
    white, hit = rng.normal(0.0, 0.05, drive.rows), rng.random(drive.rows) < 0.02
    far = np.where(hit, rng.normal(0.0, 0.4, drive.rows), 0.0)
    log = replace(drive, accel=drive.accel + white + far, speed=drive.speed + rng.normal(0.0, 0.01, drive.rows))
    found = diagnose(log, effects=["outliers", "sensor_bias"], pairs=False, posterior="laplace")
    assert found.verdict.names == ("outliers",)
    assert found.budget is not None
    (part,) = found.budget.chance
    # white jerk of 0.05 m/s³ through a lag of 0.3 s
    others = 0.05**2 + 0.05**2 * 0.3 / 2
    assert part.share_of_noise == pytest.approx(float(np.mean(far**2) / (np.mean(far**2) + others)), abs=0.1)


def test_outliers_are_the_law_of_the_effect() -> None:
    noise, tails = NoiseModel(0.03, force_sd=0.04, accel_sd=0.05), SimpleNamespace(fraction=0.01, scale=10.0)
    one = winner(noise)
    one.tails = tails
    share = share_of_noise(Outliers, one, cast(Any, None))
    assert share == pytest.approx(0.0025 / (0.0025 + 0.0025 + 0.0009 + 0.0016))
