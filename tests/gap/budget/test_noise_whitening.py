"""The noise's spectrum: an autoregression finds the innovations, and each stretch is filtered by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.noise_whitening import BAND_HZ, NoiseWhitening
from tests.bars import BAR
from tests.gap.budget.cars import log_of


@pytest.mark.statistical
def test_what_an_autoregression_leaves_is_white_and_of_size_one(rotating_seed: int) -> None:
    record = AnalysisRecord.of([log_of(seconds=400.0)])
    rng = np.random.default_rng(rotating_seed)
    noise = np.asarray(lfilter([1.0], [1.0, -1.4, 0.7], rng.normal(0.0, 0.3, (2, record.rows)), axis=-1))
    whitening = NoiseWhitening.autoregressive(record, noise, band_hz=0.5 / record.dt)
    white = whitening(noise)
    n = white.shape[-1]
    # the SD's own error, and that of twenty more coefficients than there are
    assert np.abs(white.std(-1) - 1).max() < BAR / np.sqrt(2 * n) + 20 / n
    # sorted by block, and blocks follow each other: neighbours are neighbours
    correlation = [(x[1:] * x[:-1]).mean() for x in white]
    assert np.abs(correlation).max() < BAR / np.sqrt(n)


def test_what_is_above_the_band_is_not_compared_and_rows_count_as_what_they_say() -> None:
    record = AnalysisRecord.of([log_of(seconds=200.0)])
    noise = np.random.default_rng(0).normal(0.0, 0.3, (2, record.rows))
    in_band, whole = (NoiseWhitening.autoregressive(record, noise, band_hz=hz) for hz in (BAND_HZ, 0.5 / record.dt))
    frequency = np.fft.rfftfreq(4096, record.dt)
    passed = np.abs(np.fft.rfft(in_band.taps, 4096) / np.fft.rfft(whole.taps, 4096)) ** 2
    # a filter of one period of the band's edge: half the amplitude there, a tenth at twice the edge
    assert (passed[:, frequency < 0.5 * BAND_HZ] > 0.6).all()
    assert (passed[:, frequency > 2 * BAND_HZ] < 0.02).all()
    # flat noise through it has as many independent values as this; no row may count for more
    independent = passed.mean(-1) ** 2 / (passed**2).mean(-1)
    assert (in_band.share <= independent).all()
    assert (in_band.share > 0.7 * independent).all()


def test_a_stretch_knows_nothing_of_the_one_before() -> None:
    log = log_of(seconds=90.0)
    record = AnalysisRecord.of([replace(log, segment=(log.time > 45.0).astype(int))])
    taps = np.array([1.0, -0.5, 0.25])
    x = np.random.default_rng(0).normal(size=record.rows)
    other = x.copy()
    other[record.stretches[0].rows] = 7.0
    second = record.stretches[1].rows
    np.testing.assert_array_equal(record.filtered(x, taps)[second], record.filtered(other, taps)[second])


def test_rows_whose_past_does_not_count_do_not_count() -> None:
    record = AnalysisRecord.of([log_of()])
    whitening = NoiseWhitening.of(record, np.ones((2, 21)), np.ones(2))
    first = int(np.nonzero(record.counts)[0][0])
    assert whitening.order.min() == first + 20
    assert whitening.lengths.sum() == len(whitening.order)
