"""A black box finds structure that exists, and little where there is none."""

import numpy as np
import pytest

from avtorch.gap.blocks import folds
from avtorch.gap.crossval.black_box import BlackBoxRegression
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from tests.gap.finds import found_of
from tests.gap.records import QUIET, errors_of

pytestmark = pytest.mark.statistical


@pytest.mark.slow
def test_noise_stays_noise(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = found_of([], seconds=120.0, rng=rng, noise=QUIET)
    record = found.hypothesis.record
    part = folds(record)[0]
    box = BlackBoxRegression.of(record, record.measured - found.errors)
    worse = []
    for _ in range(20):
        errors = errors_of(QUIET, record, rng)
        left = errors - box.predict(errors, WhiteningFilter(part.fits, QUIET))
        white = WhiteningFilter(part.held_out, QUIET)
        before, after = (white.log_likelihood(e[:, part.rows]) for e in (errors, left))
        worse.append(float(before - after))
    # a size that the evidence chooses is now and then too large by chance; 20 draws of some nats each
    assert np.mean(worse) < 6.0
    assert np.median(worse) < 2.0


def test_an_unnamed_force_is_predicted(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = found_of([], seconds=120.0, rng=rng, noise=QUIET)
    record = found.hypothesis.record
    rollout = record.measured - found.errors
    force = 0.3 * np.tanh(rollout[0, :, 0] / 0.3) * np.cos(record.measured[1, :, 0] / 3)
    moved = np.stack([force, np.cumsum(force) * record.dt])[..., None]
    errors = errors_of(QUIET, record, rng) + moved
    box = BlackBoxRegression.of(record, rollout)
    for part in folds(record):
        left = errors - box.predict(errors, WhiteningFilter(part.fits, QUIET))
        before, after = (float((e[0, part.rows] ** 2).mean()) for e in (errors, left))
        noise = QUIET.process_sd**2 + QUIET.accel_sd**2
        # most of what is above the noise goes, on rows that it never saw
        assert after - noise < 0.5 * (before - noise)
