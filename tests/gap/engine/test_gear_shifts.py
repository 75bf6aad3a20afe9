"""Gear shifts: upshifts as the effect has them, gains held to simulated responses, and known speeds found again."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from avtorch import Log
from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap import GearShift
from avtorch.gap.engine.demand_filter import precision
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit, jacobian, objective, prior_terms
from avtorch.gap.engine.gear_shifts import (
    CAUSES_AFTER_S,
    CAUSES_BEFORE_S,
    LEAST_RATIO,
    LEVEL_STEP_MPS,
    _PulseLikelihood,
    dips_below,
    fit_with_speeds,
    refined_shift_speeds,
    shift_speeds,
    upshift_rows,
    upshift_times,
)
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.priors import SHIFT_NATS
from avtorch.gap.simulator.effect import EffectContext
from tests.bars import log_odds

DT, LAG, GAIN = 0.02, 0.3, 0.9
ACCEL_SD, SPEED_SD = 0.05, 0.01
SPEEDS, DEPTH, DURATION = (5.3, 8.1, 12.4), 0.7, 0.4


def _wandering_speed(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Times, a speed that rises and falls through a level of 5 m/s many times, and three stretches."""
    time = 0.01 * np.arange(n)
    speed = 5.0 + sum(
        rng.uniform(0.3, 1.5) * np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in (0.07, 0.19, 0.41, 0.9)
    )
    starts = np.zeros(n, bool)
    starts[[0, n // 3, n // 2]] = True
    return time, np.asarray(speed), starts


# upshifts ------------------------------------------------------------------------------------------------------------
def test_interruptions_are_those_of_the_effect(fresh_seed: int) -> None:
    """The share of each row's demand that is lost, at rows as close as the plant's grid."""
    rng = np.random.default_rng(fresh_seed)
    time, speed, _ = _wandering_speed(rng, 4000)
    command = np.ones(len(time))
    h = Hypothesis(DriveData.of(Log.from_arrays(time=time, accel_cmd=command, accel=command, speed=speed)))
    h["K_L"] = 1.0
    data = h.evaluate().data
    likelihood = _PulseLikelihood.of(h)
    level, rearm, duration = 5.1, float(rng.uniform(0.2, 1.2)), float(rng.uniform(0.1, 0.6))
    pulses = likelihood.pulses(likelihood.upshifts(level, rearm), duration)
    lost = np.zeros(len(data.time))
    np.maximum.at(lost, pulses.rows, pulses.values)
    effect = GearShift(1.0, duration, speeds=(level,), rearm_mps=rearm)
    steps = torch.as_tensor(np.diff(data.time, append=data.time[-1] + 0.01))
    one = torch.ones(1, dtype=torch.float64)
    row = EffectContext(torch.as_tensor(data.time), steps, torch.as_tensor(data.smooth_speed), None, one, one)
    factor, _ = effect.over(torch.as_tensor(data.command), row)
    # the last row has no step
    np.testing.assert_allclose(1 - lost[:-1], factor.numpy()[:-1], rtol=0, atol=1e-9)


def test_upshifts_are_first_rises_and_dips_that_rearm(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    for _ in range(10):
        time, speed, starts = _wandering_speed(rng, 6000)
        level = float(rng.uniform(4.0, 6.0))
        dips = dips_below(speed, starts, level)
        bounds = np.append(np.flatnonzero(starts), len(speed))
        rises = sum(speed[i] <= level < speed[i:j].max() for i, j in pairwise(bounds.tolist()))
        for hysteresis in (0.0, *rng.uniform(0.0, 3.0, 5)):
            times = upshift_times(time, speed, starts, level, hysteresis)
            assert len(times) == rises + np.count_nonzero(dips >= hysteresis)
            # between rows the speed is linear
            np.testing.assert_allclose(np.interp(times, time, speed), level, atol=1e-9)
            assert (np.diff(times) > 0).all()


# gains ---------------------------------------------------------------------------------------------------------------
def _log(rng: np.random.Generator, speeds: tuple[float, ...] = SPEEDS, rearm: float = 0.8) -> Log:
    """120 s of a car that pulls up and slows down between 3 and 16 m/s, in steps of 2 ms."""
    fine, per_row, n = 0.002, 10, 6000
    a, v, keep = 0.0, 4.0, np.exp(-fine / LAG)
    above, since = [v > s for s in speeds], -1e9
    command, accel, speed = np.empty(n), np.empty(n), np.empty(n)
    u, goal = -1.0, 20.0
    for k in range(n):
        t = k * DT
        if (goal - v) * u <= 0:
            goal = v + rng.uniform(3.0, 9.0) if u < 0 else max(v - rng.uniform(1.0, 9.0), 3.0)
            goal = goal if goal < 15.0 else 15.0
            u = np.sign(goal - v) * rng.uniform(0.8, 1.6)
        command[k], accel[k], speed[k] = u, a, v
        for m in range(per_row):
            now = t + m * fine
            for g, s in enumerate(speeds):
                if v > s and not above[g]:
                    above[g], since = True, now
                above[g] = above[g] and v > s - rearm
            target = GAIN * u * (1 - DEPTH * (u > 0 and now - since < DURATION))
            after = target + keep * (a - target)
            v += 0.5 * fine * (a + after)
            a = after
    return Log.from_arrays(
        time=DT * np.arange(n),
        accel_cmd=command,
        accel=accel + rng.normal(0.0, ACCEL_SD, n),
        speed=speed + rng.normal(0.0, SPEED_SD, n),
    )


def _fitted(log: Log) -> Hypothesis:
    return fit(Hypothesis(DriveData.of(log)), 8)


def _with_shifts(h: Hypothesis, speeds: FloatArray) -> Hypothesis:
    new = h.copy()
    new.shift_speeds = speeds
    return fit(new.with_effect("gear_shift", (0.6, 0.35)), 6)


def test_gains_are_those_of_the_simulated_response(fresh_seed: int) -> None:
    h = _fitted(_log(np.random.default_rng(fresh_seed)))
    likelihood = _PulseLikelihood.of(h)
    weights = precision(h.data, h.covariance)

    def inner(x: FloatArray, y: FloatArray) -> float:
        return float(np.einsum("cfk,kce,efk->", x, weights, y))

    J = jacobian(h, h.free)
    prior, pull = prior_terms(h, h.free)
    N = np.array([[inner(a, b) for b in J] for a in J]) + np.diag(prior)
    taken = np.linalg.solve(N, np.array([inner(j, h.residual) for j in J]) + pull)
    sizes, expected = 0.0, 0.0
    for level in (5.3, 7.0, 9.1, 12.4):
        new = h.copy()
        new.shift_speeds = np.array([level])
        new["shift_depth"], new["shift_duration"] = 1.0, 0.35
        change = new.response() - h.predicted
        across = np.array([inner(j, change) for j in J])
        slope = inner(change, h.residual) - float(across @ taken)
        size = inner(change, change) - float(across @ np.linalg.solve(N, across))
        pulses = likelihood.pulses(likelihood.upshifts(level, h["shift_hysteresis"]), 0.35)
        # log L along the response is off by less than a tenth of the noise that it has anyhow
        assert abs(likelihood.gain(likelihood.score, pulses) - slope) <= 0.1 * np.sqrt(size)
        sizes += pulses.size
        expected += size
    # the information is the mean over the places of pulses in frames: 25 % each, of some 20 upshifts
    assert sizes == pytest.approx(expected, rel=0.25)


def test_taking_pulses_out_leaves_the_score_beside_them(fresh_seed: int) -> None:
    h = _fitted(_log(np.random.default_rng(fresh_seed)))
    likelihood = _PulseLikelihood.of(h)
    pulses = likelihood.pulses(likelihood.upshifts(8.1, 0.8), 0.4)
    score = likelihood.score.copy()
    likelihood.take_out(score, pulses, 0.3)
    fallen = likelihood.gain(likelihood.score, pulses) - likelihood.gain(score, pulses)
    assert fallen == pytest.approx(0.3 * pulses.size, rel=1e-9)
    likelihood.take_out(score, pulses, -0.3)
    np.testing.assert_allclose(score, likelihood.score, atol=1e-9 * np.abs(score).max())


# speeds --------------------------------------------------------------------------------------------------------------
@pytest.mark.statistical
def test_shift_speeds_are_found(rotating_seed: int) -> None:
    h = _fitted(_log(np.random.default_rng(rotating_seed)))
    speeds, nats = shift_speeds(h)
    data = h.data
    for true in SPEEDS:
        passed = len(upshift_times(data.time, data.smooth_speed, data.starts, true, h["shift_hysteresis"]))
        # a step apart, and by as much as the car gains until the plant's next step; once or twice is lost in noise
        assert passed < 3 or np.abs(speeds - true).min() < LEVEL_STEP_MPS + 0.03
    assert len(speeds) <= len(SPEEDS) + 1
    assert nats > log_odds(400)
    # it holds against the noise of the better model, too
    assert _with_shifts(h, speeds).log_likelihood - h.log_likelihood > nats


@pytest.mark.statistical
def test_a_car_without_gears_has_no_shift_speeds(rotating_seed: int) -> None:
    h = _fitted(_log(np.random.default_rng(rotating_seed), speeds=()))
    speeds, nats = shift_speeds(h)
    # some hundred candidates and four durations, of which neighbours see the same noise
    assert nats < log_odds(400)
    assert len(speeds) <= 2


@pytest.mark.statistical
@pytest.mark.parametrize("off", [None, (0.1, -0.1, 0.1)], ids=["as found", "off"])
def test_refinement_finds_the_speeds_and_when_gears_rearm(
    rotating_seed: int, off: tuple[float, float, float] | None
) -> None:
    rearm = 2.0
    h = _fitted(_log(np.random.default_rng(rotating_seed), rearm=rearm))
    begun = _with_shifts(h, shift_speeds(h)[0] if off is None else np.array(SPEEDS) + off)
    found = refined_shift_speeds(begun)
    assert found.log_likelihood > begun.log_likelihood
    # as good as a fit from the truth, but for a speed or two that the car hardly passes and that are not worth their
    # price, and for an optimum a little beside
    truth = h.copy()
    truth.shift_speeds = np.array(SPEEDS)
    truth["shift_hysteresis"] = rearm
    truth = fit_with_speeds(truth.with_effect("gear_shift", (DEPTH, DURATION)), 8)
    assert found.log_likelihood > truth.log_likelihood - 2 * SHIFT_NATS - 0.02 * (
        truth.log_likelihood - h.log_likelihood
    )
    # an interruption of 0.4 s is placed to some hundredths of a second, at 1 m/s²
    assert np.abs(found.shift_speeds[:, None] - SPEEDS).min(1).max() < 0.08
    assert found["shift_depth"] == pytest.approx(DEPTH, abs=0.08)
    assert found["shift_duration"] == pytest.approx(DURATION, abs=0.05)


@pytest.mark.statistical
def test_refinement_drops_a_speed_that_is_none(rotating_seed: int) -> None:
    h = _fitted(_log(np.random.default_rng(rotating_seed)))
    begun = _with_shifts(h, np.array([*SPEEDS, 10.1]))
    found = refined_shift_speeds(begun)
    assert np.abs(found.shift_speeds - 10.1).min() > 1.0
    assert (found.shift_speeds[1:] / found.shift_speeds[:-1] >= LEAST_RATIO).all()
    assert found.log_likelihood > h.log_likelihood + log_odds(400)
    assert (begun.shift_speeds == [*SPEEDS, 10.1]).all()  # the hypothesis itself stays as it was


def test_speeds_are_fitted_together_with_the_duration(fresh_seed: int) -> None:
    h = _fitted(_log(np.random.default_rng(fresh_seed)))
    begun = _with_shifts(h, np.array(SPEEDS) - 0.1)
    found = fit_with_speeds(begun)
    assert objective(found) >= objective(begun)
    assert begun.shift_speeds == pytest.approx(np.array(SPEEDS) - 0.1)


def test_a_drive_without_speed_has_no_shift_speeds() -> None:
    log = _log(np.random.default_rng(0))
    h = _fitted(Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=log.accel))
    speeds, nats = shift_speeds(h)
    assert len(speeds) == 0
    assert nats == 0.0


def test_rows_around_upshifts() -> None:
    h = _fitted(_log(np.random.default_rng(0)))
    data = h.data
    rows = upshift_rows(data, np.array(SPEEDS))
    times = [upshift_times(data.time, data.smooth_speed, data.starts, s, h["shift_hysteresis"]) for s in SPEEDS]
    distance = data.time[:, None] - np.concatenate(times)
    expected = ((distance >= -CAUSES_BEFORE_S) & (distance < CAUSES_AFTER_S)).any(1)
    np.testing.assert_array_equal(rows, expected)
    assert not upshift_rows(data, np.zeros(0)).any()
