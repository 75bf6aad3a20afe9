"""What is set makes the repaired plant string stable, by the exact verdicts where these apply."""

import tracemalloc

import numpy as np
import pytest
import torch

from avtorch.decision import Setting
from avtorch.decision.grid import Grid
from avtorch.errors import InputError
from avtorch.gap import Backlash, DeadTime, SensorLag, plant
from avtorch.remedy import what_to_set
from avtorch.vehicle.stability import p_string_stable

DRAWS = 64


def _belief(seed: int, T: float, K: float, **more: float) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = {"T_L": T, "K_L": K} | {k.replace("__", "."): v for k, v in more.items()}
    return {k: v * np.exp(0.04 * rng.normal(size=DRAWS)) for k, v in values.items()}


def test_a_calm_car_needs_nothing() -> None:
    told = what_to_set(plant(T_L=0.3, K_L=1.0), _belief(1, 0.3, 1.0))
    assert told.strategies == ()
    assert told.sufficient
    assert (told.p_now, told.p_assumed, told.peak_now) == (1.0, 1.0, 1.0)
    assert told.why.startswith("Nothing to set")


def test_a_weak_actuator_as_the_exact_verdict_has_it(fresh_seed: int) -> None:
    belief = _belief(fresh_seed, 1.5, 0.5)
    told = what_to_set(plant(T_L=1.5, K_L=0.5), belief)
    T, K = (torch.as_tensor(belief[name]) for name in ("T_L", "K_L"))
    assert told.p_now == pytest.approx(
        float(p_string_stable(T, K, told.in_force.time_gap, told.in_force.gains)), abs=0.05
    )
    assert told.sufficient
    T_e, K_e = told.set.effective(T, K)
    assert float(p_string_stable(T_e[0], K_e[0], told.set.time_gap, told.set.gains)) >= 0.9
    assert told.clipped <= 0.05


@pytest.mark.slow
def test_a_dead_time_is_not_a_lag(fresh_seed: int) -> None:
    belief = _belief(fresh_seed, 0.3, 1.0, dead_time__delay_s=0.4)
    told = what_to_set(plant([DeadTime(0.4)], T_L=0.3, K_L=1.0), belief)
    assert told.p_assumed == 1.0
    assert told.p_now < 0.05
    # some 1.75 in the specification, at the mean
    assert 1.5 < told.peak_now < 2.2
    assert told.sufficient
    T, K, theta = (torch.as_tensor(belief[name]) for name in ("T_L", "K_L", "dead_time.delay_s"))
    if 1 not in told.strategies:
        assert float(p_string_stable(T, K, told.set.time_gap, told.set.gains, dead_time=theta)) >= 0.9
    assert told.peak_then == pytest.approx(1.0, abs=1e-3)
    # the whole answer consists of plain numbers
    assert told.to_dict()["p_string_stable"]["then"] == told.p_then


def test_commands_that_would_be_clipped_count() -> None:
    belief = _belief(3, 1.5, 0.5)
    only_lower = Grid(allowed=frozenset({1}))
    free = what_to_set(plant(T_L=1.5, K_L=0.5), belief, grid=only_lower)
    rough = what_to_set(plant(T_L=1.5, K_L=0.5), belief, grid=only_lower, commands=np.linspace(-5.5, 3.5, 200))
    assert free.sufficient
    assert free.set.amplification() > rough.set.amplification()
    assert rough.clipped <= 0.05


def test_a_late_sensor_and_notes_of_what_bends() -> None:
    late = what_to_set(plant([SensorLag(0.5)], T_L=0.3, K_L=1.0), _belief(4, 0.3, 1.0, sensor_lag__lag_s=0.5))
    assert late.notes == ()
    play = what_to_set(plant([Backlash(0.05)], T_L=0.3, K_L=1.0), _belief(4, 0.3, 1.0), in_force=Setting(scenarios=1))
    assert "backlash" in play.notes[0]


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(InputError, match="required"):
        what_to_set(plant(), _belief(1, 0.3, 1.0), required=1.5)


def test_commands_of_an_hour_cost_no_more_memory_than_their_own(fresh_seed: int) -> None:
    """Thousands of settings are counted on them one by one: all at once took 3 GB."""
    commands = np.random.default_rng(fresh_seed).normal(0.0, 2.0, 144_000)
    tracemalloc.start()
    told = what_to_set(plant(T_L=1.5, K_L=0.5), _belief(fresh_seed, 1.5, 0.5), commands=commands)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * commands.nbytes
    sent = float(told.set.amplification()[0]) * commands
    assert told.clipped == pytest.approx(np.mean((sent < -6.0) | (sent > 4.0)), abs=1e-9)
