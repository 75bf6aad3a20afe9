"""Outliers: their laws, and outliers of known places told from shocks and tails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter as _filter

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.outliers import (
    SUSPECT,
    _lasting,
    additive_over_innovational,
    contaminated_over_student,
    rate_onset,
    robust_innovations,
    sensor_outliers,
    tail_log_likelihoods,
    without_outliers,
)
from tests.bars import BAR, log_odds

RATE_HZ = 50
NOISE_MPS2 = 0.05
ROWS = 120 * RATE_HZ
DYNAMICS = np.array([1.0, -1.3, 0.6])
"""pi of the errors below: a resonance, whose energy 3.05 tells additive from innovational outliers."""


def lfilter(b: object, a: object, x: object) -> FloatArray:
    return np.asarray(_filter(b, a, x))


def _data(rng: np.random.Generator, seconds: float, noise: FloatArray) -> DriveData:
    """A car of 0.3 s and gain 1, as a new hypothesis has it, under a wandering command."""
    time = np.arange(0.0, seconds, 1 / RATE_HZ)
    c = np.exp(-1 / (RATE_HZ * 2.0))
    command = lfilter([np.sqrt(1 - c * c)], [1, -c], rng.normal(size=len(time)))
    lag = np.exp(-1 / (RATE_HZ * 0.3))
    accel = lfilter([0, 1 - lag], [1, -lag], command)
    gained = np.cumsum(accel - accel.mean()) / RATE_HZ
    speed = 5.0 - gained.min() + gained + 0.01 * rng.normal(size=len(time))  # never backwards, whatever the walk
    return DriveData.of(Log.from_arrays(time=time, accel_cmd=command, accel=accel + noise, speed=speed))


def _places(rng: np.random.Generator, first: int, last: int, count: int, apart: int = 30) -> np.ndarray:
    """Rows (count,), rising, at least so far `apart`."""
    slack = last - first - apart * count
    return first + np.sort(rng.integers(0, slack, count)) + apart * np.arange(count)


def _spikes(rng: np.random.Generator, size: float) -> tuple[FloatArray, np.ndarray]:
    """Sixty outliers (row,) of this size in `ROWS`, and their places."""
    places, spikes = _places(rng, 300, ROWS - 50, 60), np.zeros(ROWS)
    spikes[places] = size * rng.choice([-1, 1], 60)
    return spikes, places


# innovations ----------------------------------------------------------------------------------------------------------
@pytest.mark.statistical
def test_an_autoregression_is_recovered_beside_outliers(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    errors = lfilter([1.0], DYNAMICS, 0.3 * rng.normal(size=8000))
    errors[rng.random(8000) < 0.01] += 8.0
    bounds = np.array([0, 3000, 8000])
    found = robust_innovations(errors, bounds, 100, errors)
    assert found is not None
    # squared standard errors of an autoregression times rows are sums of squares of its coefficients (Box and Jenkins,
    # A7.5), of all of them at most; a tenth of the rows weighs little
    least = BAR * np.linalg.norm(DYNAMICS) / np.sqrt(0.85 * 7800)
    assert np.abs(found.pi[:3] - DYNAMICS).max() < least
    assert np.abs(found.pi[3:]).max() < least
    # a median of deviations has an efficiency of 37 %; outliers in 1 % of the rows, and what follows them, raise it
    assert found.scale == pytest.approx(0.3, rel=0.1)
    assert (np.diff(found.rows) >= 1).all()
    assert len(found.rows) == len(found.z) == 8000 - 2 * (100 + 10)


def test_innovations_are_what_the_filter_leaves(fresh_seed: int) -> None:
    errors = np.random.default_rng(fresh_seed).normal(size=600)
    found = robust_innovations(errors, np.array([0, 600]), 50, errors)
    assert found is not None
    assert np.allclose(lfilter(found.pi, [1.0], errors)[found.rows], found.scale * found.z)


def test_short_stretches_have_no_innovations() -> None:
    assert robust_innovations(np.ones(100), np.array([0, 50, 100]), 10, np.ones(100)) is None


# additive or innovational ---------------------------------------------------------------------------------------------
@pytest.mark.statistical
@pytest.mark.parametrize("smear", [0.0, 0.5])
def test_an_additive_outlier_passes_the_filter_as_it_is(smear: float, rotating_seed: int) -> None:
    rng, rows, size = np.random.default_rng(rotating_seed), 6000, 12.0
    places = _places(rng, 50, rows - 50, 20)
    jumps = np.zeros(rows)
    jumps[places] = size * rng.choice([-1, 1], 20)
    z = lfilter(DYNAMICS, [1.0, -smear], jumps) + rng.normal(size=rows)
    nats, found, at, _ = additive_over_innovational(z, DYNAMICS, 1 / RATE_HZ)
    response = np.abs(lfilter(DYNAMICS, [1.0, -smear], np.eye(1, 12)[0]))
    gain = 0.5 * size**2 * ((response**2).sum() - (response**2).max())  # nats of each, without noise
    # the matched filter has unit variance around size |pi|, the largest of a pattern at most that of three rows
    assert nats == pytest.approx(20 * (gain - 1.5), rel=BAR / np.sqrt(20 * gain), abs=20 * 3.0)
    assert found == smear
    assert set(places) <= set(at)


@pytest.mark.statistical
def test_a_shock_is_no_outlier(rotating_seed: int) -> None:
    rng, rows = np.random.default_rng(rotating_seed), 6000
    z = rng.normal(size=rows)
    z[_places(rng, 50, rows - 50, 20)] += 12.0
    assert additive_over_innovational(z, DYNAMICS, 1 / RATE_HZ)[0] < 0


# laws of innovations --------------------------------------------------------------------------------------------------
def test_log_likelihoods_are_those_of_scipy(fresh_seed: int) -> None:
    z = np.random.default_rng(fresh_seed).standard_t(3, 400)
    z[0] = 400.0  # far beyond what an exponential can hold
    mixture, student, normal = tail_log_likelihoods(z)
    assert normal == pytest.approx(max(stats.norm.logpdf(z, scale=a).sum() for a in np.linspace(0.8, 2, 13)))
    laws = [(dof, a) for dof in (2.5, 3, 4, 6, 9, 15, 30) for a in (0.7, 0.8, 0.9, 1.0, 1.1, 1.2)]
    assert student == pytest.approx(max(stats.t.logpdf(z, dof, scale=a).sum() for dof, a in laws))
    best = -np.inf
    for a in (0.85, 0.95, 1.05, 1.2):
        core = stats.norm.logpdf(z, scale=a)
        for k in (3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 13.0):
            wide = stats.norm.logpdf(z, scale=a * np.hypot(1, k))
            for p in (0.001, 0.002, 0.004, 0.008, 0.015, 0.03, 0.05, 0.08, 0.12):
                best = max(best, np.logaddexp(np.log1p(-p) + core, np.log(p) + wide).sum())
    assert mixture == pytest.approx(best)


@pytest.mark.statistical
def test_each_law_is_told_by_its_own_draws(rotating_seed: int) -> None:
    rng, n = np.random.default_rng(rotating_seed), 8000
    contaminated = rng.normal(size=n) * np.where(rng.random(n) < 0.01, np.hypot(1, 8), 1)
    mixture, student, normal = tail_log_likelihoods(contaminated)
    assert mixture > max(student, normal) + log_odds()
    mixture, student, normal = tail_log_likelihoods(rng.standard_t(4, n))
    assert student > max(mixture, normal) + log_odds()
    mixture, student, normal = tail_log_likelihoods(rng.normal(size=n))
    # the best of 252 mixtures over the truth, which is on the grid of normal laws
    assert mixture < normal + log_odds(252)


# the accelerometer ----------------------------------------------------------------------------------------------------
@pytest.mark.statistical
def test_outliers_are_flagged_and_replaced(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    noise = NOISE_MPS2 * rng.normal(size=ROWS)
    spikes, places = _spikes(rng, 12 * NOISE_MPS2)
    data = _data(rng, 120.0, noise + spikes)
    found = sensor_outliers(Hypothesis(data))
    assert found.nats > log_odds()
    # 12 sigma beside noise of one: none stays below 4.2; a row in 40,000 is flagged by chance
    assert set(places) <= set(np.flatnonzero(found.flags))
    assert found.flags.sum() <= 60 + BAR
    clean = without_outliers(data, found.errors, found.flags)
    assert data.accel is not None
    touched = np.flatnonzero(clean != data.accel)
    assert set(touched) <= set(places) | set(places - 1) | set(np.flatnonzero(found.flags)) | set(
        np.flatnonzero(found.flags) - 1
    )
    # what stands in their place is the response and its neighbours' error, which is noise
    truth = data.accel - noise - spikes
    assert np.abs(clean - truth)[places].max() < 6 * NOISE_MPS2


@pytest.mark.statistical
def test_outliers_on_a_smooth_error_are_flagged(rotating_seed: int) -> None:
    """Six poles answer an outlier with seven large innovations in a row, longer than a lasting deviation: it is one."""
    rng = np.random.default_rng(rotating_seed)
    noise = 0.01 * NOISE_MPS2 * lfilter([1.0], np.poly([0.8] * 6), rng.normal(size=ROWS))
    spikes, places = _spikes(rng, 2 * NOISE_MPS2)
    found = sensor_outliers(Hypothesis(_data(rng, 120.0, noise + spikes)))
    assert found.nats > log_odds()
    # each is 200 innovations' scales
    assert set(places) <= set(np.flatnonzero(found.flags))
    assert found.flags.sum() <= 60 + BAR


@pytest.mark.statistical
def test_a_clean_accelerometer_has_none(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    for noise in (
        NOISE_MPS2 * rng.normal(size=6000),
        0.4 * NOISE_MPS2 * lfilter([1.0], DYNAMICS, rng.normal(size=6000)),
        0.6 * NOISE_MPS2 * rng.standard_t(5, 6000),
    ):
        assert sensor_outliers(Hypothesis(_data(rng, 120.0, noise))).nats < log_odds()


def test_replaced_readings_are_judged_as_they_were_read(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    noise = NOISE_MPS2 * rng.normal(size=3000)
    noise[_places(rng, 300, 2900, 20)] += 1.0
    data = _data(rng, 60.0, noise)
    first = sensor_outliers(Hypothesis(data))
    replaced = data.with_accel(without_outliers(data, first.errors, first.flags))
    again = sensor_outliers(Hypothesis(replaced))
    assert again.nats == first.nats
    assert (again.flags == first.flags).all()


def test_errors_are_on_the_clock_of_the_readings(fresh_seed: int) -> None:
    """However late the accelerometer is made in the comparison with the speed."""
    rng = np.random.default_rng(fresh_seed)
    data = _data(rng, 60.0, NOISE_MPS2 * rng.normal(size=3000))
    here, later = sensor_outliers(Hypothesis(data)), sensor_outliers(Hypothesis(data.with_align(0.04)))
    # two whole rows, but for the ends of the drive
    assert np.allclose(here.errors[3:], later.errors[3:], atol=1e-9)


def test_rows_after_a_step_of_the_command_are_no_suspects(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    data = _data(rng, 60.0, NOISE_MPS2 * rng.normal(size=3000))
    assert data.accel is not None
    step = 1500
    data.command = np.where(np.arange(3000) < step, 0.0, 3.0)
    data.accel = data.accel.copy()
    data.accel[step + 5] += 3.0
    data.accel[2500] += 3.0
    flags = sensor_outliers(Hypothesis(data)).flags
    assert not flags[step : step + 30].any()


def test_without_an_accelerometer_there_are_none(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    whole = _data(rng, 60.0, NOISE_MPS2 * rng.normal(size=3000))
    data = DriveData.of(Log.from_arrays(time=whole.time, accel_cmd=whole.command, speed=whole.speed))
    found = sensor_outliers(Hypothesis(data))
    assert found.nats == -np.inf
    assert not found.flags.any()


# rates ----------------------------------------------------------------------------------------------------------------
@pytest.mark.statistical
def test_the_onset_of_a_rate_is_found(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    times = np.sort(np.concatenate([rng.uniform(0, 100, 3), rng.uniform(60, 100, 60)]))
    nats, when = rate_onset(times, 0.0, 100.0)
    assert nats > log_odds()
    assert when is not None
    # intervals are of 0.65 s behind it: the first ones tell it
    assert abs(when - 60) < 0.65 * np.log(1 / 1e-6)


@pytest.mark.statistical
def test_a_steady_rate_has_no_onset(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    assert rate_onset(np.sort(rng.uniform(0, 100, 50)), 0.0, 100.0)[0] < log_odds(50)
    assert rate_onset(np.sort(rng.uniform(0, 100, 7)), 0.0, 100.0) == (0.0, None)


@pytest.mark.statistical
def test_tails_of_white_noise_on_a_coloured_error_are_no_outliers(rotating_seed: int) -> None:
    """They are additive, too: four of sixty logs of recorders with such noise were said to have outliers."""
    rng = np.random.default_rng(rotating_seed)
    tails, wide = np.abs(rng.standard_t(4, 60_000)), np.abs(8 * rng.normal(size=500))
    # a likelihood ratio against what is true exceeds x nats in exp(-x) of all draws; seven widths are tried
    assert contaminated_over_student(tails[tails > SUSPECT]) < 14 + np.log(7)
    # a third of a nat each, of three hundred; the sum's standard deviation is ten
    assert contaminated_over_student(wide[wide > SUSPECT]) > 18


def test_what_deviates_to_the_end_of_a_stretch_may_last() -> None:
    """Three rows at the end of a stretch, where a driver had taken over, were outliers at 75 nats."""
    z = np.zeros(40)
    z[[5, 18, 19, 37, 38, 39]] = 9.0
    ends = np.isin(np.arange(40), (19, 39))
    assert np.flatnonzero(_lasting(z, z > 0, ends, 3)).tolist() == [18, 19, 37, 38, 39]
    assert not _lasting(z, z > 0, np.zeros(40, bool), 3).any()
