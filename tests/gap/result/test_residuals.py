"""Residuals and their bands: known signals come out, and chance stays within as often as is said."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.result.residuals import binned_means, correlation, residuals, spectrum, usual
from avtorch.gap.result.traces import Traces

STEP = 0.05


def clock(rows: int) -> FloatArray:
    return np.linspace(0.0, STEP * (rows - 1), rows)


def coloured(rng: np.random.Generator, rows: int, seconds: float) -> FloatArray:
    """First order, of that time constant, with a variance of 1."""
    keep = np.exp(-STEP / seconds)
    long = rows + round(20 * seconds / STEP)
    return np.asarray(lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal(long)), np.float64)[-rows:]


def drive(rows: int, u: FloatArray | None = None, stretch: IntArray | None = None) -> Traces:
    none = np.zeros(rows)
    u = none if u is None else u
    stretch = np.zeros(rows, int) if stretch is None else stretch
    return Traces(clock(rows), u, ("accel",), none[None], none[None], none[None], none, stretch)


def test_a_mean_that_follows_the_command_is_found_where_it_is() -> None:
    rng = np.random.default_rng(1)
    u = coloured(rng, 12_000, 2.0)
    e = 0.3 * np.maximum(u, 0) + 0.01 * rng.standard_normal(len(u))
    bins = binned_means(drive(len(e), u), u, e)
    assert (np.diff(bins.place) > 0).all()
    for place, low, high in zip(bins.place, bins.low, bins.high, strict=True):
        if abs(place) > 0.3:  # a bin about the kink averages over it
            assert low - 0.003 <= 0.3 * max(place, 0) <= high + 0.003


def test_a_bin_s_interval_covers_the_truth_as_often_as_is_said() -> None:
    """Residuals of 1 s colour, blocks of 10 s: 90 % within, less what a block's edges take."""
    rng, inside = np.random.default_rng(2), []
    for _ in range(150):
        e, u = coloured(rng, 4800, 1.0), coloured(rng, 4800, 3.0)
        bins = binned_means(drive(len(e), u), u, e, bins=5)
        inside += ((bins.low <= 0) & (bins.high >= 0)).tolist()
    # 750 intervals, some of one drive: three standard errors of 150 independent ones to each side
    assert 0.9 - 3 * 0.0245 <= np.mean(inside) <= 0.9 + 3 * 0.0245


def test_few_blocks_have_no_interval() -> None:
    e = np.random.default_rng(3).standard_normal(500)
    assert np.isnan(binned_means(drive(len(e)), np.arange(500.0), e).low).all()


def test_independent_coloured_signals_stay_within_the_band_as_often_as_is_said() -> None:
    rng, beyond = np.random.default_rng(4), []
    for _ in range(300):
        e, u = coloured(rng, 4000, 0.5), coloured(rng, 4000, 1.5)
        both = correlation(drive(len(e), u), e)
        beyond.append(abs(both.value[both.lag.searchsorted(1.0)]) > both.band)
    # 1 % is meant; the band rests on estimated colours, which costs as much again; 300 draws, three standard errors
    assert np.mean(beyond) <= 0.02 + 3 * np.sqrt(0.02 * 0.98 / 300)


def test_a_late_answer_shows_at_its_lag() -> None:
    rng = np.random.default_rng(5)
    u = coloured(rng, 8000, 0.2)
    e = 0.5 * np.roll(u, 30) + 0.1 * rng.standard_normal(len(u))
    both = correlation(drive(len(e), u), e)
    assert both.lag[both.value.argmax()] == pytest.approx(1.5)
    assert both.value.max() > 5 * both.band
    assert np.abs(both.value[both.lag < 0]).max() < both.value.max() / 2


def test_nothing_is_correlated_across_a_gap() -> None:
    u, e = np.zeros(2000), np.zeros(2000)
    u[990:1000], e[1000:1010] = 1.0, 1.0
    apart = np.repeat([0, 1], 1000)
    # over the gap the means alone are left
    assert correlation(drive(len(e), u), e).value.max() > 0.9
    assert np.abs(correlation(drive(len(e), u, apart), e).value).max() < 0.02


def test_white_noise_has_its_power_at_every_frequency() -> None:
    e = 0.2 * np.random.default_rng(6).standard_normal(40_000)
    found = spectrum(drive(len(e)), e)
    assert found is not None
    truth = 2 * 0.2**2 * STEP
    # of 198 averaged windows, 200 frequencies: a few in a thousand of their mean
    assert found.power[:-1].mean() == pytest.approx(truth, rel=0.02)
    covered = np.mean((found.low <= truth) & (found.high >= truth))
    assert 0.9 - 4 * np.sqrt(0.09 / 200) <= covered <= 0.9 + 4 * np.sqrt(0.09 / 200)
    assert spectrum(drive(100), e[:100]) is None


def test_usual_is_where_99_percent_of_normal_rows_lie() -> None:
    e = 0.3 * np.random.default_rng(7).standard_normal(100_000)
    spikes = np.where(np.arange(len(e)) % 50 == 0, 10.0, e)
    assert np.mean(np.abs(e) > usual(e)) == pytest.approx(0.01, abs=0.002)
    assert usual(spikes) == pytest.approx(usual(e), rel=0.05)


def test_a_log_without_acceleration_has_the_slope_of_its_speed() -> None:
    rows = 1200
    time = clock(rows)
    zero = np.zeros((1, rows))
    stretch = np.repeat([0, 1], rows // 2)
    drift = 0.2 * time + 3.0 * stretch  # a jump between stretches is no slope
    before, after = residuals(Traces(time, zero[0], ("speed",), drift[None], zero, drift[None], zero[0], stretch))
    assert before == pytest.approx(np.full(rows, 0.2))
    assert after == pytest.approx(np.zeros(rows), abs=1e-12)
