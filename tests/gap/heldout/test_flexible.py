"""A black box finds what is there, and makes up little where nothing is."""

import numpy as np

from avtorch.gap.heldout.flexible import Flexible
from avtorch.gap.heldout.parts import parted
from avtorch.gap.likelihood.whitener import Whitener
from tests.gap.finds import found_of
from tests.gap.records import QUIET, errors_of


def test_noise_stays_noise(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = found_of([], seconds=120.0, rng=rng, noise=QUIET)
    record = found.candidate.record
    part = parted(record)[0]
    box = Flexible.of(record, record.measured - found.errors)
    worse = []
    for _ in range(20):
        errors = errors_of(QUIET, record, rng)
        left = errors - box.foretold(errors, Whitener(part.fits, QUIET))
        white = Whitener(part.judges, QUIET)
        before, after = (white.log_likelihood(e[:, part.rows]) for e in (errors, left))
        worse.append(float(before - after))
    # a size that the evidence chooses is now and then too large by chance; 20 draws of some nats each
    assert np.mean(worse) < 6.0
    assert np.median(worse) < 2.0


def test_a_force_of_no_name_is_foretold(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = found_of([], seconds=120.0, rng=rng, noise=QUIET)
    record = found.candidate.record
    rollout = record.measured - found.errors
    force = 0.3 * np.tanh(rollout[0, :, 0] / 0.3) * np.cos(record.measured[1, :, 0] / 3)
    moved = np.stack([force, np.cumsum(force) * record.dt])[..., None]
    errors = errors_of(QUIET, record, rng) + moved
    box = Flexible.of(record, rollout)
    for part in parted(record):
        left = errors - box.foretold(errors, Whitener(part.fits, QUIET))
        before, after = (float((e[0, part.rows] ** 2).mean()) for e in (errors, left))
        noise = QUIET.process_sd**2 + QUIET.accel_sd**2
        # most of what is above the noise goes, on rows that it never saw
        assert after - noise < 0.5 * (before - noise)
