"""The noise model found again in errors drawn from it."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.noise_fit import GUST, PRIORS, Prior, fit_noise
from avtorch.gap.likelihood.noise_model import NAMES, NoiseModel
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from tests.gap.records import BOTH, errors_of, log_of, record_of


def _drawn(rng: np.random.Generator, priors: dict[str, Prior], T_L: float) -> NoiseModel:
    """A noise model from the middle of the priors."""
    values = {n: float(np.exp(m + s * rng.uniform(-1, 1))) for n, (m, s, _) in priors.items()}
    values["process_time"] *= T_L
    return NoiseModel(**values)


def _log_posterior(
    noise: NoiseModel, record: Record, errors: FloatArray, priors: dict[str, Prior], T_L: float
) -> float:
    centres = {n: m + (np.log(T_L) if n == "process_time" else 0.0) for n, (m, _, _) in priors.items()}
    z = np.array([(np.log(getattr(noise, n)) - centres[n]) / priors[n][1] for n in NAMES])
    return float(WhiteningFilter(record, noise).row_likelihoods(errors).sum() - 0.5 * z @ z)


def _away(fit, truth: NoiseModel) -> FloatArray:  # type: ignore[no-untyped-def]
    """By parameter, in its own standard deviations."""
    return np.array([np.log(getattr(fit.noise, n) / getattr(truth, n)) / fit.sds[n] for n in NAMES])


@pytest.mark.statistical
@pytest.mark.parametrize("channels", [BOTH, ("accel",), ("speed",)])
@pytest.mark.parametrize("priors", [PRIORS, GUST], ids=["nuisance", "gust"])
def test_parameters_are_found_within_their_own_bars(
    priors: dict[str, Prior], channels: tuple[str, ...], rotating_seed: int
) -> None:
    rng = np.random.default_rng(rotating_seed)
    record = record_of(120.0, noise=None, channels=channels)
    away, deeper = [], []
    for _ in range(4):
        T_L = float(np.exp(rng.uniform(np.log(0.15), np.log(0.9))))
        truth = _drawn(rng, priors, T_L)
        errors = errors_of(truth, record, rng)
        # started at the truth: the next test starts from afar
        fit = fit_noise(record, errors, truth, T_L=T_L, priors=priors, iterations=12)
        away.append(_away(fit, truth))
        here, there = (_log_posterior(n, record, errors, priors, T_L) for n in (fit.noise, truth))
        deeper.append(here - there)
    # twice this is a chi-squared of six, whatever the posterior's shape: beyond 50 once in 10⁸ fits
    assert min(deeper) >= 0
    assert max(deeper) < 25
    # sds are of squared scores, right to some 10 %; the mode of a parameter hardly seen is the prior's. Where only the
    # speed is seen, process and force can trade places: two modes, and the bars are of one. Hence no more than four.
    assert np.sqrt((np.clip(away, -4, 4) ** 2).mean()) < 2.0


@pytest.mark.slow
@pytest.mark.statistical
def test_the_mode_is_found_from_afar(rotating_seed: int) -> None:
    """From the usual start, whatever the sensors are: never thousands of nats short."""
    rng = np.random.default_rng(rotating_seed)
    record = record_of(120.0, noise=None)
    short = []
    for seed in [13, 60, 82, *rng.integers(2**31, size=12).tolist()]:
        own = np.random.default_rng(seed)
        T_L = float(np.exp(own.normal(np.log(0.3), 0.5)))
        values = {
            n: float(np.exp(m + s * x))
            for (n, (m, s, _)), x in zip(PRIORS.items(), own.uniform(-1.2, 1.2, 6), strict=True)
        }
        truth = NoiseModel(**values).replaced(process_time=values["process_time"] * T_L)
        errors = errors_of(truth, record, own)
        near = fit_noise(record, errors, truth, T_L=T_L, iterations=12).rows.sum()
        short.append(near - fit_noise(record, errors, NoiseModel(), T_L=T_L, iterations=12).rows.sum())
    assert max(short) < 2.0


@pytest.mark.statistical
def test_well_observed_noise_is_estimated_well(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    record = record_of(120.0, noise=None)
    truth = NoiseModel(process_sd=0.08, process_time=0.4, force_sd=0.005, accel_sd=0.06, speed_sd=0.03)
    fit = fit_noise(record, errors_of(truth, record, rng), NoiseModel(), T_L=0.4, iterations=12)
    assert fit.sds["accel_sd"] < 0.04
    assert fit.sds["speed_sd"] < 0.04
    assert fit.sds["process_sd"] < 0.15
    # the prior alone determines the nuisance's size, and its interval is as wide as the prior's
    assert 0.2 < fit.sds["force_sd"] < 0.6
    assert np.abs(_away(fit, truth)).max() < 7


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_row_likelihoods_sum_to_the_whole(rate_hz: int, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    record = Record.of(log_of(seconds=22.0, rate_hz=rate_hz))
    noise = NoiseModel()
    errors = errors_of(noise, record, rng) + 0.04 * rng.standard_normal((2, record.rows, record.group))
    rows = WhiteningFilter(record, noise).row_likelihoods(errors)
    assert rows.shape == (record.rows,)
    assert rows.sum() == pytest.approx(float(WhiteningFilter(record, noise).log_likelihood(errors)))
    fit = fit_noise(record, errors, noise, T_L=0.35)
    np.testing.assert_allclose(fit.rows, WhiteningFilter(record, fit.noise).row_likelihoods(errors), rtol=0, atol=1e-8)
