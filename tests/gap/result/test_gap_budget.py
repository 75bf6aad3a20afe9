"""The budget divides the gap among what was put in, by name and by family; noise that has a colour is no cause."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.gap import BrakeThrottleAsymmetry, ConstantResistance, DeadBand, DeadTime, Effect, GainChange, SensorBias
from avtorch.gap.result.budget import Budget
from avtorch.gap.result.gap_size import shrinkage_of
from avtorch.gap.result.held_out import Scores
from tests.gap.cars import log_of

FEW = ["dead_time", "dead_band", "constant_resistance", "sensor_bias", "sensor_scale", "gust"]
"""With the gust: the noise of `log_of` has a slow force, which is an unknown cause where no gust may be."""


def budget_of(log: avtorch.Log, **more: Any) -> Budget:
    budget = avtorch.diagnose(log, **more).budget
    assert budget is not None
    return budget


def sums_to_one(budget: Budget) -> None:
    shares = [part.share.mean for part in budget.parts]
    assert sum(shares) + budget.unexplained.share.mean == pytest.approx(1.0, abs=1e-9)
    assert shares == sorted(shares, reverse=True)
    for part in budget.parts:
        assert part.name in part.alias_set
        assert part.share.q05 <= part.share.mean <= part.share.q95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "key", "within"),
    [
        # a few per cent of each: 150 s, noise of 0.05 m/s² that lasts 1.5 s
        (ConstantResistance(0.2), "resistance_mps2", 0.05),
        (DeadBand(0.25), "half_width_mps2", 0.06),
        (DeadTime(0.3), "delay_s", 0.06),
        (SensorBias(0.2), "bias_mps2", 0.05),
    ],
    ids=lambda x: getattr(x, "name", None),
)
def test_a_single_cause_is_the_whole_budget(effect: Effect, key: str, within: float, fresh_seed: int) -> None:
    budget = budget_of(log_of([effect], seed=fresh_seed), effects=FEW)
    (part,) = budget.parts
    assert part.name == effect.name
    assert part.parameters[key].mean == pytest.approx(getattr(effect, key), abs=within)
    # a gap of a sixth of the noise: in one drive of 13 the plant's free form takes a part of it
    carried = budget.unexplained.carried
    assert part.share.mean > 0.5
    assert part.share.mean + (0.0 if carried is None else carried.mean) > 0.85
    assert part.onset_s is None
    sums_to_one(budget)


@pytest.mark.slow
def test_parts_and_what_is_unexplained_sum_to_one(fresh_seed: int) -> None:
    log = log_of([DeadTime(0.3), SensorBias(0.2)], seed=fresh_seed)
    budget = budget_of(log, effects=FEW)
    assert {part.name for part in budget.parts} == {"dead_time", "sensor_bias"}
    sums_to_one(budget)
    assert budget.before > budget.left >= 1.0
    assert "dead_time" in str(budget)


def test_without_a_cause_all_is_unexplained() -> None:
    budget = budget_of(log_of(seconds=40.0), effects=["dead_time"])
    sums_to_one(budget)
    assert budget.parts == ()
    assert budget.unexplained.share.mean == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4))
def test_coloured_noise_is_no_cause(number: int, fresh_seed: int) -> None:
    budget = budget_of(log_of(seed=fresh_seed + number), effects=FEW)
    assert budget.parts == ()
    assert "unknown" not in budget.verdict


@pytest.mark.slow
def test_the_same_log_has_the_same_budget(fresh_seed: int) -> None:
    log = log_of([DeadBand(0.25)], seed=fresh_seed, seconds=60.0)
    assert budget_of(log, effects=FEW).to_dict() == budget_of(log, effects=FEW).to_dict()


def test_wrong_arguments_are_refused() -> None:
    log = log_of(seconds=60.0)
    for material in (0.0, 1.0, float(np.nan)):
        with pytest.raises(InputError, match="material"):
            budget_of(log, material=material)


def test_blocks_without_a_frame_have_no_share_in_the_density() -> None:
    """A stop-and-go drive of few frames: resampled blocks need not hold one."""
    each = [Scores(np.full((1, 6), x), np.where(np.arange(6) == 2, -x, 0.0)) for x in (4.0, 1.0, 1.0)]
    blocks = SimpleNamespace(rows=[None] * 6, sizes=np.full(6, 100.0), by_drives=False)
    given = {"steps": each[:2], "floor": each[2], "ceiling": each[2], "frame_rows": np.array([0, 0, 50.0, 0, 0, 0])}
    held = SimpleNamespace(blocks=blocks, data=SimpleNamespace(channels=("speed",)), horizon_s=10.0, **given)
    density = shrinkage_of(cast(Any, held)).by_metric["log_predictive_density"]
    assert (density.before, density.after) == (-0.08, -0.02)
    assert density.closed is not None
    assert density.closed.q05 == density.closed.q95 == 1.0


# by families ---------------------------------------------------------------------------------------------------------
BIAS = 0.3  # [m/s²]
TRIED = ["dead_time", "brake_throttle_asymmetry", "sensor_bias", "gain_change", "gust"]


@pytest.fixture(scope="module")
def of_two() -> Budget:
    """Of a car whose brakes are weak and whose accelerometer is biased: two families."""
    log = log_of([BrakeThrottleAsymmetry(brake_gain_ratio=0.6, brake_lag_ratio=1.0), SensorBias(BIAS)], seed=3)
    return budget_of(log, effects=TRIED)


def test_each_family_has_its_names_and_size(of_two: Budget) -> None:
    present = {family.family: family for family in of_two.families if family.present}
    assert {"force map", "sensor"} <= set(present)
    sensor = present["sensor"]
    assert sensor.names == ("sensor_bias",)
    assert sensor.size_mps2 is not None
    assert sensor.size_mps2.mean == pytest.approx(BIAS, rel=0.2)  # a constant: its root mean square is itself
    assert all(f.takes_off is not None and f.takes_off.mean > 0.1 for f in present.values() if f.family != "chance")


def test_what_is_absent_says_what_could_be_there(of_two: Budget) -> None:
    absent = {family.family: family for family in of_two.families if not family.present}
    time = absent["time"]
    assert time.size_mps2 is None
    assert time.takes_off is None
    # a change of the gain half way shows at a part of what the car does
    assert time.unseen_mps2 is not None
    assert 0 < time.unseen_mps2 < BIAS
    assert time.excited


@pytest.mark.slow
def test_what_was_put_in_is_no_longer_absent() -> None:
    budget = budget_of(log_of([GainChange(0.6, 60.0)], seed=4), effects=TRIED)
    first = budget.families[0]
    assert first.family == "time"
    assert first.present
    assert first.takes_off is not None
    assert first.takes_off.q05 > 0.5
