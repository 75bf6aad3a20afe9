"""The matched filter for pulses of the demand, held to simulated responses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.gap.engine.demand_filter import (
    demand_information,
    demand_score,
    frame_cover,
    information_of_coefficients,
    precision,
    pulse_energy,
    take_out,
)
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis

DT, LAG = 0.02, 0.3


def _hypothesis(rng: np.random.Generator, *, both: bool = True) -> Hypothesis:
    """A fitted car with coloured noise, driven by steps, behind a recorder that makes both channels late."""
    time = np.arange(0.0, 100.0, DT)
    levels = rng.normal(0.0, 1.0, len(time) // 200)
    command = np.repeat(np.stack([levels, -levels], 1).ravel(), 100)  # the speed stays near its start
    keep, accel = np.exp(-DT / LAG), np.zeros(len(time))
    for k in range(1, len(time)):
        accel[k] = command[k - 1] + keep * (accel[k - 1] - command[k - 1])
    speed = 30.0 + np.concatenate([[0.0], np.cumsum(0.5 * (accel[1:] + accel[:-1]) * DT)])
    noise = np.convolve(rng.normal(0.0, 0.1, len(time)), [0.5, 0.5], "same")
    speed = np.interp(time - 0.03, time, speed) + rng.normal(0.0, 0.01, len(time))
    log = Log.from_arrays(time=time, accel_cmd=command, accel=accel + noise, speed=speed if both else None)
    h = Hypothesis(DriveData.of(log))
    return fit(h, 6)


def _inner(h: Hypothesis, x: FloatArray, y: FloatArray) -> float:
    return float(np.einsum("cfk,kce,efk->", x, precision(h.data, h.covariance), y))


@pytest.mark.parametrize(("both", "dead_time"), [(True, 0.0), (False, 0.0), (True, 0.13)])
def test_score_and_information_are_those_of_the_simulated_response(
    fresh_seed: int, both: bool, dead_time: float
) -> None:
    rng = np.random.default_rng(fresh_seed)
    h = _hypothesis(rng, both=both)
    if dead_time:
        h = h.with_effect("dead_time", (dead_time,)).evaluate()
    data = h.data
    score = demand_score(h, h.covariance, h.residual)
    information = demand_information(h, h.covariance, 100)
    steps = np.flatnonzero(np.diff(data.command)) + 1
    ends = data.frames[0][0] + data.frame_rows * np.array([1, data.frames[0][1]])
    sizes, expected = [], []
    for first in steps[(steps > ends[0]) & (steps < ends[1] - 100)]:
        lasts = int(rng.integers(3, 25))
        held = h.copy()
        held.lost = ((int(first), int(first) + lasts),)
        change = held.response() - h.predicted
        pulse = h["K_L"] * (data.command[first - 1] - data.command[first : first + lasts])
        sizes.append(float(pulse @ toeplitz(information[:lasts]) @ pulse))
        expected.append(_inner(h, change, change))
        # log L along the response is off by less than a sixth of the noise that it has anyhow, most where a dead time
        # moves the residual, which the plant reads between the points of its grid
        slope = float(pulse @ score[first : first + lasts])
        assert abs(slope - _inner(h, change, h.residual)) < 0.15 * np.sqrt(expected[-1])
    # Pulse by pulse the information is the mean over where in a frame one may lie, by some 25 % of its size, and its
    # bands have edges, which give it up to 10 % too much: the mean of the logarithms was -0.09 to 0.11 over 120 drives.
    assert abs(np.log(np.array(sizes) / expected).mean()) < 0.2


def test_scores_of_many_columns_are_those_of_each(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    h = _hypothesis(rng)
    columns = rng.normal(size=(3, *h.residual.shape))
    together = demand_score(h, h.covariance, columns)
    for row, column in zip(together, columns, strict=True):
        np.testing.assert_allclose(row, demand_score(h, h.covariance, column), rtol=1e-12, atol=1e-12)
    normal, gradient = information_of_coefficients(h.data, h.covariance, columns, h.residual)
    expected = [[_inner(h, a, b) for b in columns] for a in columns]
    np.testing.assert_allclose(normal, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(gradient, [_inner(h, a, h.residual) for a in columns], rtol=1e-7)


def test_take_out_is_the_product_with_the_information(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    n, rows = 40, np.array([3, 4, 33, 34, 39])
    information, cover, pulse = rng.normal(size=9), rng.random(n), rng.normal(size=5)
    score = rng.normal(size=n)
    whole = np.zeros(n)
    whole[rows] = pulse
    dense = cover[:, None] * toeplitz(np.concatenate([information, np.zeros(n - 9)])) * cover
    beside = score.copy()
    take_out(beside, information, cover, rows, pulse, 1.0)
    np.testing.assert_allclose(beside, score - dense @ whole, atol=1e-12)
    take_out(beside, information, cover, rows, pulse, -1.0)
    np.testing.assert_allclose(beside, score, atol=1e-12)
    assert pulse_energy(information, cover, rows, pulse) == pytest.approx(whole @ dense @ whole, abs=1e-12)


def test_frames_see_the_middle_and_no_end_of_a_stretch() -> None:
    h = _hypothesis(np.random.default_rng(0))
    cover, data = frame_cover(h), h.data
    first, count = data.frames[0]
    M = data.frame_rows
    np.testing.assert_allclose(cover[first + M : first + count * M], 1.0)
    assert cover[: first - 100].max() == 0.0
    # what begins before the frames and lasts into them is seen by a little of their first window
    assert 0.0 < cover[first - 5] < np.sin(0.5 * np.pi * 3 * h["T_L"] / (M * DT)) + 1e-9
    assert ((cover >= 0.0) & (cover <= 1.0)).all()
