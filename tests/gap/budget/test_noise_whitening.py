"""The noise's spectrum: an autoregression finds the innovations, and each stretch is filtered by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch.blindtest import draw_case
from avtorch.gap import gap_budget
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.joint_whitening import JointWhitening
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from tests.bars import BAR
from tests.gap.budget.cars import log_of


@pytest.mark.statistical
def test_what_an_autoregression_leaves_is_white_and_of_size_one(rotating_seed: int) -> None:
    record = AnalysisRecord.of([log_of(seconds=400.0)])
    rng = np.random.default_rng(rotating_seed)
    noise = np.asarray(lfilter([1.0], [1.0, -1.4, 0.7], rng.normal(0.0, 0.3, (2, record.rows)), axis=-1))
    whitening = NoiseWhitening.autoregressive(record, noise)
    white = whitening(noise)
    n = white.shape[-1]
    # the SD's own error, and that of twenty more coefficients than there are
    assert np.abs(white.std(-1) - 1).max() < BAR / np.sqrt(2 * n) + 20 / n
    # sorted by block, and blocks follow each other: neighbours are neighbours
    correlation = [(x[1:] * x[:-1]).mean() for x in white]
    assert np.abs(correlation).max() < BAR / np.sqrt(n)


@pytest.mark.slow
def test_a_bias_that_sets_in_is_no_noise() -> None:
    # taken for noise that wanders, a step of the reading hid itself
    log = log_of(seconds=300.0)
    assert log.accel is not None
    stepped = replace(log, accel=log.accel + np.where(log.time > 170.0, 0.75, 0.0))
    (part,) = gap_budget(stepped, effects=["sensor_bias"]).parts
    assert part.onset_s == pytest.approx(170.0, abs=0.1)  # two rows


@pytest.mark.parametrize("joint", [False, True])
def test_what_begins_within_a_stretch_is_filtered_as_in_the_whole(joint: bool, fresh_seed: int) -> None:
    log = log_of(seconds=90.0, seed=fresh_seed)
    record = AnalysisRecord.of([replace(log, segment=(log.time > 45.0).astype(int))])
    noise = np.random.default_rng(fresh_seed).normal(0.0, 0.3, (2, record.rows))
    made = JointWhitening.vector_autoregressive if joint else NoiseWhitening.autoregressive
    whitening = made(record, np.asarray(lfilter([1.0], [1.0, -0.9], noise, axis=-1)))
    begin, end = record.stretches[1].rows.start + 100, record.stretches[1].rows.stop
    late = np.where((np.arange(record.rows) >= begin) & (np.arange(record.rows) < end), noise, 0.0)
    inside = (whitening.order >= begin) & (whitening.order < end)
    found = whitening.since(late[:, begin:end])[:, whitening.order[inside] - begin]
    np.testing.assert_allclose(found, whitening(late)[:, inside], atol=1e-9)
    assert not whitening(late)[:, whitening.order < begin].any()


@pytest.mark.slow
def test_a_loop_that_feeds_noise_back_has_no_dead_time() -> None:
    # behind a low-pass this car without a cause had a dead time of 0.3 s, and a lag of 0.07 s
    case = draw_case(35, 555, mix={"none": 1.0}, recorder="ordinary", seconds=150.0)
    assert case.drive.manoeuvre == "following"
    budget = gap_budget(case.log(), effects=["dead_time"])
    assert budget.names == ()
    lag = budget.repaired["T_L"]
    # three standard errors, and 5 % for what the recorder's own low-pass adds
    assert abs(lag.mean - case.truth()["baseline"]["T_L"]) < 3 * lag.sd + 0.05 * lag.mean


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
