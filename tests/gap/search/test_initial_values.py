"""Where a search begins, and from where it tries again."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.blindtest import Car, simulate
from avtorch.blindtest import DrivePlan as BlindDrive
from avtorch.blindtest.drives import Manoeuvre
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.search.fitted_model import first_noise
from avtorch.gap.search.initial_values import lag_delay_starts, one_at_a_time, start_points
from avtorch.gap.search.search import Search
from avtorch.gap.simulator.plant import plant
from avtorch.io import Log
from tests.gap.records import log_of


def _values(hypothesis: Hypothesis, places: np.ndarray) -> dict[str, np.ndarray]:
    return {key: value.numpy() for key, value in hypothesis.values(places).items()}


def test_dead_time_is_traded_for_lag() -> None:
    hypothesis = Hypothesis.named(Record.of(log_of(seconds=30.0)), "dead_time", plant())
    z = hypothesis.z_of({"T_L": 0.3, "K_L": 0.9, "dead_time.delay_s": 0.05})
    told = _values(hypothesis, lag_delay_starts(hypothesis, z))
    np.testing.assert_allclose(told["T_L"] + told["dead_time.delay_s"], 0.35, rtol=0, atol=1e-9)
    np.testing.assert_allclose(told["K_L"], 0.9)
    assert told["dead_time.delay_s"].min() > 0
    assert told["dead_time.delay_s"].max() > 0.15
    bias = Hypothesis.named(hypothesis.record, "sensor_bias", plant())
    assert lag_delay_starts(bias, bias.z_of({})).shape == (0, bias.size)


def test_one_parameter_moves_at_a_time() -> None:
    hypothesis = Hypothesis.named(Record.of(log_of(seconds=30.0)), "saturation", plant())
    z = hypothesis.z_of({"T_L": 0.3, "K_L": 0.9})
    places = one_at_a_time(hypothesis, z)
    assert ((places != z).sum(1) <= 1).all()
    assert len(start_points(hypothesis, {"T_L": 0.3, "K_L": 0.9})) == 42  # every limit above with every one below


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("manoeuvre", ["stop_and_go", "cruise"])
def test_a_delay_is_found_from_either_side_of_its_valley(manoeuvre: Manoeuvre, rotating_seed: int) -> None:
    """In steps of the command the likelihood has a kink at every row, and a fit would stop at the first of them."""
    apart = []
    for seed in np.random.default_rng(rotating_seed).integers(2**31, size=3):
        pilot = BlindDrive(manoeuvre, 120.0, 40, int(seed)).pilot()
        car = Car(T_L=0.36, process_sd=0.05, accel_sd=0.07, speed_sd=0.05)
        effects = {"dead_time": {"delay_s": 0.46}}
        run = simulate(car, pilot, seconds=120.0, rate_hz=40, effects=effects, seed=int(seed))
        log = Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)
        record = Record.of(log)
        hypothesis = Hypothesis.named(record, "dead_time", plant())
        found = [
            Search([log], plant()).fits.settled(
                hypothesis, hypothesis.z_of({"T_L": 0.82 - d, "K_L": 1.0, "dead_time.delay_s": d}), first_noise(record)
            )
            for d in (0.38, 0.46, 0.54)
        ]
        apart.append(np.ptp([f.log_evidence for f in found]))
    # places half a row apart may be as likely as each other; one drive in fifty still ends on another hill
    assert sorted(apart)[1] < 0.7
