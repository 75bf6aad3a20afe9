"""Slow forces: spectra and likelihoods by their laws, forces of known size recovered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import lfilter

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX, NEUTRAL
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import evaluate_evidence
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import band_covariance
from avtorch.gap.engine.priors import BAND_RATIO, SLOW_HZ
from avtorch.gap.engine.pulling_lags import PullingLags, limited_lags, pulling_lags
from avtorch.gap.engine.slow_forces import (
    GUST_TIME_GRID_S,
    PROCESS_NOISE_GRID,
    SIZE_GRID_MPS2,
    cycle_response,
    cycle_spectrum,
    gust_spectrum,
    process_spectrum,
    road_spectrum,
    sensors_by_frame,
    slow_forces,
    slow_onset,
    wishart_log_likelihood,
    wishart_profile,
)
from tests.bars import BAR, log_odds, student
from tests.gap.engine.recorded import fitted_hypothesis, recorded_log

RATE_HZ = 20
SPEED_MPS = 15.0
T_L = float(NEUTRAL[INDEX["T_L"]])


def _data(seconds: float, channels: tuple[str, ...] = ("accel", "speed")) -> DriveData:
    """A drive whose shape alone counts."""
    time = np.arange(0.0, seconds, 1 / RATE_HZ)
    wave = np.sin(2 * np.pi * time / 10)
    columns = {"accel": wave, "speed": SPEED_MPS - np.cos(2 * np.pi * time / 10) * 10 / (2 * np.pi)}
    return DriveData.of(Log.from_arrays(time=time, accel_cmd=wave, **{name: columns[name] for name in channels}))


def _ornstein_uhlenbeck(rng: np.random.Generator, rows: int, time_s: float) -> FloatArray:
    """(row,) of variance 1, stationary from the first row on."""
    c = np.exp(-1 / (RATE_HZ * time_s))
    return lfilter([np.sqrt(1 - c * c)], [1, -c], rng.normal(size=rows), zi=[c * rng.normal()])[0]


def _process_noise(rng: np.random.Generator, rows: int, q: float) -> FloatArray:
    return q * np.sqrt(T_L / 2) * _ornstein_uhlenbeck(rng, rows, T_L)


def _residual(data: DriveData, rng: np.random.Generator, force: FloatArray) -> FloatArray:
    """The force in all channels; white noise of the acceleration, and of the speed before its difference."""
    rows = len(data.time)
    sensors = {"accel": 0.05 * rng.normal(size=rows), "speed": data.speed_difference(0.01 * rng.normal(size=rows))}
    return data.transform([force + sensors[name] for name in data.channels])


# spectra and the transform --------------------------------------------------------------------------------------------
def test_spectra_have_the_variance_of_their_process() -> None:
    # the variance of white jerk behind a lag is q² T / 2
    of = {"gust": 1.0, "process": T_L / 2, "cycle": 1.0}
    spectra = {
        "gust": lambda f: gust_spectrum(f, 1.7),
        "process": lambda f: process_spectrum(f, T_L),
        "cycle": lambda f: cycle_spectrum(f, 0.7),
    }
    for name, spectrum in spectra.items():
        total = quad(lambda f, s=spectrum: float(s(np.array([f]))[0]), 0, np.inf)[0]
        assert total == pytest.approx(of[name], rel=1e-6)  # accuracy of the quadrature
    total = quad(lambda f: float(road_spectrum(np.array([f]), 0.05)[0]), 0, np.inf)[0]
    assert total == pytest.approx(1, rel=1e-6)


def test_a_second_pole_leaves_the_variance_of_white_jerk() -> None:
    # x a'' + T a' + a = 0 under white jerk: Lyapunov's equation gives q² (T / 2 + x / (2 T))
    x = 0.04
    total = quad(lambda f: float(process_spectrum(np.array([f]), T_L, x)[0]), 0, np.inf, limit=200)[0]
    assert total == pytest.approx(T_L / 2 + x / (2 * T_L), rel=1e-6)


def test_white_noise_has_one_level_in_all_bands() -> None:
    data = _data(120)
    response = data.band_response
    below = data.frequency[data.band_edges[1 : len(response.energy) + 1] - 1] < SLOW_HZ
    level = response.energy.sum(1) * 2 / RATE_HZ  # spectrum of white noise of variance 1
    # the transform is orthonormal; 0.5 %: the grid of tones where it changes its pace
    assert np.allclose(level[below], 1, atol=0.005)


@pytest.mark.statistical
def test_the_response_is_the_mean_square_of_coefficients(rotating_seed: int, draws_factor: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(300)
    response = data.band_response
    n, repeats = len(response.energy), 24 * draws_factor
    each = []
    for _ in range(repeats):
        x = data.transform([_ornstein_uhlenbeck(rng, len(data.time), 2.0)])
        each.append(band_covariance(_data(300, ("accel",)), x)[:n, 0, 0])
    expected = response.energy @ gust_spectrum(response.frequency, 2.0)
    error = np.std(each, axis=0, ddof=1) / np.sqrt(repeats)
    # rows in place of continuous time: a spectrum that is repeated at the rate of the rows, seen below 2 of 20 Hz
    assert (np.abs(np.mean(each, axis=0) / expected - 1) < student(repeats - 1) * error / expected + 0.04).all()


# the likelihood of a common power -------------------------------------------------------------------------------------
def _covariances(rng: np.random.Generator, count: int) -> FloatArray:
    """Sample covariances (count, 2, 2) of all shapes and sizes."""
    root = np.tril(rng.normal(size=(count, 2, 2))) * np.exp(rng.normal(size=(count, 2, 1)))
    return root @ root.swapaxes(1, 2)


def test_no_sensors_fit_better_than_those_of_the_profile(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    S, counts = _covariances(rng, 40), np.full(40, 2.0)
    power = np.exp(rng.normal(-1, 1.5, (3, 40))) * np.sqrt(S[:, 0, 0] * S[:, 1, 1])
    nats, variances = wishart_profile(S, counts, power)
    assert np.allclose(nats, wishart_log_likelihood(S, counts, power, variances), rtol=1e-9)
    grid = np.geomspace(1e-4, 30, 40)
    a, c = np.meshgrid(grid, grid, indexing="ij")
    tried = np.stack([a[..., None, None] * S[:, 0, 0], c[..., None, None] * S[:, 1, 1]], -1)
    others = wishart_log_likelihood(S, counts, power, tried)
    assert (others <= nats + 1e-9 * np.abs(nats) + 1e-9).all()


def test_the_common_power_of_a_sample_covariance_explains_it(fresh_seed: int) -> None:
    S = _covariances(np.random.default_rng(fresh_seed), 200)
    # a common power that both channels may have: their covariance, less than either variance
    S = S[(S[:, 0, 1] > 0) & (S[:, 0, 1] < 0.99 * np.minimum(S[:, 0, 0], S[:, 1, 1]))]
    nats, variances = wishart_profile(S, np.ones(len(S)), S[:, 0, 1])
    assert np.allclose(nats, -0.5 * (np.linalg.slogdet(S)[1] + 2), atol=1e-9)
    assert np.allclose(variances, S[:, [0, 1], [0, 1]] - S[:, 0, 1][:, None], rtol=1e-6, atol=1e-9 * S.max())


def test_channels_and_units_are_exchangeable(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    S, counts, power = _covariances(rng, 30), rng.uniform(1, 50, 30), np.exp(rng.normal(size=(2, 30)))
    nats, variances = wishart_profile(S, counts, power)
    swapped, others = wishart_profile(S[:, ::-1, ::-1], counts, power)
    assert np.allclose(nats, swapped, rtol=1e-9)
    assert np.allclose(variances, others[..., ::-1], rtol=1e-6)
    assert np.allclose(wishart_profile(9 * S, counts, 9 * power)[0], nats - counts * np.log(9), rtol=1e-9)


# forces of known size -------------------------------------------------------------------------------------------------
@pytest.mark.statistical
def test_a_gust_is_found_and_measured(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(900)
    rows = len(data.time)
    found = []
    for _ in range(8):
        force = 0.2 * _ornstein_uhlenbeck(rng, rows, 2.0) + _process_noise(rng, rows, 0.04)
        found.append(slow_forces(data, _residual(data, rng, force), NEUTRAL))
    # neither process noise nor a road has the spectrum of a process of 2 s
    gusts, roads = np.array([f.gust for f in found]), np.array([f.road for f in found])
    assert (gusts > log_odds()).all()
    assert (gusts > roads).all()
    # 450 correlation times tell a size to 5 %; a step of the grid is 28 % of a size, and 50 % of a time
    sizes, times = np.array([f.gust_sd for f in found]), np.array([f.gust_time for f in found])
    step = np.log(SIZE_GRID_MPS2[1] / SIZE_GRID_MPS2[0])
    assert np.abs(np.log(sizes / 0.2)).mean() < step
    assert abs(np.log(times / 2.0).mean()) < np.log(GUST_TIME_GRID_S[1:] / GUST_TIME_GRID_S[:-1]).max()


@pytest.mark.statistical
def test_without_a_gust_the_best_one_gains_nothing(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(600)
    rows = len(data.time)
    for q in (0.0, 0.03, 0.1):
        found = slow_forces(data, _residual(data, rng, _process_noise(rng, rows, q)), NEUTRAL)
        # of 112 gusts and 80 roads beside five sizes of process noise the best; grids are coarse by half a nat
        assert max(found.gust, found.road) < log_odds(5 * 192) + 0.5


@pytest.mark.statistical
@pytest.mark.parametrize("from_s", [0, 300], ids=["throughout", "late"])
def test_a_force_that_swings_is_a_cycle_and_no_gust(from_s: float, rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(600)
    rows = len(data.time)
    hertz = float(np.exp(rng.uniform(*np.log([0.25, 1.5]))))
    swing = np.where(data.time >= from_s, 0.3 * np.sin(2 * np.pi * hertz * data.time + rng.uniform(0, 6)), 0.0)
    residual = _residual(data, rng, swing + _process_noise(rng, rows, 0.03))
    found = slow_forces(data, residual, NEUTRAL, cycle=True)
    assert found.cycle > max(found.gust, found.road, 0.0) + log_odds()
    # lines lie half a band apart, and what is in one band is not told from its neighbour's edge
    assert abs(np.log(found.cycle_hz / hertz)) < np.log(BAND_RATIO)
    back = cycle_response(data, residual, found)
    truth = data.transform([swing] * 2)
    # noise of the sensors in a band of 22 % about the line is a tenth of the swing's power, or less
    assert np.corrcoef(back.ravel(), truth.ravel())[0, 1] > 0.9


@pytest.mark.statistical
def test_gusts_and_process_noise_are_no_cycle(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(600)
    rows = len(data.time)
    for gust in (0.0, 0.2):
        force = gust * _ornstein_uhlenbeck(rng, rows, 2.0) + _process_noise(rng, rows, 0.04)
        found = slow_forces(data, _residual(data, rng, force), NEUTRAL, cycle=True)
        # of 23 lines of 16 sizes beside five sizes of process noise the best
        assert found.cycle < max(found.gust, 0.0) + log_odds(5 * 16 * 23)


@pytest.mark.statistical
def test_a_road_is_told_from_a_gust_by_the_end_of_its_spectrum(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(900)
    rows, f = len(data.time), np.fft.rfftfreq(len(data.time), 1 / RATE_HZ)
    for _ in range(3):
        slope = np.fft.irfft(np.fft.rfft(rng.normal(size=rows)) * (f < SPEED_MPS / 420), rows)
        force = 0.3 * slope / slope.std() + _process_noise(rng, rows, 0.03)
        found = slow_forces(data, _residual(data, rng, force), NEUTRAL)
        assert found.road > found.gust
        assert found.road > log_odds()
        # a flat spectrum up to 0.036 Hz in 900 s: 64 squares, a size to 9 %, and a step of the grid
        assert found.road_sd == pytest.approx(0.3, rel=0.28 + BAR * 0.09)


@pytest.mark.statistical
@pytest.mark.parametrize("channel", ["accel", "speed"])
def test_one_channel_shows_a_strong_gust(channel: str, rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(600, (channel,))
    force = 0.3 * _ornstein_uhlenbeck(rng, len(data.time), 2.2)
    found = slow_forces(data, _residual(data, rng, force), NEUTRAL)
    assert found.gust > log_odds()
    # 270 correlation times: 6 %, and a step of the grid
    assert found.gust_sd == pytest.approx(0.3, rel=0.28 + BAR * 0.06)


@pytest.mark.statistical
@pytest.mark.parametrize("channels", [("accel", "speed"), ("speed",)])
def test_a_gust_that_sets_in_tells_when(channels: tuple[str, ...], rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(600, channels)
    onset = 330.0
    force = 0.4 * _ornstein_uhlenbeck(rng, len(data.time), 1.5) * (data.time > onset)
    residual = _residual(data, rng, force)
    found = slow_onset(data, residual, slow_forces(data, residual, NEUTRAL))
    assert found.nats > log_odds(data.frame_count)
    assert found.time is not None
    assert abs(found.time - onset) < 2 * data.hop_s  # a frame
    # 180 correlation times: 8 %, and a step of the grid
    assert found.sd == pytest.approx(0.4, rel=0.28 + BAR * 0.08)


@pytest.mark.statistical
def test_a_late_gust_over_strong_process_noise_tells_when(rotating_seed: int) -> None:
    """Over the whole drive both together may pass for a gust alone, with no process noise left for the first part."""
    rng, data = np.random.default_rng(rotating_seed), _data(600)
    force = _process_noise(rng, len(data.time), 0.16)
    force += 0.15 * _ornstein_uhlenbeck(rng, len(data.time), 1.4) * (data.time > 330.0)
    residual = _residual(data, rng, force)
    found = slow_onset(data, residual, slow_forces(data, residual, NEUTRAL))
    assert found.nats > log_odds(data.frame_count)
    assert found.time is not None
    assert abs(found.time - 330.0) < 4 * data.hop_s  # two frames


@pytest.mark.statistical
def test_a_gust_that_blows_throughout_has_no_onset(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(600)
    residual = _residual(data, rng, 0.3 * _ornstein_uhlenbeck(rng, len(data.time), 1.5))
    assert slow_onset(data, residual, slow_forces(data, residual, NEUTRAL)).nats < log_odds(3 * data.frame_count)


@pytest.mark.statistical
def test_a_gust_that_blows_throughout_is_no_late_road(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(600)
    residual = _residual(data, rng, 0.3 * _ornstein_uhlenbeck(rng, len(data.time), 1.5))
    found = slow_forces(data, residual, NEUTRAL)
    late = slow_onset(data, residual, found, "road")
    assert found.road + late.nats < found.gust


@pytest.mark.statistical
def test_a_road_that_rises_late_tells_when(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(900)
    rows, f = len(data.time), np.fft.rfftfreq(len(data.time), 1 / RATE_HZ)
    slope = np.fft.irfft(np.fft.rfft(rng.normal(size=rows)) * (f < SPEED_MPS / 420), rows)
    residual = _residual(data, rng, 0.4 * slope / slope.std() * (data.time > 500.0))
    found = slow_onset(data, residual, slow_forces(data, residual, NEUTRAL), "road")
    assert found.nats > log_odds(data.frame_count)
    assert found.time is not None
    # a wave of it passes in half a minute, and may begin with little
    assert abs(found.time - 500.0) < 40.0


def test_short_drives_have_no_onset(fresh_seed: int) -> None:
    rng, data = np.random.default_rng(fresh_seed), _data(40)
    residual = _residual(data, rng, np.zeros(len(data.time)))
    assert data.frame_count < 10
    assert slow_onset(data, residual, slow_forces(data, residual, NEUTRAL)).time is None


def test_what_is_given_replaces_the_residuals(fresh_seed: int) -> None:
    rng, data = np.random.default_rng(fresh_seed), _data(200)
    residual = _residual(data, rng, 0.1 * _ornstein_uhlenbeck(rng, len(data.time), 2.0))
    S, n = band_covariance(data, residual), data.band_size
    own, given = slow_forces(data, residual, NEUTRAL), slow_forces(data, 0 * residual, NEUTRAL, given=(S, n))
    assert (own.log_likelihood, own.gust, own.road) == (given.log_likelihood, given.gust, given.road)
    # all channels at once may be no better than the law of each band's own covariance
    free = -0.5 * (n * (np.linalg.slogdet(S)[1] + 2))[: own.bands].sum()
    assert own.log_likelihood + max(own.gust, own.road, 0.0) < free


# lags by which an actuator pulls back what disturbs the car -----------------------------------------------------------
@pytest.mark.statistical
def test_process_noise_under_a_lag_that_is_too_short_is_no_gust(rotating_seed: int) -> None:
    """Where the response hardly tells the lag, the noise does: the loss of another lag is weighed against it."""
    rng, data = np.random.default_rng(rotating_seed), _data(300)
    residual = _residual(data, rng, _process_noise(rng, len(data.time), 0.2))
    values = NEUTRAL.copy()
    values[INDEX["T_L"]] = 0.1 * T_L

    def gust(loss: float) -> float:
        lags = PullingLags(np.array([0.1 * T_L, T_L]), np.array([0.0, -loss]))
        return slow_forces(data, residual, values, lags=lags).gust

    # a likelihood ratio against what is true exceeds x nats in exp(-x) of all drives; the grids leave some more
    assert gust(5.0) < 8
    alone = gust(1e4)
    assert alone == pytest.approx(slow_forces(data, residual, values).gust)
    assert alone > 20


def test_lags_that_explain_the_response_as_well_are_tried(fresh_seed: int) -> None:
    log, rng = recorded_log(seed=fresh_seed), np.random.default_rng(fresh_seed)
    assert log.accel is not None
    assert log.speed is not None
    rough = replace(log, accel=log.accel + rng.normal(0, 1.5, log.rows), speed=log.speed + rng.normal(0, 0.3, log.rows))
    known, unknown = (pulling_lags(evaluate_evidence(fitted_hypothesis(x))) for x in (log, rough))
    assert len(known.lag) == 1
    assert len(unknown.lag) > 1  # in forty drives at least 3
    for lags in (known, unknown):
        assert lags.nats[0] == 0
        assert (lags.nats <= 0).all()
        assert len(set(lags.lag)) == len(lags.lag)


def test_an_actuator_at_its_limit_pulls_less() -> None:
    data = _data(60)
    free = Hypothesis(data)
    assert limited_lags(free).tolist() == [T_L]
    # steepest demand: 2 pi / 10 m/s³; limits from never reached to reached nearly always
    shares = []
    for jerk in (1.0, 0.5, 0.1):
        lags = limited_lags(free.with_effect("rate_limit", (1 / jerk, 0.0)))
        assert lags[0] == pytest.approx(T_L)
        shares.append((lags[1] / T_L - 1) / (2 - 1))
        assert np.allclose(lags, T_L * (1 + shares[-1] * (2.0 ** np.arange(len(lags)) - 1)))
    assert shares[0] == pytest.approx(0, abs=1e-9)
    assert 0.2 < shares[1] < shares[2] < 1


@pytest.mark.statistical
def test_process_noise_behind_a_sensor_that_lags_is_no_gust(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(900)
    force, lag_s, scale = _process_noise(rng, len(data.time), 0.15), 0.4, 0.3
    keep = np.exp(-1 / (RATE_HZ * lag_s))
    felt = (1 + scale) * lfilter([1 - keep], [1, -keep], force)
    residual = _residual(data, rng, force)
    residual[0] += data.transform([felt - force, force])[0]
    values = NEUTRAL.copy()
    values[[INDEX["sensor_lag"], INDEX["sensor_scale"]]] = lag_s, scale
    # a likelihood ratio against what is true exceeds x nats in exp(-x) of all drives; the grids leave some more
    assert slow_forces(data, residual, values).gust < 8
    assert slow_forces(data, residual, NEUTRAL).gust > 20  # a sensor that is taken for a good one


@pytest.mark.statistical
def test_also_of_a_sensor_that_lags_from_a_time_on(rotating_seed: int) -> None:
    rng, data = np.random.default_rng(rotating_seed), _data(1800)
    force, lag_s = _process_noise(rng, len(data.time), 0.15), 0.8
    keep = np.exp(-1 / (RATE_HZ * lag_s))
    h = Hypothesis(data).with_effect("sensor_lag", (lag_s,), 300.0)
    late = data.time >= 300.0
    felt = np.where(late, lfilter([1 - keep], [1, -keep], force * late), force)
    residual = _residual(data, rng, force)
    residual[0] += data.transform([felt - force, force])[0]
    sensors = sensors_by_frame(h)
    assert (sensors == lag_s * np.array([[1], [0], [0]]) * (data.frame_time >= 300.0)).all()
    assert slow_forces(data, residual, NEUTRAL, sensors=sensors).gust < 8
    assert slow_forces(data, residual, NEUTRAL).gust > 60  # 163 in the mean of forty draws, and 16 about it


@pytest.mark.parametrize(("lag_s", "scale"), [(0.0, 0.0), (0.6, 0.0), (2.5, 0.3)])
def test_nothing_explains_a_covariance_better_than_itself(lag_s: float, scale: float, fresh_seed: int) -> None:
    """Also where an accelerometer's lag and scale are undone: hypotheses with other lags are compared."""
    rng = np.random.default_rng(fresh_seed)
    data = _data(120.0)
    values = NEUTRAL.copy()
    values[[INDEX["sensor_lag"], INDEX["sensor_scale"]]] = lag_s, scale
    found = slow_forces(data, _residual(data, rng, _process_noise(rng, len(data.time), 0.3)), values)
    itself = -0.5 * float((found.counts * (np.linalg.slogdet(found.covariance)[1] + 2)).sum())
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()
    assert found.log_likelihood + max(found.gust, found.road) < itself


@pytest.mark.statistical
def test_the_size_of_process_noise_is_not_rounded_to_a_grid(rotating_seed: int) -> None:
    """Halfway between two points of the grid: a power so far off would pass for a gust in a long drive."""
    q = float(np.sqrt(PROCESS_NOISE_GRID[13] * PROCESS_NOISE_GRID[14]))
    rng, data = np.random.default_rng(rotating_seed), _data(900)
    residual = _residual(data, rng, _process_noise(rng, len(data.time), q))
    found = slow_forces(data, residual, NEUTRAL)
    coefficients = data.band_size[: found.bands].sum()
    # of these the sensors' own noise leaves four fifths
    assert abs(found.process_noise / q - 1) < BAR / np.sqrt(2 * 0.8 * coefficients)
