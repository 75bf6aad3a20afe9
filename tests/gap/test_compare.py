"""Two drives of one car, and of two."""

import json
from dataclasses import replace

import numpy as np
import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.gap import DeadTime, GapPlant, plant
from avtorch.io import Log
from tests.bars import student
from tests.gap.records import QUIET, log_of

LONG_S, LONG_BLOCKS = 200.0, 19  # blocks of 10 s, behind two in which the drive settles


def _drive(rng: np.random.Generator, *, seconds: float = 120.0, **of: float) -> Log:
    return log_of(plant(**of), seconds=seconds, rng=rng, noise=QUIET)


@pytest.mark.slow
@pytest.mark.statistical
def test_a_slower_car_is_detected_with_its_size(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    before, after = (_drive(rng, seconds=LONG_S, T_L=T_L, K_L=0.9) for T_L in (0.4, 0.56))
    told = avtorch.compare(before, after)
    assert told.changed
    lag = told.car["T_L"].ratio
    assert abs(np.log(lag.mean) - np.log(1.4)) < student(LONG_BLOCKS - 1) * lag.sd / lag.mean
    assert told.simulator == "farther"
    assert "has changed" in told.why
    json.dumps(told.to_dict(), allow_nan=False)


CHANGES = {"dead_time": {"delay": 0.15}, "T_L": {"T_L": 0.56}, "K_L": {"K_L": 0.72}}


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.12])
@pytest.mark.parametrize("what", CHANGES)
def test_a_later_answer_is_not_taken_for_lag_and_gain(what: str, delay: float, rotating_seed: int) -> None:
    """Only the delay, the lag or the gain has changed, of a car that had a delay before or had none."""
    rng = np.random.default_rng(rotating_seed)

    def car(T_L: float = 0.4, K_L: float = 0.9, **more: float) -> GapPlant:
        late = delay + more.get("delay", 0.0)
        return plant([DeadTime(late)] if late else [], T_L=T_L, K_L=K_L)

    drives = (log_of(x, seconds=LONG_S, rng=rng, noise=QUIET) for x in (car(), car(**CHANGES[what])))
    told = avtorch.compare(*drives, effects=[])
    assert told.cause is not None
    assert told.cause.names == (what,)
    if told.changed:  # a delay may show in neither lag nor gain
        assert told.why.startswith("The car has changed: as GLVD without any effect, T_L ")


@pytest.mark.statistical
@pytest.mark.slow
def test_one_car_stays_one_car(rotating_seed: int) -> None:
    """With a delay that the model lacks: what it lacks is spread, and no change."""
    rng = np.random.default_rng(rotating_seed)
    changed = 0
    for _ in range(20):
        car = plant([DeadTime(float(rng.uniform(0, 0.3)))], T_L=float(rng.uniform(0.2, 0.6)), K_L=0.9)
        two = [log_of(car, seconds=70.0, rng=rng) for _ in range(2)]
        changed += avtorch.compare(*two, effects=[]).changed
    # 4 in 100: five or more of twenty come in 1 of 1000 runs
    assert changed < 5


@pytest.mark.slow
@pytest.mark.statistical
def test_two_simulators_on_one_drive(rotating_seed: int) -> None:
    log = _drive(np.random.default_rng(rotating_seed), T_L=0.4, K_L=0.9)
    told = avtorch.compare(log, log, baseline=plant(T_L=0.2, K_L=0.8), baseline_after=plant(T_L=0.4, K_L=0.9))
    assert told.p_value == pytest.approx(1.0)
    assert told.car["K_L"].ratio.mean == pytest.approx(1.0)
    assert told.simulator == "closer"
    assert "second simulator is closer" in told.why
    turned = avtorch.compare(log, log, baseline=plant(T_L=0.4, K_L=0.9), baseline_after=plant(T_L=0.2, K_L=0.8))
    assert turned.simulator == "farther"
    alone = avtorch.compare(log, log, baseline=plant(T_L=0.4, K_L=0.9))
    assert alone.why == "Both sides are the same drive and the same simulator: there is nothing to compare."
    # other rows count: no longer one drive
    hand = replace(log, engaged=log.time > 20.0)
    assert "drive" not in avtorch.compare(log, hand, baseline=plant(T_L=0.4, K_L=0.9), effects=[]).why.partition(".")[0]


def test_wrong_input_is_refused() -> None:
    rng = np.random.default_rng(0)
    long = _drive(rng, seconds=60.0)
    with pytest.raises(InputError, match="after: found 4 blocks of 4 s of usable driving, needs 5 or more"):
        avtorch.compare(long, _drive(rng, seconds=18.0))
    with pytest.raises(InputError, match="level"):
        avtorch.compare(long, long, level=0.0)
    with pytest.raises(InputError, match="channels"):
        avtorch.compare(long, log_of(seconds=60.0, channels=("speed",)))
