"""Lost messages: exact scheduling, the gain that it schedules, and lost stretches of known places found again."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
from scipy.linalg import toeplitz

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import evaluate_evidence, lost_nats
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.lost_messages import (
    LostMessages,
    PulseModel,
    best_stretches,
    candidates,
    gain_of,
    lost_messages,
    pulse_model,
    schedule,
    with_lost_messages,
)
from tests.bars import BAR, log_odds

DT, LAG, GAIN = 0.02, 0.3, 0.9
ACCEL_SD, SPEED_SD = 0.05, 0.01
LOST = ((1000, 1012), (1500, 1525), (2100, 2106), (2300, 2350), (2900, 2918), (3500, 3540))
"""Rows from a step of the command on, 0.12 to 1 s."""


# scheduling ----------------------------------------------------------------------------------------------------------
def _best_by_enumeration(first: np.ndarray, stop: np.ndarray, value: np.ndarray, apart: int) -> float:
    best = 0.0
    for count in range(1, len(first) + 1):
        for chosen in combinations(range(len(first)), count):
            order = sorted(chosen, key=lambda k: stop[k])
            if all(first[b] >= stop[a] + apart for a, b in pairwise(order)):
                best = max(best, float(value[list(chosen)].sum()))
    return best


@pytest.mark.parametrize("apart", [0, 1, 4])
def test_the_schedule_is_the_best_of_all_sets(fresh_seed: int, apart: int) -> None:
    rng = np.random.default_rng([fresh_seed, apart])
    for _ in range(40):
        n = int(rng.integers(1, 9))
        first = rng.integers(1, 40, n)
        stop = first + rng.integers(1, 12, n)
        value = rng.normal(2.0, 3.0, n)
        chosen = schedule(first, stop, value, apart)
        assert all(first[b] >= stop[a] + apart for a, b in pairwise(chosen.tolist()))
        assert value[chosen].sum() == pytest.approx(_best_by_enumeration(first, stop, value, apart), abs=1e-12)


def test_no_candidate_no_stretch() -> None:
    nothing = np.zeros(0, np.int64)
    assert len(schedule(nothing, nothing, np.zeros(0), 1)) == 0


# the gain ------------------------------------------------------------------------------------------------------------
def _random_model(rng: np.random.Generator, rows: int, penalty: float) -> tuple[PulseModel, FloatArray, FloatArray]:
    """A small problem: the model, the score and its dense information."""
    information = 2.0 * np.exp(-np.arange(rows) / 3.0)
    cover = rng.uniform(0.5, 1.0, rows)
    demand = np.repeat(rng.normal(0.0, 1.5, rows), rng.integers(1, 4, rows))[:rows]
    free = np.full(rows, rows, np.int64)
    dense = cover[:, None] * toeplitz(information) * cover
    score = dense @ rng.normal(0.0, 1.0, rows)
    return PulseModel(demand, information, cover, free, longest=8, tail=0, penalty=penalty), score, dense


def _dense_gain(
    m: PulseModel, score: FloatArray, dense: FloatArray, rows: tuple[tuple[int, int], ...] | list[tuple[int, int]]
) -> float:
    w = np.zeros(len(score))
    for i, j in rows:
        w[i:j] = m.demand[i - 1] - m.demand[i:j]
    return float(score @ w - 0.5 * w @ dense @ w) - m.penalty * len(rows)


def test_gains_are_those_of_the_quadratic_form(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    for _ in range(20):
        m, score, dense = _random_model(rng, 30, 0.2)
        first, stop, gain = candidates(m, score, 1, 30)
        for i, j, g in zip(first.tolist(), stop.tolist(), gain.tolist(), strict=True):
            assert g - m.penalty == pytest.approx(_dense_gain(m, score, dense, [(i, j)]), abs=1e-9)
        rows = [(3, 5), (6, 9), (20, 21)]
        assert gain_of(m, score, rows) == pytest.approx(_dense_gain(m, score, dense, rows), abs=1e-9)


def test_candidates_leave_out_nothing_that_a_best_set_needs(fresh_seed: int) -> None:
    """Of all stretches, the best schedule is one of the candidates."""
    rng = np.random.default_rng(fresh_seed)
    for _ in range(20):
        m, score, dense = _random_model(rng, 24, 0.2)
        every = [(i, j) for i in range(1, 24) for j in range(i + 1, min(i + m.longest, 24) + 1)]
        value = np.array([_dense_gain(m, score, dense, [s]) for s in every])
        first, stop = np.array(every).T
        whole = schedule(first, stop, value, 0)
        some = candidates(m, score, 1, 24)
        chosen = schedule(*some[:2], some[2] - m.penalty, 0)
        assert (some[2] - m.penalty)[chosen].sum() == pytest.approx(max(value[whole].sum(), 0.0), abs=1e-9)


def test_no_change_of_one_stretch_gains(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    for _ in range(10):
        m, score, dense = _random_model(rng, 40, 0.3)
        rows = best_stretches(m, score)
        best = _dense_gain(m, score, dense, rows)
        assert best >= -1e-9
        every = [(i, j) for i in range(1, 40) for j in range(i + 1, min(i + m.longest, 40) + 1)]
        for k in range(len(rows) + 1):
            others = rows[:k] + rows[k + 1 :]  # without the k-th; all of them at last
            for i, j in every:
                if all(j < a or i > b for a, b in others):
                    assert _dense_gain(m, score, dense, [*others, (i, j)]) <= best + 1e-9
            assert _dense_gain(m, score, dense, others) <= best + 1e-9


# drives --------------------------------------------------------------------------------------------------------------
def _log(rng: np.random.Generator, lost: tuple[tuple[int, int], ...] = (), late: int = 0) -> Log:
    """80 s of a car with a lag, whose command steps every two seconds; `late` rows of dead time."""
    n = 4000
    command = np.repeat(np.where(np.arange(n // 100) % 2 == 0, 1.0, -1.0) * rng.uniform(0.5, 1.5, n // 100), 100)
    seen = command.copy()
    for i, j in lost:
        seen[i:j] = command[i - 1]
    seen = np.concatenate([np.full(late, seen[0]), seen])[:n]
    keep, accel = np.exp(-DT / LAG), np.zeros(n)
    for k in range(1, n):
        accel[k] = GAIN * seen[k - 1] + keep * (accel[k - 1] - GAIN * seen[k - 1])
    speed = 20.0 + np.concatenate([[0.0], np.cumsum(0.5 * DT * (accel[1:] + accel[:-1]))])
    return Log.from_arrays(
        time=DT * np.arange(n),
        accel_cmd=command,
        accel=accel + rng.normal(0.0, ACCEL_SD, n),
        speed=speed + rng.normal(0.0, SPEED_SD, n),
    )


def _fitted(log: Log) -> Hypothesis:
    h = fit(Hypothesis(DriveData.of(log)), 8)
    h.base = h
    return evaluate_evidence(h)


def _losing(seed: int) -> Hypothesis:
    return _fitted(_log(np.random.default_rng(seed), LOST))


def _sound(seed: int) -> Hypothesis:
    return _fitted(_log(np.random.default_rng(seed)))


def _at_their_places(h: Hypothesis, rows: tuple[tuple[int, int], ...]) -> bool:
    """Whether `rows` are those that were lost: their first rows to the row, as the command steps there, their last ones
    within five standard errors. A row more or less changes the demand by w in one row, worth w² rho(0) / 2 nats."""
    m = pulse_model(h)
    for (i, j), (first, stop) in zip(rows, LOST, strict=True):
        w = abs(float(m.demand[first - 1] - m.demand[first]))
        if i != first or abs(j - stop) > 1 + BAR / (w * np.sqrt(m.information[0])):
            return False
    return True


@pytest.mark.statistical
def test_lost_stretches_are_found_where_they_are(rotating_seed: int) -> None:
    h = _losing(rotating_seed)
    found = lost_messages(h)
    assert isinstance(found, LostMessages)
    assert len(found.rows) == len(LOST)
    assert _at_their_places(h, found.rows)


@pytest.mark.statistical
def test_neither_a_sound_link_nor_the_control_has_lost_stretches(rotating_seed: int) -> None:
    sound, losing = _sound(rotating_seed), _losing(rotating_seed)
    # each of the 40 steps is a place where noise may pass for a loss, at one of some ten lengths
    assert lost_messages(sound).nats < log_odds(400)
    assert lost_messages(losing, -1.0).nats < log_odds(400) < lost_messages(losing).nats
    assert with_lost_messages(sound) is None


@pytest.mark.statistical
def test_the_hypothesis_with_them_explains_the_drive(rotating_seed: int) -> None:
    h = _losing(rotating_seed)
    found = with_lost_messages(h)
    assert found is not None
    assert found.effects == ["command_hold"]
    assert _at_their_places(found, found.lost)
    assert found.score > h.score + lost_nats(h) * len(LOST)
    # the lag and the gain, which had to make up for the losses, are the car's again
    sd = np.sqrt(np.diag(np.linalg.inv(found.information)))
    for name, true in (("T_L", LAG), ("K_L", GAIN)):
        assert abs(found[name] - true) < BAR * sd[found.free.index(name)]
    assert h.lost == ()  # the hypothesis itself stays as it was


@pytest.mark.statistical
def test_masked_rows_take_no_part(rotating_seed: int) -> None:
    h = _losing(rotating_seed)
    mask = np.zeros(4000, bool)
    mask[2000:] = True
    found = lost_messages(h, mask=mask)
    assert [i for i, _ in found.rows] == [1000, 1500]
    tail = pulse_model(h).tail
    mask[1525 : 1525 + tail] = True  # the response to the second one
    assert [i for i, _ in lost_messages(h, mask=mask).rows][:1] == [1000]
    assert all(j + tail <= 1525 for _, j in lost_messages(h, mask=mask).rows)
    mask[:] = True
    assert with_lost_messages(h, mask) is None


@pytest.mark.statistical
def test_a_dead_time_is_not_taken_for_losses_once_it_is_in(rotating_seed: int) -> None:
    late = _fitted(_log(np.random.default_rng(rotating_seed), late=8))
    delayed = fit(late.with_effect("dead_time", (0.15,)), 8)
    evaluate_evidence(delayed)
    assert with_lost_messages(delayed) is None
