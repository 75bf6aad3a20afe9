"""Two simulators of any kind beside one car: which is nearer, how surely, and by what."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import binom

from avtorch import ExternalSimulator, InputError, compare, compare_simulators
from avtorch.external.compare_simulators import OTHERS, log_root, p_below
from avtorch.external.simulator import DrivenPlant
from avtorch.gap import plant
from avtorch.io import Log
from tests.external.cars import OWN, drive
from tests.external.test_simulator import OdeCar
from tests.gap.records import log_of

FINE = "dead_time=0.12, second_order_actuator.natural_frequency_radps=6.0, second_order_actuator.damping_ratio=0.8"


@pytest.fixture(scope="module")
def both() -> tuple[Log, Log]:
    """A car with a biased accelerometer, and the output of the simulator that has all else."""
    return drive(12, more={"sensor_bias": {"bias_mps2": 0.1}}, seconds=45.0)


@pytest.mark.slow
def test_the_nearer_is_named_by_what_it_has(both: tuple[Log, Log]) -> None:
    """An output beside a plant: the output is nearer, by the effects of its own that the plant has not."""
    car, output = both
    told = compare_simulators(car, "T_L=0.3", ExternalSimulator(output))
    assert told.nearer == "second"
    assert told.p_second > 0.98
    assert told.first.source == "plant"
    assert told.second.source == "output"
    there = {d.name: d for d in told.differences}
    assert set(OWN) <= set(there)
    assert all(there[name].first is None for name in OWN)
    assert there["aerodynamic_drag"].brings_nearer


@pytest.mark.slow
def test_the_factors_of_the_differences_multiply_to_all_of_them(both: tuple[Log, Log]) -> None:
    """Between two plants, which are their own surrogates, that is the ratio of the two errors itself: they differ in
    nothing that the differences do not hold. What is left is a rollout at the car's speed beside one at its own."""
    car, _ = both
    told = compare_simulators(car, "T_L=0.3", FINE)
    assert told.nearer == "second"
    product = np.prod([d.ratio.mean for d in told.differences])
    assert product == pytest.approx(told.ratio.mean, rel=0.02)
    turned = compare_simulators(car, FINE, "T_L=0.3")
    assert turned.nearer == "first"
    assert turned.ratio.mean == pytest.approx(1 / told.ratio.mean)
    assert [d.ratio for d in turned.differences] == [d.ratio for d in told.differences]
    assert [d.first for d in turned.differences] == [d.second for d in told.differences]


@pytest.mark.slow
def test_an_object_and_a_plant_that_are_one_are_not_told_apart(both: tuple[Log, Log]) -> None:
    """A plant, and the same plant as an object that is identified by its output."""
    car, _ = both
    text = "dead_time=0.2, T_L=0.4"
    told = compare_simulators(car, text, ExternalSimulator(DrivenPlant(plant(baseline=text)), name="object"))
    assert told.nearer is None
    assert told.ratio.mean == pytest.approx(1.0, abs=1e-3)  # the object's lag is known to that
    assert told.differences == ()
    assert "cannot tell which simulator is nearer (first: dead_time=0.2, T_L=0.4, second: object)" in told.why


@pytest.mark.slow
def test_an_object_beside_a_plant() -> None:
    """A simulator integrated by SciPy; the car has its lag of 0.35 s and its drag."""
    car = log_of(plant(baseline="aerodynamic_drag=0.0005", T_L=0.35), seconds=60.0, rng=np.random.default_rng(5))
    told = compare_simulators(car, ExternalSimulator(OdeCar), "T_L=0.6, K_L=0.8")
    assert told.nearer == "first"
    assert {d.name for d in told.differences} == {"T_L", "K_L", "aerodynamic_drag"}
    assert pytest.approx(0.35, rel=0.02) == told.first.surrogate.plant.T_L
    answer = told.to_dict()
    json.dumps(answer, allow_nan=False)
    assert answer["schema"] == "avtorch.simulators/1"
    assert answer["first"]["source"] == "simulator"


@pytest.mark.slow
def test_many_small_differences_are_told_together() -> None:
    car = log_of(plant(T_L=0.35), seconds=60.0, rng=np.random.default_rng(5))
    many = ", ".join(
        f"{name}={size}"
        for name, size in {
            "dead_time": 0.1,
            "aerodynamic_drag": 4e-4,
            "constant_resistance": 0.1,
            "dead_band": 0.05,
            "backlash": 0.05,
            "sensor_bias": 0.05,
            "sensor_scale": 1.05,
        }.items()
    )
    told = compare_simulators(car, "T_L=0.35", many)
    assert told.nearer == "first"
    assert len(told.differences) == 7
    together = next(d for d in told.differences if d.name == OTHERS)
    assert len(together.parts) == 2  # of eight: seven effects and T_L
    assert sorted(part for d in told.differences for part in d.parts) == sorted(
        ["T_L", *(x.partition("=")[0].strip() for x in many.split(","))]
    )


def test_only_what_both_cover_is_scored() -> None:
    """Rows that one output does not have count for neither, nor does a channel that one lacks."""
    car, output = log_of(plant(T_L=0.4)), log_of(plant(T_L=0.5), noise=None)
    late = replace(output[slice(0, 800)], accel=None)  # 40 of 60 s
    wrong = car.speed.copy()
    wrong[800:] += 5.0
    scored = [
        compare_simulators(replace(car, speed=speed), ExternalSimulator(late), "T_L=0.3")
        for speed in (car.speed, wrong)
    ]
    assert set(scored[0].errors) == {"rollout_rmse_speed"}
    assert scored[0].errors["rollout_rmse_speed"].first == scored[1].errors["rollout_rmse_speed"].first


@pytest.mark.slow
def test_a_faulty_one_is_told_with_its_time(both: tuple[Log, Log]) -> None:
    class Faulty(OdeCar):
        count = 0

        def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
            self.count += 1
            return (np.nan, 0.0) if self.count > 10 else super().step(accel_cmd, dt)

    with pytest.raises(InputError, match=r"mine: at 0\.2 s of the log step returned \(nan, 0\.0\)"):
        compare_simulators(both[0], "T_L=0.3", ExternalSimulator(Faulty, name="mine"))


@pytest.mark.slow
def test_what_cannot_be_compared_is_refused(both: tuple[Log, Log]) -> None:
    car, output = both
    with pytest.raises(InputError, match="level: found 0"):
        compare_simulators(car, "T_L=0.3", "T_L=0.4", level=0.0)
    with pytest.raises(InputError, match="no channel that both simulators have"):
        compare_simulators(replace(car, accel=None), "T_L=0.3", ExternalSimulator(replace(output, speed=None)))
    with pytest.raises(InputError, match="found 4 blocks of 4 s of usable driving, needs 5 or more"):
        compare_simulators(car[slice(0, 1050)], "T_L=0.3", "T_L=0.4")


@pytest.mark.slow
def test_two_drives_against_one_simulator() -> None:
    """The car before is the simulator; after, it has three quarters of the gain. The simulator's
    errors are those of the plant that it is."""
    rng = np.random.default_rng(6)
    own = "aerodynamic_drag=0.0005"
    one, two = (log_of(plant(baseline=own, T_L=0.35, K_L=gain), seconds=60.0, rng=rng) for gain in (1.0, 0.75))
    told = compare(one, two, baseline=ExternalSimulator(OdeCar), effects=[])
    assert told.changed
    assert told.simulator == "farther"
    gain = told.car["K_L"]
    assert gain.before.q05 < 1.0 < gain.before.q95
    assert gain.after.q05 < 0.75 < gain.after.q95
    as_plant = compare(one, two, baseline=f"{own}, T_L=0.35", effects=[])
    for metric, moved in told.gap.items():
        assert moved.before.mean == pytest.approx(as_plant.gap[metric].before.mean, rel=1e-3)
        assert moved.after.mean == pytest.approx(as_plant.gap[metric].after.mean, rel=1e-3)
    with pytest.raises(InputError, match="needs compare_simulators"):
        compare(one, one, baseline=ExternalSimulator(OdeCar), baseline_after="T_L=0.3")


@pytest.mark.statistical
def test_two_that_are_equally_near_are_told_apart_as_often_as_said(rotating_seed: int) -> None:
    """Errors of both drawn from one law, block by block: at level 0.04 each is `nearer` in 2 of 100 at most.

    A difference of 1 % has to be surpassed besides, so fewer are. 400 pairs; the bar is missed in 1 of 1000 runs.
    """
    rng = np.random.default_rng(rotating_seed)
    blocks, told = 12, 0
    for _ in range(400):
        one, two = rng.chisquare(8, size=(2, blocks))
        ratio = log_root(two) - log_root(one)
        told += p_below(ratio, 0.99) > 0.98 or 1 - p_below(ratio, 1 / 0.99) > 0.98
    assert told <= binom.ppf(0.999, 400, 0.04)


@pytest.mark.statistical
@pytest.mark.slow
def test_gains_as_far_above_as_below_are_not_told_apart(rotating_seed: int) -> None:
    """Whole drives of a car, and two simulators whose gains are off by a tenth either way."""
    rng = np.random.default_rng(rotating_seed)
    compared = partial(compare_simulators, first="T_L=0.4, K_L=1.1", second="T_L=0.4, K_L=0.9")
    told = [compared(log_of(plant(T_L=0.4), seconds=60.0, rng=rng)).nearer for _ in range(40)]
    assert sum(x is not None for x in told) <= binom.ppf(0.999, 40, 0.04)
