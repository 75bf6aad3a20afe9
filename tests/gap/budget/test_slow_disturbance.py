"""A slow random force is told from a car's own noise and from sensors' noise by the spectrum below 1 Hz."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.gap import Gust
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.slow_disturbance import slow_disturbance
from tests.bars import BAR
from tests.gap.budget.cars import log_of

T_L = 0.35
SECONDS = 600.0


def coloured(rng: np.random.Generator, rows: int, sd: float, time: float, dt: float) -> FloatArray:
    keep = np.exp(-dt / time)
    kicks = rng.normal(0.0, sd * np.sqrt(1 - keep**2), rows)
    kicks[0] = rng.normal(0.0, sd)
    return np.asarray(lfilter([1.0], [1.0, -keep], kicks))


def residuals(record: AnalysisRecord, seed: int, *, sd: float = 0.0, time: float = 3.0) -> FloatArray:
    """GLVD's own noise and a slow force in both channels, and each sensor's noise (channel, row) [m/s²]."""
    rng = np.random.default_rng(seed)
    force = coloured(rng, record.rows, 0.08, T_L, record.dt)
    if sd:
        force = force + coloured(rng, record.rows, sd, time, record.dt)
    read = rng.normal(0.0, 0.01, record.rows + 1)
    return force + np.stack([np.diff(read) / record.dt, rng.normal(0.0, 0.05, record.rows)])


@pytest.mark.statistical
def test_a_slow_force_is_found_with_its_size(rotating_seed: int) -> None:
    record = AnalysisRecord.of([log_of(seconds=SECONDS)])
    part = slow_disturbance(record, residuals(record, rotating_seed, sd=0.3), T_L, Gust)
    assert part is not None
    assert part.parameters is not None
    assert part.name == "gust"
    assert part.probability > 0.99
    # a force that lasts 3 s shows its variance T / (2 tau) times; the spectrum's other parts are as uncertain again
    independent = SECONDS / (2 * 3.0)
    assert part.parameters["sd_mps2"].mean == pytest.approx(0.3, rel=BAR * 2 / np.sqrt(2 * independent))
    assert part.share_of_noise is not None
    assert 0 < part.share_of_noise <= 1


@pytest.mark.slow
@pytest.mark.statistical
def test_a_cars_own_noise_is_no_slow_force(rotating_seed: int) -> None:
    """Twenty cars: if 1 in 100 had one named, four of twenty would less than once in 20,000 times."""
    record = AnalysisRecord.of([log_of(seconds=120.0)])
    found = [slow_disturbance(record, residuals(record, rotating_seed + k), T_L, Gust) for k in range(20)]
    assert sum(part is not None for part in found) < 4


@pytest.mark.slow
@pytest.mark.statistical
def test_noise_of_an_actuator_whose_lag_a_dead_time_hides_is_no_slow_force(rotating_seed: int) -> None:
    """Beside a dead time a fit had left 0.03 s of the lag of 0.35 s, and half of such cars had a gust by that alone.

    Eight cars: if 1 in 100 had one named, three of eight would less than once in 15,000 times.
    """
    record = AnalysisRecord.of([log_of(seconds=120.0)])
    noises = [residuals(record, rotating_seed + k) for k in range(8)]
    found = [slow_disturbance(record, noise, 0.03, Gust, bare_lag=T_L) for noise in noises]
    assert sum(part is not None for part in found) < 3


def test_rows_too_short_for_a_spectrum_say_nothing() -> None:
    record = AnalysisRecord.of([log_of(seconds=24.0)], block_s=1.0)
    assert slow_disturbance(record, np.zeros((2, record.rows)), T_L, Gust) is None
