"""A controller feeds the noise of its sensors back into the command: this must not be taken for a cause.

Means over groups of rows alone would: the noise of a group's first rows moves the command of its last ones, so that
the car seems to act before the command. Where every row passes the filter, this disappears.
"""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.blindtest import Car, simulate
from avtorch.blindtest import DrivePlan as BlindDrive
from avtorch.gap import plant
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish, modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.search import Search
from avtorch.io import Log

CAUSES = {
    "dead_time": ("dead_time.delay_s", (0.02, 0.1)),
    "second_order_actuator": ("second_order_actuator.inverse_frequency_s", (0.03, 0.15)),
}


class _Means(Hypothesis):
    """Uses the groups' means alone."""

    def errors(self, z: FloatArray, onset: int | None = None, *, coarse: bool = False) -> FloatArray:
        return super().errors(z, onset, coarse=coarse).mean(-1, keepdims=True)


def _gains(record: Record, kind: type[Hypothesis], noise: NoiseModel) -> FloatArray:
    """Evidence [nats] of each cause over none, all under one noise."""
    white = WhiteningFilter(record, noise)
    base = {"T_L": 0.4, "K_L": 1.0}

    def evidence(name: str, starts: list[dict[str, float]]) -> float:
        hypothesis = kind.named(record, name, plant())
        found, values = modes(hypothesis, white, np.stack([hypothesis.z_of(s) for s in starts]))
        return finish(hypothesis, white, found[values.argmax()]).log_evidence

    none = evidence("none", [base])
    return np.array([evidence(name, [{**base, key: x} for x in grid]) - none for name, (key, grid) in CAUSES.items()])


@pytest.mark.statistical
@pytest.mark.slow
def test_a_controllers_noise_is_no_lag(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    full, means = [], []
    for _ in range(4):
        car = Car(T_L=float(rng.uniform(0.2, 0.7)), process_sd=0.05, accel_sd=0.1, speed_sd=0.05)
        pilot = BlindDrive("cruise", 60.0, 100, int(rng.integers(2**31))).pilot()
        run = simulate(car, pilot, seconds=60.0, rate_hz=100, seed=int(rng.integers(2**31)))
        log = Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)
        record = Record.of(log)
        assert record.group == 5
        # noise and lag found from several starts: alternated from one, both may rest at a lag of nothing
        noise = Search([log], plant(), effects=[]).run().found[0].white.noise
        full.append(_gains(record, Hypothesis, noise))
        means.append(_gains(record, _Means, noise))
    # twice the gain of a nuisance parameter is chi-squared: 12 nats lie beyond five standard deviations
    assert np.max(full) < 12.0
    assert np.mean(full) < 2.5
    # what this guards against: some 4 nats a minute, and with the length of the drive more and more
    assert np.mean(np.array(means) - np.array(full)) > 0.5
