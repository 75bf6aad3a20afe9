"""The innovations filter against a dense Gaussian whose covariance is written down directly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.gap.innovations import NoiseModel, Whitener
from avtorch.gap.record import Record
from tests.gap.records import BOTH, Float, dense_covariance, errors_of, log_normal_density, log_of, record_of

NOISES = {
    "usual": NoiseModel(),
    "windy": NoiseModel(force_sd=0.15, force_time=2.0),
    "good accelerometer": NoiseModel(accel_sd=0.01, speed_sd=0.1),
    "slow car": NoiseModel(process_sd=0.1, process_time=0.9),
}
WITNESSES = [BOTH, ("accel",), ("speed",)]
_WIDE = 1e3


def _dense(noise: NoiseModel, record: Record, errors: Float) -> float:
    """Exact log density, an offset of the speed under a flat prior of height 1 / sqrt(2 pi) in each stretch."""
    total = 0.0
    for first, last in zip(record.starts, [*record.starts[1:], record.rows], strict=True):
        time = np.arange(last - first) * record.dt
        wide = dense_covariance(noise, time, record.witnesses, offset_sd=_WIDE)
        total += log_normal_density(errors[:, first:last, 0].ravel(), wide)
        total += np.log(_WIDE) if "speed" in record.witnesses else 0.0
    return total


@pytest.mark.parametrize("witnesses", WITNESSES)
@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
def test_log_likelihood_is_the_dense_gaussians(
    noise: NoiseModel, witnesses: tuple[str, ...], rotating_seed: int
) -> None:
    rng = np.random.default_rng(rotating_seed)
    record = record_of(18.0, witnesses=witnesses)
    errors = errors_of(noise, record, rng)
    got = float(Whitener(record, noise).log_likelihood(errors))
    # the filter starts settled instead of knowing nothing of the forces: some 1 nat in the mean, 3 at random
    assert got == pytest.approx(_dense(noise, record, errors), abs=40.0)


@pytest.mark.parametrize("witnesses", WITNESSES)
@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
def test_beyond_the_start_the_likelihood_is_exact(
    noise: NoiseModel, witnesses: tuple[str, ...], rotating_seed: int
) -> None:
    rng = np.random.default_rng(rotating_seed)
    long, short = record_of(24.0, witnesses=witnesses), record_of(12.0, witnesses=witnesses)
    errors = errors_of(noise, long, rng)
    head = errors[:, : short.rows]
    got = Whitener(long, noise).log_likelihood(errors) - Whitener(short, noise).log_likelihood(head)
    assert float(got) == pytest.approx(_dense(noise, long, errors) - _dense(noise, short, head), abs=0.05)


@pytest.mark.parametrize("witnesses", WITNESSES)
def test_errors_of_the_model_become_white(witnesses: tuple[str, ...], rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    noise = NOISES["windy"]
    record = record_of(300.0, witnesses=witnesses, noise=None)
    e = Whitener(record, noise)(errors_of(noise, record, rng))[..., 0]
    n, kinds = record.rows, len(witnesses)
    # 5 standard errors of a mean square and of a lagged product of white noise
    assert (e**2).mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / (n * kinds)))
    for lag in (1, 2, 5, 20, 100):
        for i in range(kinds):
            for j in range(kinds):
                assert abs((e[i, lag:] * e[j, :-lag]).mean()) < 5.5 / np.sqrt(n - lag)
    assert all(abs((e[0] * e[j]).mean()) < 5 / np.sqrt(n) for j in range(1, kinds))


def test_stretches_are_independent_and_each_has_an_offset(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    noise = NOISES["usual"]
    log = log_of(seconds=50.0)
    engaged = (log.time < 20) | (log.time > 28)
    record = Record.of(replace(log, engaged=engaged))
    assert len(record.starts) == 2
    errors = errors_of(noise, record, rng)
    white = Whitener(record, noise)
    assert float(white.log_likelihood(errors)) == pytest.approx(_dense(noise, record, errors), abs=12.0)
    moved = errors.copy()
    moved[1, : record.starts[1]] += 3.0
    moved[1, record.starts[1] :] -= 2.0
    np.testing.assert_allclose(white(moved), white(errors), atol=1e-9)
    # what happened in the first stretch is forgotten in the second, but for some hundredths of a standard deviation
    other = errors.copy()
    other[:, : record.starts[1]] = errors_of(noise, record, rng)[:, : record.starts[1]]
    apart = white(other) - white(errors)
    assert np.abs(apart[:, record.starts[1] :]).max() < 0.15


def test_a_batch_is_its_members(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    record = record_of(12.0)
    white = Whitener(record, NoiseModel())
    batch = np.stack([errors_of(NoiseModel(), record, rng) for _ in range(3)])
    kept = batch.copy()
    together = white(batch)
    np.testing.assert_array_equal(batch, kept)  # what it is given it leaves alone
    for one, image in zip(batch, together, strict=True):
        np.testing.assert_allclose(white(one), image, rtol=0, atol=1e-9)
    np.testing.assert_allclose(white.log_likelihood(batch), [white.log_likelihood(one) for one in batch])


def test_the_response_is_the_filter_on_the_first_rows(rotating_seed: int) -> None:
    record = record_of(12.0)
    white = Whitener(record, NoiseModel())
    unit = np.random.default_rng(rotating_seed).standard_normal((2, record.rows))
    unit[1] -= unit[1, 0]
    raw = white.response(unit)
    again = white(unit[..., None])[..., 0]
    # the same but for the offset, which only the call projects out
    image = white.response(np.stack([np.zeros(record.rows), np.ones(record.rows)]))
    part = (raw * image).sum() / (image**2).sum()
    np.testing.assert_allclose(again, raw - part * image, atol=1e-9)


def test_rows_in_groups_count_by_their_mean_and_by_what_they_differ(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    group, within = 5, (0.07, 0.03)
    grouped = Record.of(log_of(seconds=16.0, rate_hz=100))
    assert grouped.group == group
    assert grouped.dt == pytest.approx(0.05)
    noise = replace(NOISES["usual"], within=within)
    means = errors_of(noise, grouped, rng)
    apart = rng.standard_normal((2, grouped.rows, group)) * np.array(within)[:, None, None]
    apart -= apart.mean(-1, keepdims=True)
    errors = means + apart
    white = Whitener(grouped, noise)
    e = white(errors)
    assert e.shape == (2, grouped.rows, 1 + group)
    alone = Whitener(grouped, replace(noise, within=None))
    np.testing.assert_allclose(e[..., :1], alone(means), atol=1e-9)
    # white differences of a group have `group - 1` degrees of freedom; by QR, contrasts of unit length
    contrasts = np.linalg.qr(np.column_stack([np.ones(group), np.eye(group)[:, 1:]]))[0][:, 1:]
    exact = float(alone.log_likelihood(means))
    for x, sd in zip(errors, within, strict=True):
        c = x @ contrasts
        exact += float((-0.5 * (c / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi)).sum())
    assert float(white.log_likelihood(errors)) == pytest.approx(exact, abs=1e-6)
    # errors of group 1, of a coarse rollout, pass without that part
    assert white(means).shape == (2, grouped.rows, 1)
