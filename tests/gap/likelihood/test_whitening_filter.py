"""The innovations filter against a dense Gaussian whose covariance is written down directly."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_are

from avtorch.arrays import FloatArray
from avtorch.gap import DeadTime, SensorLag, SensorScale
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import CALM, before_onset
from avtorch.gap.likelihood.steady_kalman import _steady, error_dynamics
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from tests.bars import BAR
from tests.gap.records import BOTH, dense_covariance, errors_of, log_normal_density, log_of, record_of

NOISES = {
    "usual": NoiseModel(),
    "windy": NoiseModel(force_sd=0.15, force_time=2.0),
    "good accelerometer": NoiseModel(accel_sd=0.01, speed_sd=0.1),
    "slow car": NoiseModel(process_sd=0.1, process_time=0.9),
}
WITNESSES = [BOTH, ("accel",), ("speed",)]
_WIDE = 1e3


def _dense(noise: NoiseModel, record: Record, errors: FloatArray) -> float:
    """Exact log density, an offset of the speed under a flat prior of height 1 / sqrt(2 pi) in each stretch."""
    total = 0.0
    for first, last in zip(record.starts, [*record.starts[1:], record.rows], strict=True):
        time = np.arange(last - first) * record.dt
        wide = dense_covariance(noise, time, record.channels, offset_sd=_WIDE)
        total += log_normal_density(errors[:, first:last, 0].ravel(), wide)
        total += np.log(_WIDE) if "speed" in record.channels else 0.0
    return total


@pytest.mark.parametrize("channels", WITNESSES)
@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
def test_log_likelihood_is_the_dense_gaussians(noise: NoiseModel, channels: tuple[str, ...], fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    record = record_of(18.0, channels=channels)
    errors = errors_of(noise, record, rng)
    got = float(WhiteningFilter(record, noise).log_likelihood(errors))
    # the filter starts settled instead of knowing nothing of the forces: some 1 nat in the mean, 3 at random
    assert got == pytest.approx(_dense(noise, record, errors), abs=40.0)


@pytest.mark.parametrize("channels", WITNESSES)
@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
def test_beyond_the_start_the_likelihood_is_exact(
    noise: NoiseModel, channels: tuple[str, ...], fresh_seed: int
) -> None:
    rng = np.random.default_rng(fresh_seed)
    long, short = record_of(24.0, channels=channels), record_of(12.0, channels=channels)
    errors = errors_of(noise, long, rng)
    head = errors[:, : short.rows]
    got = WhiteningFilter(long, noise).log_likelihood(errors) - WhiteningFilter(short, noise).log_likelihood(head)
    assert float(got) == pytest.approx(_dense(noise, long, errors) - _dense(noise, short, head), abs=0.05)


@pytest.mark.statistical
@pytest.mark.parametrize("channels", WITNESSES)
def test_errors_of_the_model_become_white(channels: tuple[str, ...], rotating_seed: int, draws_factor: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    noise = NOISES["windy"]
    record = record_of(300.0 * draws_factor, channels=channels, noise=None)
    e = WhiteningFilter(record, noise)(errors_of(noise, record, rng))[..., 0]
    n, kinds = record.rows, len(channels)
    # standard errors of a mean square and of a lagged product of white noise
    assert (e**2).mean() == pytest.approx(1.0, abs=BAR * np.sqrt(2 / (n * kinds)))
    for lag in (1, 2, 5, 20, 100):
        for i in range(kinds):
            for j in range(kinds):
                assert abs((e[i, lag:] * e[j, :-lag]).mean()) < BAR / np.sqrt(n - lag)
    assert all(abs((e[0] * e[j]).mean()) < BAR / np.sqrt(n) for j in range(1, kinds))


@pytest.mark.statistical
def test_stretches_are_independent_and_each_has_an_offset(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    noise = NOISES["usual"]
    log = log_of(seconds=50.0)
    engaged = (log.time < 20) | (log.time > 28)
    record = Record.of(replace(log, engaged=engaged))
    assert len(record.starts) == 2
    errors = errors_of(noise, record, rng)
    white = WhiteningFilter(record, noise)
    assert float(white.log_likelihood(errors)) == pytest.approx(_dense(noise, record, errors), abs=12.0)
    moved = errors.copy()
    moved[1, : record.starts[1]] += 3.0
    moved[1, record.starts[1] :] -= 2.0
    np.testing.assert_allclose(white(moved), white(errors), atol=1e-9)
    # the second stretch knows nothing of the first
    other = errors.copy()
    other[:, : record.starts[1]] = errors_of(noise, record, rng)[:, : record.starts[1]]
    apart = white(other) - white(errors)
    np.testing.assert_array_equal(apart[:, record.starts[1] :], 0.0)


def test_a_batch_is_its_members(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    record = record_of(12.0)
    white = WhiteningFilter(record, NoiseModel())
    batch = np.stack([errors_of(NoiseModel(), record, rng) for _ in range(3)])
    kept = batch.copy()
    together = white(batch)
    np.testing.assert_array_equal(batch, kept)  # what it is given it leaves alone
    for one, image in zip(batch, together, strict=True):
        np.testing.assert_allclose(white(one), image, rtol=0, atol=1e-9)
    np.testing.assert_allclose(white.log_likelihood(batch), [white.log_likelihood(one) for one in batch])


def test_the_response_is_the_filter_on_the_first_rows(fresh_seed: int) -> None:
    record = record_of(12.0)
    white = WhiteningFilter(record, NoiseModel())
    unit = np.random.default_rng(fresh_seed).standard_normal((2, record.rows))
    unit[1] -= unit[1, 0]
    raw = white.response(unit)
    again = white(unit[..., None])[..., 0]
    # the same but for the offset, which only the call projects out
    image = white.response(np.stack([np.zeros(record.rows), np.ones(record.rows)]))
    part = (raw * image).sum() / (image**2).sum()
    np.testing.assert_allclose(again, raw - part * image, atol=1e-9)


def test_rows_in_groups_pass_the_filter_of_single_rows(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    log = log_of(seconds=16.0, rate_hz=100)
    grouped, single = Record.of(log), Record.of(log, rate_hz=1e9)
    assert (grouped.group, single.group) == (5, 1)
    assert grouped.dt == pytest.approx(0.05)
    assert single.rows == 5 * grouped.rows
    noise = NOISES["usual"]
    errors = errors_of(noise, single, rng)
    together = errors.reshape(2, grouped.rows, 5)
    white = WhiteningFilter(grouped, noise)
    np.testing.assert_allclose(white(together).reshape(2, -1, 1), WhiteningFilter(single, noise)(errors), atol=1e-9)
    exact = float(WhiteningFilter(single, noise).log_likelihood(errors))
    assert float(white.log_likelihood(together)) == pytest.approx(exact, abs=1e-6)


@pytest.mark.statistical
def test_means_of_groups_become_white_at_their_own_interval(rotating_seed: int, draws_factor: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    grouped = Record.of(log_of(seconds=82.0 * draws_factor, rate_hz=100))
    means = errors_of(NOISES["usual"].of_means(5), grouped, rng)
    assert means.shape[-1] == 1
    e = WhiteningFilter(grouped, NOISES["usual"])(means)
    assert (e**2).mean() == pytest.approx(1.0, abs=BAR * np.sqrt(1 / grouped.rows))


# an accelerometer that is late, or shows too much -------------------------------------------------------------------

SENSORS = {
    "late": replace(NOISES["usual"], sensor_lag=0.2),
    "hardly late": replace(NOISES["windy"], sensor_lag=0.004),
    "scaled": replace(NOISES["windy"], sensor_scale=1.2),
    "late and scaled": replace(NOISES["slow car"], sensor_lag=0.4, sensor_scale=0.85),
}


def _process(noise: NoiseModel) -> tuple[FloatArray, FloatArray, FloatArray]:
    """State (error of the speed, p, d, what the sensor shows): its drift, spectrum, and how both channels see it."""
    lag = noise.sensor_lag or np.inf
    drift = np.zeros((4, 4))
    drift[0, 1:3] = 1.0
    drift[1, 1], drift[2, 2] = -1 / noise.process_time, -1 / noise.force_time
    drift[3] = [0.0, 1 / lag, 1 / lag, -1 / lag]
    # the filter's hair of speed noise is part of the model
    spectrum = np.diag(
        [1e-12, 2 * noise.process_sd**2 / noise.process_time, 2 * noise.force_sd**2 / noise.force_time, 0.0]
    )
    felt = [0.0, 0.0, 0.0, 1.0] if noise.sensor_lag else [0.0, 1.0, 1.0, 0.0]
    see = np.array([felt, [1.0, 0.0, 0.0, 0.0]])
    see[0] *= noise.sensor_scale
    return (drift, spectrum, see) if noise.sensor_lag else (drift[:3, :3], spectrum[:3, :3], see[:, :3])


def _over(noise: NoiseModel, dt: float) -> tuple[FloatArray, FloatArray]:
    """Transition and added covariance over `dt`: the integral of exp(drift s) spectrum exp(drift s)' by Gauss nodes,
    on panels that grow from the shortest time there is."""
    drift, spectrum, _ = _process(noise)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    fastest = min(noise.sensor_lag or dt, dt)
    edges = np.concatenate([[0.0], np.linspace(0, dt, int(np.ceil(2 * dt / fastest)) + 1)[1:]])
    total = np.zeros_like(drift)
    for a, b in pairwise(edges):
        for x, w in zip(nodes, weights, strict=True):
            moved = expm(drift * (0.5 * (a + b) + 0.5 * (b - a) * x))
            total += 0.5 * (b - a) * w * moved @ spectrum @ moved.T
    return expm(drift * dt), total


def _drawn(noise: NoiseModel, record: Record, rng: np.random.Generator) -> FloatArray:
    """(channel, counted, 1) of one stretch, begun stationary."""
    move, driven = _over(noise, record.dt)
    drift, spectrum, see = _process(noise)
    root = np.linalg.cholesky(driven + 1e-16 * np.eye(len(driven)))
    start = solve_continuous_lyapunov(drift[1:, 1:], -spectrum[1:, 1:])
    state = np.concatenate(
        [[0.0], np.linalg.cholesky(start + 1e-16 * np.eye(len(start))) @ rng.standard_normal(len(start))]
    )
    shocks = rng.standard_normal((record.rows, len(driven))) @ root.T
    out = np.empty((record.rows, len(driven)))
    for k in range(record.rows):
        out[k] = state
        state = move @ state + shocks[k]
    white = np.array([noise.accel_sd, noise.speed_sd])[:, None] * rng.standard_normal((2, record.rows))
    return (see @ out.T + white)[[BOTH.index(w) for w in record.channels], :, None]


def _settled(noise: NoiseModel, record: Record) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Transition, added covariance, the channels' sight and noise, and the covariance ahead of a reading at rest."""
    move, driven = _over(noise, record.dt)
    see = _process(noise)[2]
    white = np.diag([noise.accel_sd**2, noise.speed_sd**2])
    use = [BOTH.index(w) for w in record.channels]
    keep = slice(0 if 1 in use else 1, None)  # without a speed its error is not seen, and never rests
    move, driven, see = move[keep, keep], driven[keep, keep], see[use][:, keep]
    white = white[np.ix_(use, use)]
    return move, driven, see, white, np.asarray(solve_discrete_are(move.T, see.T, driven, white))


@pytest.mark.parametrize("channels", WITNESSES)
@pytest.mark.parametrize("noise", [*SENSORS.values(), NOISES["windy"]], ids=[*SENSORS, "windy"])
def test_begun_at_rest_the_likelihood_is_the_dense_gaussians(
    noise: NoiseModel, channels: tuple[str, ...], fresh_seed: int
) -> None:
    """To rounding: the covariance of all rows written down from the state's, the offset under its flat prior."""
    rng = np.random.default_rng(fresh_seed)
    record = record_of(12.0, channels=channels)
    errors = _drawn(noise, record, rng)
    move, driven, see, white, ahead = _settled(noise, record)
    count, rows = len(channels), record.rows
    whole = np.empty((rows, count, rows, count))
    state = ahead
    for k in range(rows):
        across = see @ state
        whole[k, :, k] = across @ see.T + white
        for j in range(k + 1, rows):
            across = across @ move.T
            whole[k, :, j] = across @ see.T
            whole[j, :, k] = whole[k, :, j].T
        state = move @ state @ move.T + driven
    covariance = whole.reshape(rows * count, rows * count)
    x = errors[..., 0].T.ravel()
    want = log_normal_density(x, covariance)
    if "speed" in channels:
        unit = np.tile(np.eye(count)[-1], rows)
        solved = np.linalg.solve(covariance, np.stack([x, unit], 1))
        square = unit @ solved[:, 1]
        want += 0.5 * (unit @ solved[:, 0]) ** 2 / square - 0.5 * np.log(square)
    got = float(WhiteningFilter(record, noise).log_likelihood(errors))
    assert got == pytest.approx(want, rel=1e-8)


@pytest.mark.statistical
@pytest.mark.parametrize("channels", WITNESSES)
@pytest.mark.parametrize("noise", SENSORS.values(), ids=SENSORS.keys())
def test_errors_behind_a_sensor_become_white(
    noise: NoiseModel, channels: tuple[str, ...], rotating_seed: int, draws_factor: int
) -> None:
    rng = np.random.default_rng(rotating_seed)
    record = record_of(200.0 * draws_factor, channels=channels, noise=None)
    errors = _drawn(noise, record, rng)
    e = WhiteningFilter(record, noise)(errors)[..., 0]
    n, kinds = record.rows, len(channels)
    # standard errors of a mean square and of a lagged product of white noise
    assert (e**2).mean() == pytest.approx(1.0, abs=BAR * np.sqrt(2 / (n * kinds)))
    for lag in (1, 2, 5, 20, 100):
        for i in range(kinds):
            for j in range(kinds):
                assert abs((e[i, lag:] * e[j, :-lag]).mean()) < BAR / np.sqrt(n - lag)
    assert all(abs((e[0] * e[j]).mean()) < BAR / np.sqrt(n) for j in range(1, kinds))
    if channels == BOTH and noise is not SENSORS["hardly late"]:
        # a filter without the sensor's model gives a far lower likelihood: by some 150 nats for a lag, 600 for a scale
        blind = replace(noise, sensor_lag=0.0, sensor_scale=1.0)
        assert (
            WhiteningFilter(record, noise).log_likelihood(errors)
            > WhiteningFilter(record, blind).log_likelihood(errors) + 40
        )


def test_the_speed_alone_does_not_depend_on_the_accelerometer(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    noise = SENSORS["late and scaled"]
    record = record_of(12.0, channels=("speed",))
    errors = _drawn(noise, record, rng)
    blind = replace(noise, sensor_lag=0.0, sensor_scale=1.0)
    seen, plain = (float(WhiteningFilter(record, n).log_likelihood(errors)) for n in (noise, blind))
    assert seen == pytest.approx(plain, abs=1e-6)


@pytest.mark.parametrize("noise", [NOISES.values(), SENSORS.values()], ids=["plain", "late"])
@pytest.mark.parametrize("channels", WITNESSES)
def test_filters_designed_together_are_each_alone(noise: list[NoiseModel], channels: tuple[str, ...]) -> None:
    record = record_of(12.0, channels=channels)
    noises = [n for n in noise if n is not SENSORS["scaled"]]  # of one kind in a batch, as of one candidate
    for white, own in zip(WhiteningFilter.each(record, noises), noises, strict=True):
        alone = WhiteningFilter(record, own)
        assert white.noise is own
        assert white.constant_of(coarse=False) == pytest.approx(alone.constant_of(coarse=False), rel=1e-12)
        errors = np.random.default_rng(0).standard_normal(record.measured.shape)
        np.testing.assert_allclose(white(errors), alone(errors), rtol=0, atol=1e-9)


@pytest.mark.parametrize("rate_hz", [20, 60])
@pytest.mark.parametrize("channels", WITNESSES)
def test_each_part_of_a_record_has_its_own_noise(channels: tuple[str, ...], rate_hz: int, fresh_seed: int) -> None:
    """As if the other part did not count, except for the speed's offset, which both determine."""
    record = record_of(30.0, rate_hz=rate_hz, channels=channels)
    noise, row = NoiseModel(), 300
    calm = noise.replaced(process_sd=0.02, accel_sd=0.1)
    errors = np.random.default_rng(fresh_seed).standard_normal((2, *record.measured.shape))
    both = WhiteningFilter(record, noise, ((row, calm),))
    assert WhiteningFilter(record, noise, ((row, noise),)).log_likelihood(errors) == pytest.approx(
        WhiteningFilter(record, noise).log_likelihood(errors), rel=1e-9
    )
    parts = both._filtered(errors)
    np.testing.assert_allclose(
        parts[..., :row, :], WhiteningFilter(record, calm)._filtered(errors)[..., :row, :], atol=1e-9
    )
    np.testing.assert_allclose(
        parts[..., row:, :], WhiteningFilter(record, noise)._filtered(errors)[..., row:, :], atol=1e-9
    )
    assert both.row_likelihoods(errors[0]).sum() == pytest.approx(both.log_likelihood(errors[:1])[0], rel=1e-9)
    drawn = WhiteningFilter.each(record, [noise, calm], [((row, calm),), ((row, noise),)])
    np.testing.assert_allclose(drawn[0](errors), both(errors), rtol=0, atol=1e-9)


def test_before_an_onset_the_sensor_reads_plainly_and_no_gust_blows() -> None:
    late = NoiseModel(sensor_lag=0.3, force_sd=0.2)
    assert before_onset(late) == ()
    assert before_onset(NoiseModel(force_sd=0.2), onset=50) == ()
    plain = late.replaced(sensor_lag=0.0)
    assert before_onset(late, onset=50) == ((50, plain),)
    assert before_onset(late, gust_onset=50) == ((50, late.replaced(force_sd=CALM)),)
    calm = plain.replaced(force_sd=CALM)
    assert before_onset(late, onset=50, gust_onset=50) == ((50, calm),)
    assert before_onset(late, onset=50, gust_onset=80) == ((50, calm), (80, late.replaced(force_sd=CALM)))
    assert before_onset(late, onset=80, gust_onset=50) == ((50, calm), (80, plain))


@pytest.mark.parametrize("dt", [0.001, 0.01, 0.05, 0.1])
@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
def test_motion_in_closed_form_is_van_loans(noise: NoiseModel, dt: float) -> None:
    drift, spectrum, _ = _process(noise)
    n = len(drift)
    both = expm(np.block([[-drift, spectrum], [np.zeros((n, n)), drift.T]]) * dt)
    move, driven = error_dynamics(noise, dt)
    np.testing.assert_allclose(move, both[n:, n:].T, rtol=1e-12, atol=1e-15)
    want = both[n:, n:].T @ both[:n, n:]
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    np.testing.assert_allclose(driven / scale, want / scale, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dt", [0.001, 0.05, 0.1])
@pytest.mark.parametrize("lag", [0.0021, 0.02, 0.2, 0.5])
def test_motion_behind_a_late_sensor_is_the_integral(lag: float, dt: float) -> None:
    noise = replace(NOISES["windy"], sensor_lag=lag)
    move, driven = error_dynamics(noise, dt)
    exact, want = _over(noise, dt)
    np.testing.assert_allclose(move, exact, rtol=1e-10, atol=1e-14)
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    np.testing.assert_allclose(driven / scale, want / scale, rtol=0, atol=1e-8)
    assert np.linalg.eigvalsh(driven / scale).min() > -1e-8


@pytest.mark.parametrize("channels", WITNESSES)
@pytest.mark.parametrize("noise", [*NOISES.values(), *SENSORS.values()], ids=[*NOISES, *SENSORS])
def test_the_covariance_at_rest_solves_the_riccati_equation(noise: NoiseModel, channels: tuple[str, ...]) -> None:
    record = record_of(10.5, channels=channels)
    move, driven, see, white, want = _settled(noise, record)
    got = _steady(move[None], see[None], driven[None], white[None])[0]
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    np.testing.assert_allclose(got / scale, want / scale, rtol=0, atol=1e-9)


def test_the_sensor_is_the_candidates() -> None:
    noise = NOISES["windy"]
    assert noise.seen_through((DeadTime,), {"T_L": 0.3, "K_L": 1.0, "dead_time.delay_s": 0.2}) == noise
    late = noise.seen_through((SensorLag, SensorScale), {"sensor_lag.lag_s": 0.2, "sensor_scale.scale": 1.1})
    assert late == replace(noise, sensor_lag=0.2, sensor_scale=1.1)
    # the last candidate's value is forgotten, and no lag is equivalent to one of a millisecond
    assert late.seen_through((), {"T_L": 0.3}) == noise
    assert noise.seen_through((SensorLag,), {"sensor_lag.lag_s": 1e-3}) == noise


def test_means_have_less_white_noise() -> None:
    noise = replace(NOISES["usual"], accel_sd=0.06, speed_sd=0.03, sensor_lag=0.1)
    assert noise.of_means(4) == replace(noise, accel_sd=0.03, speed_sd=0.015)
    assert noise.of_means(1) == noise
