"""Lost messages: found where they are, with their fraction, and claimed neither by chance nor by another cause."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
import torch

from avtorch.arrays import FloatArray
from avtorch.gap import CommandHold, DeadTime, Effect, RateLimit, Saturation, SimulatorInput, plant
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_fit import fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.lost_messages import LossHistories, LostMessages, lost_messages
from avtorch.io import Log
from tests.bars import BAR
from tests.gap.records import command_over, drawn_errors

NOISE = NoiseModel(process_sd=0.03, process_time=0.3, force_sd=0.003, accel_sd=0.03, speed_sd=0.01)
BARE = {"T_L": 0.3, "K_L": 1.0}


def _record(
    command: FloatArray, effects: Sequence[Effect], rng: np.random.Generator, rate_hz: int, **more: FloatArray
) -> Record:
    time = np.arange(len(command)) / rate_hz
    speed = torch.full((len(time),), 20.0, dtype=torch.float64)
    drive = SimulatorInput(torch.as_tensor(time), torch.as_tensor(command), speed, 0.0)
    response = plant(effects).response(drive, generator=torch.Generator().manual_seed(int(rng.integers(2**31))))
    errors = drawn_errors(NOISE, len(time), 1 / rate_hz, rng)
    accel, speeds = response.accel_measured.numpy() + errors[0], response.speed.numpy() + errors[1]
    return Record.of(Log.from_arrays(time=time, accel_cmd=command, accel=accel, speed=speeds, **more), rate_hz=1e9)


def _found(
    command: FloatArray, fraction: float, rng: np.random.Generator, rate_hz: int, **more: FloatArray
) -> LostMessages:
    """What is found on a drive of which `fraction` of the messages are lost, under its own lag and noise."""
    record = _record(command, [CommandHold(fraction)] if fraction else [], rng, rate_hz, **more)
    none = Hypothesis.named(record, "none", plant())
    errors = none.errors(none.z_of(BARE)[None])[0]
    return lost_messages(WhiteningFilter(record, NOISE), errors, record.command[record.source], **BARE)


def _steps(rng: np.random.Generator, rate_hz: int, seconds: float = 100.0) -> FloatArray:
    return np.repeat(rng.uniform(-1, 1, round(2 * seconds)), round(0.5 * rate_hz))


def _smooth(rate_hz: int, seconds: float = 100.0) -> FloatArray:
    return command_over(np.arange(round(seconds * rate_hz)) / rate_hz)


@pytest.mark.statistical
def test_likelihoods_are_those_of_all_ways_to_lose_messages(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    apart = np.array([_bank_and_sum(rng) for _ in range(5)])
    # six paths stand for 8192 ways: off by more than 0.25 in one drive of 150, so the middle of five in one of 300 000
    assert np.median(np.abs(apart), 0).max() < 0.25


def _bank_and_sum(rng: np.random.Generator) -> list[float]:
    """By how much [nats] the bank is off the sum over all ways, at two fractions."""
    first, moving, rows = 200, 6, 13
    command = np.zeros(400)
    command[first : first + moving] = rng.uniform(-0.7, 0.7, moving)
    command[first + moving :] = command[first + moving - 1]
    record = _record(command, [CommandHold(0.3)], rng, 20)
    none = Hypothesis.named(record, "none", plant())
    errors = none.errors(none.z_of(BARE)[None])[0]
    white = WhiteningFilter(record, NOISE)
    u = record.command[record.source]
    start = int(np.flatnonzero(u)[0])
    # every way, and how far the command then is from the one logged
    ways = np.array(list(product([False, True], repeat=rows)))
    apart = np.zeros((len(ways), rows))
    held = np.full(len(ways), u[start - 1])
    for k in range(rows):
        held = np.where(ways[:, k], held, u[start + k])
        apart[:, k] = held - u[start + k]
    # the white image of each row's command, from rollouts
    drive = record.drives[0]
    pulses = np.zeros((rows, len(command)))
    pulses[np.arange(rows), record.source[start] + np.arange(rows)] = 1.0
    still = torch.zeros(len(command), dtype=torch.float64)
    unit = plant().response(SimulatorInput(drive.time, torch.as_tensor(pulses), still, 0.0))
    seen = np.stack([unit.accel.numpy(), unit.speed.numpy()], 1)[:, :, record.source, None]
    images = white(seen)[..., 0].reshape(rows, -1)
    match, square = images @ white(errors).ravel(), images @ images.T
    gains = apart @ match - 0.5 * ((apart @ square) * apart).sum(1)
    bank = LossHistories.of(white, white(errors)[..., 0], u, **BARE)
    lost, out = ways.sum(1), []
    for p in (0.05, 0.3):
        exact = np.logaddexp.reduce(gains + lost * np.log(p) + (rows - lost) * np.log1p(-p))
        out.append(float(bank.ratios(np.array([p])).sum() - exact))
    return out


@pytest.mark.statistical
@pytest.mark.parametrize(("rate_hz", "least"), [(20, 40.0), (50, 0.0)])
def test_lost_messages_are_found_where_the_command_steps(rate_hz: int, least: float, rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = [_found(_steps(rng, rate_hz), 0.15, rng, rate_hz) for _ in range(4)]
    assert min(f.evidence for f in found) > least / 6
    assert np.mean([f.evidence for f in found]) > least
    away = [(np.log(f.fraction / (1 - f.fraction)) - np.log(0.15 / 0.85)) / f.sd for f in found]
    assert np.abs(away).max() < BAR


@pytest.mark.statistical
@pytest.mark.slow
def test_a_command_that_also_drifts_hides_no_losses(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = [_found(_smooth(20, 400.0), 0.15, rng, 20) for _ in range(4)]
    assert np.mean([f.evidence for f in found]) > 30
    away = [(np.log(f.fraction / (1 - f.fraction)) - np.log(0.15 / 0.85)) / f.sd for f in found]
    assert np.abs(away).max() < BAR
    assert np.mean([f.fraction for f in found]) == pytest.approx(0.15, rel=0.5)


@pytest.mark.slow
@pytest.mark.statistical
def test_messages_that_all_arrive_are_not_lost(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    evidence = []
    for i in range(12):
        rate_hz = (20, 50)[i % 2]
        command = _smooth(rate_hz, 60.0) if i % 4 < 2 else _steps(rng, rate_hz, 60.0)
        evidence.append(_found(command, 0.0, rng, rate_hz).evidence)
    # the likelihood ratio has mean 1, so x nats come by chance in at most exp(-x) of drives: one of twelve reaches 14,
    # or two of them 8, in less than one run of 100 000
    largest = sorted(evidence)[::-1]
    assert largest[0] < 14
    assert largest[1] < 8


@pytest.mark.statistical
def test_losses_from_a_moment_on(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    at, onsets = 1000, []
    for _ in range(5):
        command = _steps(rng, 20)
        before, after = (_record(command, effects, rng, 20) for effects in ([], [CommandHold(0.3)]))
        none = Hypothesis.named(before, "none", plant())
        errors = before.measured - none.rollouts(none.z_of(BARE)[None])[0]
        more = after.measured - before.measured
        more[1] -= more[1, at]
        errors[:, at:] += more[:, at:]
        found = lost_messages(WhiteningFilter(before, NOISE), errors, before.command[before.source], **BARE)
        onsets.append(-1 if found.onset is None else found.onset)
    # three steps in ten are informative, ten rows apart; all but a few in a hundred drives are this close
    assert -150 < np.median(onsets) - at < 200


@pytest.mark.statistical
@pytest.mark.parametrize("effect", [Saturation(), RateLimit(), DeadTime()], ids=lambda e: e.name)
@pytest.mark.parametrize("steps", [True, False], ids=["steps", "smooth"])
def test_another_cause_is_not_claimed(effect: Effect, steps: bool, rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    command = 1.5 * _steps(rng, 20) if steps else _smooth(20)
    record = _record(command, [effect], rng, 20)
    none, true = (Hypothesis.named(record, name, plant()) for name in ("none", effect.name))
    likelihood, noise, errors, z = {}, NOISE, {}, {}
    for hypothesis in (none, true):
        start = {**BARE, **{k: float(v) for k, v in plant([effect]).values().items()}}
        z[hypothesis.name], noise = hypothesis.z_of(start), NOISE
        for _ in range(3):  # parameters and noise in turn
            z[hypothesis.name] = modes(hypothesis, WhiteningFilter(record, noise), z[hypothesis.name][None])[0][0]
            errors[hypothesis.name] = hypothesis.errors(z[hypothesis.name][None])[0]
            fitted = fit_noise(record, errors[hypothesis.name], noise, T_L=0.3)
            noise = fitted.noise
        likelihood[hypothesis.name] = (float(fitted.rows.sum()), noise)
    bare = {k: float(v) for k, v in none.values(z["none"][None]).items()}
    white = WhiteningFilter(record, likelihood["none"][1])
    claim = lost_messages(white, errors["none"], record.command[record.source], **bare).evidence
    true_gain = likelihood[effect.name][0] - likelihood["none"][0]
    assert claim < 0.3 * true_gain


def test_no_message_is_held_from_one_stretch_to_the_next() -> None:
    rng = np.random.default_rng(0)
    command = np.repeat([0.3, -0.4], 400)
    engaged = np.ones(800)
    engaged[380:420] = 0
    found = _found(command, 0.0, rng, 20, engaged=engaged)
    assert found.fraction == 0.0
    assert found.evidence < 0


def test_a_constant_command_is_uninformative() -> None:
    found = _found(np.full(800, 0.3), 0.2, np.random.default_rng(0), 20)
    assert found.evidence < 0
    assert found.fraction == 0.0
    assert found.onset is None
