"""Heavy tails: found where they are, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.search.outliers import heavy_tails
from tests.bars import log_odds
from tests.gap.records import drawn_errors

pytestmark = pytest.mark.statistical

ROWS = 6000


def _glitched(fraction: float, scale: float, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    errors = 0.05 * rng.standard_normal(ROWS)
    hit = rng.random(ROWS) < fraction
    return errors + np.where(hit, 0.05 * scale * rng.standard_normal(ROWS), 0.0), hit


@pytest.mark.parametrize(("fraction", "scale"), [(0.006, 8.0), (0.02, 6.0), (0.05, 10.0)])
def test_outliers_are_found_with_their_size(fraction: float, scale: float, rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    errors, hit = _glitched(fraction, scale, rng)
    found = heavy_tails(errors, 0.05)
    assert found.evidence > 30
    # distances from neighbours are no independent draws: bars of 5 sds, of which each is up to 1.3 times too small
    assert abs(np.log(found.fraction / fraction)) < 6.5 * found.sds[0]
    assert abs(np.log(found.scale / scale)) < 6.5 * found.sds[1]
    assert found.fraction == pytest.approx(fraction, rel=0.75)
    assert found.scale == pytest.approx(scale, rel=0.6)
    # a glitch may be small, and what is called one hardly ever is none
    assert found.hit.sum() > 0.25 * hit.sum()
    assert (found.hit & ~hit).sum() <= 0.15 * found.hit.sum() + 12
    large = np.abs(errors) > 0.05 * 10
    assert found.hit[large].mean() > 0.8
    assert found.ratios.shape == (ROWS,)


@pytest.mark.slow
def test_normal_noise_has_no_outliers(rotating_seed: int) -> None:
    """Under normal noise the odds for outliers have a mean of 1 at most, so chance passes `c` nats once in exp(c).

    Of 200 such drives none was above -1.2 nats, with a median of -3.7; a row of five standard deviations, which one
    drive in 300 has, brings it above 0.
    """
    rng = np.random.default_rng(rotating_seed)
    evidence = []
    for i in range(20):
        if i % 2:
            errors = 0.05 * rng.standard_normal(ROWS)
        else:  # with the car's own wandering, and jumps that are none of the sensor's
            errors = drawn_errors(NoiseModel(process_sd=0.1, accel_sd=0.03), ROWS, 0.05, rng)[0]
            errors += 0.8 * np.sign(np.sin(np.arange(ROWS) / 200))
        found = heavy_tails(errors, 0.05)
        evidence.append(found.evidence)
        assert found.hit.sum() <= 6
    assert max(evidence) < log_odds(20)
    # 6 of 20 once in two million, were one drive in 70 above 0 (the 95 % bound of none in 200)
    assert sum(x > 0 for x in evidence) <= 5


def test_outliers_from_a_moment_on(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    errors, _ = _glitched(0.03, 8.0, rng)
    at = 3500
    errors[:at] = 0.05 * rng.standard_normal(at)
    found = heavy_tails(errors, 0.05)
    assert found.onset is not None
    # one row in 33 is informative: not before a glitch, and at most a few plain ones late
    assert -150 < found.onset - at < 700
    throughout = heavy_tails(_glitched(0.03, 8.0, rng)[0], 0.05)
    assert throughout.onset is None or throughout.onset < 1500


def test_noise_that_grows_rougher_has_no_outliers(rotating_seed: int) -> None:
    """As where a gust sets in: against one size for the whole drive its rows would lie far off."""
    rng = np.random.default_rng(rotating_seed)
    for _ in range(6):
        errors = 0.05 * rng.standard_normal(ROWS)
        errors[ROWS // 2 :] *= 3.0
        found = heavy_tails(errors, 0.05)
        assert found.evidence < log_odds(6)
        assert found.hit.sum() <= 12
