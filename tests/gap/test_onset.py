"""The moment from which a cause acts."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.blindtest import Car, simulate
from avtorch.blindtest.drives import Recorded
from avtorch.gap import plant
from avtorch.gap.candidate import Candidate, splice
from avtorch.gap.fit import modes
from avtorch.gap.innovations import NoiseModel, Whitener
from avtorch.gap.onset import allowed, averaged, profile, refined, rough
from avtorch.gap.record import Record
from avtorch.io import Log
from tests.gap.records import command_over, log_of

NOISE = NoiseModel(process_sd=0.03, process_time=0.4, force_sd=0.004, accel_sd=0.05, speed_sd=0.02)
CASES = {
    "constant_resistance": ({"resistance_mps2": 0.25}, {"constant_resistance.resistance_mps2": 0.2}),
    "dead_time": ({"delay_s": 0.25}, {"dead_time.delay_s": 0.2}),
    "sensor_bias": ({"bias_mps2": 0.2}, {"sensor_bias.bias_mps2": 0.15}),
    "sensor_scale": ({"scale": 1.25}, {"sensor_scale.scale": 1.15}),
}


@pytest.mark.parametrize("rate_hz", [20, 50])
@pytest.mark.parametrize("name", CASES)
def test_a_known_onset_is_found(name: str, rate_hz: int, rotating_seed: int) -> None:
    """On drives of the reference vehicle, which shares no code with this."""
    rng = np.random.default_rng(rotating_seed)
    at = float(np.round(rng.uniform(25, 50), 1))
    parameters, start = CASES[name]
    command = command_over(np.arange(80 * rate_hz) / rate_hz)
    run = simulate(
        Car(),
        Recorded(command, start_speed=25.0),
        seconds=80.0,
        rate_hz=rate_hz,
        effects={name: parameters},
        onset=at,
        seed=int(rng.integers(2**31)),
    )
    record = Record.of(Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed))
    white = Whitener(record, NOISE)
    candidate = Candidate.named(record, name, plant())
    z = modes(candidate, white, candidate.z_of({"T_L": 0.4, "K_L": 1.0, **start})[None], coarse=True)[0][0]
    onset, gained = rough(white, candidate, z)
    assert gained > 10
    for _ in range(3):
        z = modes(candidate, white, z[None], onset=onset, iterations=6)[0][0]
        onset, tried = refined(white, candidate, z, onset)
    found = float(record.time[record.source[onset]])
    # a cause of this size is worth some 10 nats a second; the command moves every 3.5 s at the latest
    assert abs(found - at) < 3.6
    whole = white.log_likelihood(candidate.errors(modes(candidate, white, z[None])[0], coarse=True))
    assert tried.max() > float(whole[0]) + 10
    assert -np.log(record.rows) <= averaged(tried, record.dt) < 0


@pytest.mark.parametrize("name", ["constant_resistance", "dead_time", "sensor_bias"])
@pytest.mark.parametrize("rate_hz", [20, 100])
def test_a_splice_goes_on_where_the_car_is(name: str, rate_hz: int) -> None:
    record = Record.of(log_of(seconds=30.0, rate_hz=rate_hz))
    candidate = Candidate.named(record, name, plant())
    z = np.stack([candidate.z_of({"T_L": 0.4, "K_L": 1.0, **CASES[name][1]}), np.zeros(candidate.size)])
    onset = 257
    full, spliced = candidate.rollouts(z), candidate.rollouts(z, onset)
    without = np.concatenate([candidate.baseline_rollouts(row[None]) for row in z])
    assert spliced.shape == full.shape
    np.testing.assert_array_equal(spliced[:, :, :onset], without[:, :, :onset])
    np.testing.assert_allclose(spliced[:, 0, onset:], full[:, 0, onset:], atol=1e-12)
    # the speed gains from the onset on what the whole rollout gains, and does not jump there
    speed = spliced[:, 1].reshape(2, -1)
    np.testing.assert_allclose(
        np.diff(spliced[:, 1, onset:].reshape(2, -1)), np.diff(full[:, 1, onset:].reshape(2, -1)), atol=1e-12
    )
    assert np.abs(np.diff(speed)).max() < 2.5 / rate_hz
    np.testing.assert_allclose(spliced[:, 1, onset, 0], without[:, 1, onset, 0], atol=1e-12)
    # neither of its parts is written to
    kept, bare = full.copy(), without.copy()
    splice(record, full, without, onset)
    np.testing.assert_array_equal(full, kept)
    np.testing.assert_array_equal(without, bare)


def test_the_profile_is_the_sum_on_both_sides(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    a, b = rng.standard_normal((2, 50))
    want = [a[:k].sum() + b[k:].sum() for k in range(50)]
    np.testing.assert_allclose(profile(a, b), want, atol=1e-12)


def test_rows_at_the_edges_are_no_onset() -> None:
    assert allowed(1000, 0.05) == slice(80, 920)
    assert allowed(200, 0.05) == slice(50, 150)


def test_not_knowing_the_onset_costs_its_mean(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    rows = 400
    found = -0.5 * ((np.arange(rows) - 211) / 15.0) ** 2 - 100 + 0.01 * rng.standard_normal(rows)
    want = float(np.log(np.exp(found - found.max()).mean()))
    assert averaged(found, 0.05) == pytest.approx(want, abs=1e-9)
    # tried at some of them: straight between
    some = np.full(rows, -np.inf)
    some[150:280:5] = found[150:280:5]
    assert averaged(some, 0.05) == pytest.approx(want, abs=0.05)
    assert averaged(np.where(np.arange(rows) == 211, 0.0, -np.inf), 0.05) == pytest.approx(-np.log(rows))
