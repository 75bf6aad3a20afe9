"""Two drives of one car, and of two."""

import json

import numpy as np
import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.gap import DeadTime, plant
from avtorch.io import Log
from tests.gap.records import QUIET, log_of


def _drive(rng: np.random.Generator, *, seconds: float = 120.0, **of: float) -> Log:
    return log_of(plant(**of), seconds=seconds, rng=rng, noise=QUIET)


def test_a_slower_car_is_told_and_by_how_much(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    told = avtorch.compare(_drive(rng, T_L=0.4, K_L=0.9), _drive(rng, T_L=0.56, K_L=0.9))
    assert told.changed
    lag = told.car["T_L"].ratio
    # five standard deviations, told from ten blocks a side
    assert abs(np.log(lag.mean) - np.log(1.4)) < 5 * max(lag.sd / lag.mean, 0.02)
    assert told.simulator == "farther"
    assert "has changed" in told.why
    json.dumps(told.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_one_car_stays_one_car(rotating_seed: int) -> None:
    """With a delay that the model lacks: what it lacks is spread, and no change."""
    rng = np.random.default_rng(rotating_seed)
    changed = 0
    for _ in range(20):
        car = plant([DeadTime(float(rng.uniform(0, 0.3)))], T_L=float(rng.uniform(0.2, 0.6)), K_L=0.9)
        changed += avtorch.compare(*(log_of(car, seconds=70.0, rng=rng) for _ in range(2))).changed
    # 4 in 100: five or more of twenty come in 1 of 1000 runs
    assert changed < 5


def test_two_simulators_on_one_drive(rotating_seed: int) -> None:
    log = _drive(np.random.default_rng(rotating_seed), T_L=0.4, K_L=0.9)
    told = avtorch.compare(log, log, baseline=plant(T_L=0.2, K_L=0.8), baseline_after=plant(T_L=0.4, K_L=0.9))
    assert told.p_value == pytest.approx(1.0)
    assert told.car["K_L"].ratio.mean == pytest.approx(1.0)
    assert told.simulator == "closer"
    assert "second simulator is closer" in told.why
    turned = avtorch.compare(log, log, baseline=plant(T_L=0.4, K_L=0.9), baseline_after=plant(T_L=0.2, K_L=0.8))
    assert turned.simulator == "farther"


def test_wrong_input_is_told() -> None:
    rng = np.random.default_rng(0)
    long = _drive(rng, seconds=60.0)
    with pytest.raises(InputError, match="after: 3 blocks"):
        avtorch.compare(long, _drive(rng, seconds=36.0))
    with pytest.raises(InputError, match="level"):
        avtorch.compare(long, long, level=0.0)
    with pytest.raises(InputError, match="witnesses"):
        avtorch.compare(long, log_of(seconds=60.0, witnesses=("speed",)))
