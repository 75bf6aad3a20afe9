"""Errors of shape: laws of the energies and of the prior, and known errors found again."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.likelihood import claim_bands
from avtorch.gap.engine.priors import SHAPE_ERROR
from avtorch.gap.engine.shape_error import (
    RELATIVE_ERRORS,
    _geometric_mean,
    effect_energy,
    frame_energy,
    relative_size,
    shape_likelihood,
    shape_log_odds,
    shape_log_prior,
)

CHANNELS = [("accel", "speed"), ("speed",)]
both = pytest.mark.parametrize("channels", CHANNELS, ids="+".join)


@cache
def _data(channels: tuple[str, ...] = ("accel", "speed"), seconds: float = 200.0) -> DriveData:
    """Any drive: only the shape of its coefficients is used."""
    time = np.arange(0.0, seconds, 0.02)
    readings = {"accel": np.sin(time), "speed": 15.0 - np.cos(time)}
    return DriveData.of(Log.from_arrays(time=time, accel_cmd=np.sin(time), **{c: readings[c] for c in channels}))


def _noise(data: DriveData, random: np.random.Generator) -> FloatArray:
    """Coefficients (channel, frame, bin) of correlated noise of unit variance."""
    white = random.normal(size=data.measured.shape)
    return white if len(white) == 1 else np.stack([white[0], 0.6 * white[0] + 0.8 * white[1]])


def _burst(data: DriveData) -> FloatArray:
    """The change (channel, frame, bin) by an effect that acts strongly in every fifth frame, and below 3 Hz."""
    acting = (np.arange(data.frame_count) % 5 == 0)[:, None] * np.where(data.frequency < 3.0, 40.0, 0.0)
    return np.broadcast_to(acting, data.measured.shape).copy()


@pytest.mark.parametrize("effects", [[], ["rate_limit"], ["command_hold", "gust"]])
def test_prior_of_errors_is_a_decreasing_probability(effects: list[str]) -> None:
    prior = shape_log_prior(effects)
    assert np.exp(prior).sum() == pytest.approx(1.0)
    assert (np.diff(prior) < 0).all()


def test_messages_found_one_by_one_may_be_wrong_by_more() -> None:
    assert shape_log_prior(["command_hold"])[-1] > shape_log_prior(["dead_time"])[-1] + 1.0


@both
def test_frame_energy_adds_up_to_all_products(channels: tuple[str, ...], fresh_seed: int) -> None:
    data = _data(channels)
    x = _noise(data, np.random.default_rng(fresh_seed))
    total = np.einsum("fbij,b->ij", frame_energy(data, x), np.diff(data.band_edges))
    flat = x.reshape(len(x), -1)
    np.testing.assert_allclose(total, flat @ flat.T)


def test_effect_energy_spreads_and_loses_nothing(fresh_seed: int) -> None:
    data = _data()
    x = np.zeros_like(data.measured)
    x[:, 5, data.band_edges[9] : data.band_edges[10]] = np.random.default_rng(fresh_seed).normal()
    spread = effect_energy(data, x)
    np.testing.assert_allclose(spread.sum((0, 1)), frame_energy(data, x).sum((0, 1)))
    acting = spread[..., 0, 0] > 0
    assert acting[4:7, 8:11].all()
    assert acting.sum() == 9


@both
def test_exact_shape_has_no_error(channels: tuple[str, ...], fresh_seed: int) -> None:
    """Noise alone beside a strong effect: every error is less likely than none, the larger the less."""
    data = _data(channels)
    found = shape_likelihood(data, _noise(data, np.random.default_rng(fresh_seed)), effect_energy(data, _burst(data)))
    assert found is not None
    assert found.nats[0] == 0.0
    assert (np.diff(found.nats[-3:]) < 0).all()


@both
@pytest.mark.parametrize("error", [0.06, 0.24])
def test_known_error_is_found_with_the_noise_beside_it(
    channels: tuple[str, ...], error: float, fresh_seed: int
) -> None:
    """The residual is drawn from the model itself: where the effect acts, an error of 0.06 adds six times the noise's
    variance to some two hundred coefficients, so that doublings of it are dozens of nats apart."""
    data = _data(channels)
    random = np.random.default_rng(fresh_seed)
    noise, change = _noise(data, random), _burst(data)
    energy = effect_energy(data, change)
    bands = data.band_of_bin
    amplitude = np.sqrt(energy[:, bands, 0, 0])  # all channels alike in `_burst`
    found = shape_likelihood(data, noise + error * amplitude * random.normal(size=amplitude.shape), energy)
    assert found is not None
    assert RELATIVE_ERRORS[int(np.argmax(found.nats))] == error
    # the noise's own covariance: five standard errors of a variance from the counts that still measure it
    at = int(np.argmax(found.nats))
    expected = frame_energy(data, noise)[:, : claim_bands(data)].mean(0)
    for c in range(len(channels)):
        ratio = found.covariances[at, :, c, c] / expected[:, c, c]
        bar = 5.0 * np.sqrt(2.0 / found.counts[at])
        enough = found.counts[at] > 60  # below, a variance's law is too skewed for bars
        assert enough.sum() > 3
        assert (np.abs(np.log(ratio[enough])) < bar[enough]).all()


def test_unit_of_the_coefficients_does_not_matter(fresh_seed: int) -> None:
    data = _data()
    noise = _noise(data, np.random.default_rng(fresh_seed))
    one = shape_likelihood(data, noise, effect_energy(data, _burst(data)))
    other = shape_likelihood(data, 0.01 * noise, effect_energy(data, 0.01 * _burst(data)))
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.nats, other.nats, atol=1e-6)
    np.testing.assert_allclose(one.counts, other.counts, rtol=1e-6)


def test_every_step_raises_the_likelihood_up_to_where_its_slope_is_zero(fresh_seed: int) -> None:
    data = _data()
    random = np.random.default_rng(fresh_seed)
    noise, change = _noise(data, random), _burst(data)
    residual, energy = noise + 0.1 * change * random.normal(size=change.shape[1:]), effect_energy(data, change)
    steps = [shape_likelihood(data, residual, energy, n) for n in (0, 1, 3, 10, 30, 1000)]
    nats = np.array([s.nats for s in steps if s is not None])
    assert (np.diff(nats, axis=0) > -1e-6).all()
    assert nats[-1] == pytest.approx(nats[-2], abs=0.5, rel=0.01)  # what 30 steps promise
    assert steps[-1] is not None
    bands = claim_bands(data)
    # beside an error that is assumed to be larger than it is, no noise may be left: the slope is negative there
    for e, error in enumerate(RELATIVE_ERRORS[:4]):
        V = np.linalg.inv(steps[-1].covariances[e] + error**2 * energy[:, :bands])
        slope = (V @ frame_energy(data, residual)[:, :bands] @ V).mean(0) - V.mean(0)
        assert np.abs(slope).max() < 1e-4 * np.abs(V.mean(0)).max()


def test_without_an_effect_no_shape_is_wrong() -> None:
    data = _data()
    assert shape_likelihood(data, data.measured, None) is None
    silent = shape_likelihood(data, data.measured, np.zeros_like(frame_energy(data, data.measured)))
    assert silent is not None
    np.testing.assert_allclose(silent.nats, 0.0, atol=1e-6)
    np.testing.assert_allclose(silent.counts, np.broadcast_to(data.band_size[: claim_bands(data)], silent.counts.shape))


def test_bands_above_the_claim_do_not_count() -> None:
    data = _data()
    assert data.frequency[data.band_edges[claim_bands(data) - 1]] <= data.claim_hz
    assert data.frequency[data.band_edges[claim_bands(data)]] > data.claim_hz


@both
def test_relative_size_of_a_scaled_effect_is_its_factor(channels: tuple[str, ...], fresh_seed: int) -> None:
    data = _data(channels)
    random = np.random.default_rng(fresh_seed)
    change = _noise(data, random)
    factor = float(np.exp(random.normal()))
    covariance = np.cov(random.normal(size=(len(channels), 50))).reshape(1, len(channels), -1)
    covariance = np.repeat(covariance, data.band_count, 0)
    size = relative_size(data, covariance, factor * change, frame_energy(data, change))
    assert size == pytest.approx(factor)


def test_companion_is_an_error_of_shape_while_it_is_small() -> None:
    far = 40.0  # nats: the companion is there
    odds = [shape_log_odds(r, far, ["dead_time"]) for r in (0.02, 0.06, 0.12, 0.3, 1.0)]
    assert (np.diff(odds) < 0).all()
    assert odds[1] > 0 > odds[3]
    # even odds where the half-normal density is that of a size, one
    even = SHAPE_ERROR * math.sqrt(2 * math.log(math.sqrt(2 / math.pi) / SHAPE_ERROR))
    assert shape_log_odds(even, far, ["dead_time"]) == pytest.approx(0.0, abs=1e-9)
    assert shape_log_odds(0.3, far, ["command_hold"]) > odds[3]


@pytest.mark.parametrize("gain", [-3.0, 0.0, 2.0])
def test_what_is_not_seen_has_no_size_to_be_narrowed(gain: float) -> None:
    assert shape_log_odds(0.0, gain, []) == max(gain, 0.0)


def test_geometric_mean_solves_its_equation(fresh_seed: int) -> None:
    """G of P and Q is the one covariance with G P^-1 G = Q."""
    random = np.random.default_rng(fresh_seed)
    P, Q = (a @ a.T + 0.1 * np.eye(2) for a in random.normal(size=(2, 2, 2)))
    g = _geometric_mean(P[0, 0], P[0, 1], P[1, 1], Q[0, 0], Q[0, 1], Q[1, 1])
    G = np.array([[g[0], g[1]], [g[1], g[2]]])
    np.testing.assert_allclose(G @ np.linalg.inv(P) @ G, Q, rtol=1e-6, atol=1e-9)
