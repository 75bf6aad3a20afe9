"""The moment from which a cause acts."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.blindtest import Car, simulate
from avtorch.blindtest.drives import Recorded
from avtorch.gap import DeadTime, SensorBias, plant
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish, grade_marginal, modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.onset import allowed, onset_evidence, onset_profile, refined_onset, rough_onset
from avtorch.io import Log
from tests.gap.records import command_over, log_of

NOISE = NoiseModel(process_sd=0.03, process_time=0.4, force_sd=0.004, accel_sd=0.05, speed_sd=0.02)
CASES = {
    "constant_resistance": ({"resistance_mps2": 0.25}, {"constant_resistance.resistance_mps2": 0.2}),
    "dead_time": ({"delay_s": 0.25}, {"dead_time.delay_s": 0.2}),
    "sensor_bias": ({"bias_mps2": 0.2}, {"sensor_bias.bias_mps2": 0.15}),
    "sensor_scale": ({"scale": 1.25}, {"sensor_scale.scale": 1.15}),
}


@pytest.mark.statistical
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
    white = WhiteningFilter(record, NOISE)
    hypothesis = Hypothesis.named(record, name, plant())
    z = modes(hypothesis, white, hypothesis.z_of({"T_L": 0.4, "K_L": 1.0, **start})[None], coarse=True)[0][0]
    onset, gained = rough_onset(white, hypothesis, z)
    assert gained > 10
    for _ in range(3):
        z = modes(hypothesis, white, z[None], onset=onset, iterations=6)[0][0]
        onset, tried = refined_onset(white, hypothesis, z, onset)
    found = float(record.time[record.source[onset]])
    # a cause of this size is worth some 10 nats a second; the command moves every 3.5 s at the latest
    assert abs(found - at) < 3.6
    whole = white.log_likelihood(hypothesis.errors(modes(hypothesis, white, z[None])[0], coarse=True))
    assert tried.max() > float(whole[0]) + 10
    assert -np.log(record.rows) <= onset_evidence(tried, record.dt) < 0


CAUSES = {
    "dead_time": ({"delay_s": 0.3}, {}),
    "sensor_lag": ({"lag_s": 1.0}, {}),
    "sensor_scale": ({"scale": 1.2}, {}),
    "rate_limit": ({"jerk_max_mps3": 1.0}, {}),
    "constant_resistance": ({"resistance_mps2": 0.2}, {}),
    "backlash": ({"half_width_mps2": 0.15}, {}),
    "second_order_actuator": (
        {"natural_frequency_radps": 2.0, "damping_ratio": 0.5},
        {"inverse_frequency_s": 0.5, "lag_ratio": 0.5 / 0.4},
    ),
}


@pytest.mark.parametrize("name", CAUSES)
def test_what_sets_in_is_what_the_reference_vehicle_does(name: str) -> None:
    """A car of its own code, without noise: also the seconds after the onset agree."""
    rate = 100
    parameters, other = CAUSES[name]
    command = command_over(np.arange(60 * rate) / rate)
    car = Car(T_L=0.4, K_L=1.0, process_sd=0.0, accel_sd=1e-9, speed_sd=1e-9)
    pilot = Recorded(command, start_speed=25.0)
    run = simulate(car, pilot, seconds=60.0, rate_hz=rate, effects={name: parameters}, onset=30.0)
    record = Record.of(Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed))
    hypothesis = Hypothesis.named(record, name, plant())
    told = {f"{name}.{key}": value for key, value in (other or parameters).items()}
    z = hypothesis.z_of({"T_L": 0.4, "K_L": 1.0, **told})[None]
    time = record.time[record.source]
    onset = int(np.searchsorted(time, 30.0 - 1e-6))
    errors = hypothesis.errors(z, onset)[0]
    whole = hypothesis.errors(z)[0]
    first = (time >= 30.0) & (time < 34.0)
    # the message of the very row that it sets in with is read by the one car before and by the other after; a row of
    # 10 ms at some m/s³, or a force that is there a row late
    assert np.sqrt((errors[0][first] ** 2).mean()) < 0.015
    assert np.sqrt((errors[0][time > 40] ** 2).mean()) < 2e-3
    assert np.sqrt((errors[0][time < 30] ** 2).mean()) < 2e-3
    assert np.abs(np.diff(errors[1][first].ravel())).max() < 2e-3
    assert np.sqrt((whole[0][time < 30] ** 2).mean()) > 0.02


def test_before_it_sets_in_and_in_other_drives() -> None:
    logs = [log_of(seconds=20.0), log_of(seconds=30.0), log_of(seconds=20.0)]
    record = Record.of(logs)
    hypothesis = Hypothesis.named(record, "sensor_bias", plant())
    z = hypothesis.z_of({"T_L": 0.4, "K_L": 1.0, "sensor_bias.bias_mps2": 0.3})[None]
    without, full = hypothesis.baseline_rollouts(z)[0, 0], hypothesis.rollouts(z)[0, 0]
    for row in (0, 100, 360, 600, 900, 1200):
        late = hypothesis.rollouts(z, row)[0, 0]
        np.testing.assert_allclose(late[:row], without[:row], atol=1e-12)
        np.testing.assert_allclose(late[row:], full[row:], atol=1e-9)


def test_a_baseline_of_effects_keeps_what_it_has_in_mind() -> None:
    record = Record.of(log_of(seconds=30.0))
    hypothesis = Hypothesis(record, (SensorBias,), plant([DeadTime(0.2)]))
    z = hypothesis.z_of({"T_L": 0.4, "K_L": 1.0, "sensor_bias.bias_mps2": 0.0})[None]
    np.testing.assert_allclose(hypothesis.rollouts(z, 300), hypothesis.baseline_rollouts(z), atol=1e-9)


@pytest.mark.parametrize("name", ["speed_dependent_lag", "speed_dependent_gain", "second_order_actuator"])
def test_parameters_of_an_onset_stay_fixed_without_one(name: str) -> None:
    hypothesis = Hypothesis.named(Record.of(log_of(seconds=30.0)), name, plant())
    rests = np.array([c.parameter.of_onset for c in hypothesis.coordinates])
    assert rests.sum() == 1
    z = np.full(hypothesis.size, 0.3)
    moved = np.stack([z, np.where(rests, 1.5, z)])
    np.testing.assert_array_equal(*hypothesis.rollouts(moved))
    late = hypothesis.rollouts(moved, 300)
    np.testing.assert_array_equal(late[0, :, :300], late[1, :, :300])
    assert np.abs(late[0, 0, 300:] - late[1, 0, 300:]).max() > 0.01


def _slope_that_sets_in(rng: np.random.Generator) -> tuple[float, float, FloatArray]:
    """Error of the onset [s], what it gained [nats], and how the cut images' gains compare with the exact ones."""
    effects = {"road_grade": {"grade_rms": 0.03, "length_m": 120.0}}
    command = command_over(np.arange(120 * 20) / 20)
    pilot, seed = Recorded(command, start_speed=25.0), int(rng.integers(2**31))
    run = simulate(Car(), pilot, seconds=120.0, rate_hz=20, effects=effects, onset=60.0, seed=seed)
    record = Record.of(Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed))
    white = WhiteningFilter(record, NOISE)
    hypothesis = Hypothesis.named(record, "road_grade", plant())
    z = modes(hypothesis, white, hypothesis.z_of({"T_L": 0.4, "K_L": 1.0})[None])[0][0]
    row, gain = rough_onset(white, hypothesis, z)
    row = refined_onset(white, hypothesis, z, row)[0]
    rows = [row - 100, row, row + 100]
    exact = [finish(hypothesis, white, z, int(k)).log_joint for k in rows]
    slope = grade_marginal(white, hypothesis, None, coarse=False)
    full = white(hypothesis.errors(z[None])[0])[..., 0]
    silent = white(record.measured - hypothesis.baseline_rollouts(z[None])[0])[..., 0]
    cut = onset_profile(-0.5 * (silent**2).sum(0), -0.5 * (full**2).sum(0))[rows] + slope.from_rows(full, rows)
    return float(record.time[record.source[row]]) - 60.0, gain, np.diff(cut) / np.diff(exact)


@pytest.mark.statistical
@pytest.mark.slow
def test_a_slopes_onset_is_found_though_it_is_flat_before(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    late, gains, ratios = zip(*(_slope_that_sets_in(rng) for _ in range(7)), strict=True)
    assert min(gains) > 3  # the prior of some knots
    # hills of 120 m at 25 m/s: most begin within a level stretch of half their length. About one road in twenty is
    # level for longer, so that four of seven are once in three thousand runs
    assert np.median(np.abs(late)) < 6.0
    # cut off at the onset, the image of a coefficient is nearly what it is when it acts from there on: what is lost is
    # the step that the slope begins with, a sixth of either gain (standard deviation), so a twentieth in the median
    assert np.median(np.concatenate(ratios)) == pytest.approx(1.0, abs=0.2)


def test_the_profile_is_the_sum_on_both_sides(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    a, b = rng.standard_normal((2, 50))
    want = [a[:k].sum() + b[k:].sum() for k in range(50)]
    np.testing.assert_allclose(onset_profile(a, b), want, atol=1e-12)


def test_rows_at_the_edges_are_no_onset() -> None:
    assert allowed(1000, 0.05) == slice(80, 920)
    assert allowed(200, 0.05) == slice(50, 150)


def test_not_knowing_the_onset_costs_its_mean(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    rows = 400
    found = -0.5 * ((np.arange(rows) - 211) / 15.0) ** 2 - 100 + 0.01 * rng.standard_normal(rows)
    want = float(np.log(np.exp(found - found.max()).mean()))
    assert onset_evidence(found, 0.05) == pytest.approx(want, abs=1e-9)
    # tried at some of them: straight between
    some = np.full(rows, -np.inf)
    some[150:280:5] = found[150:280:5]
    assert onset_evidence(some, 0.05) == pytest.approx(want, abs=0.05)
    assert onset_evidence(np.where(np.arange(rows) == 211, 0.0, -np.inf), 0.05) == pytest.approx(-np.log(rows))
