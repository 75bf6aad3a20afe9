"""Parts of a gap that are known."""

from dataclasses import replace

import numpy as np
import pytest

from avtorch.gap.result.attribution import RowAttribution, _q_values, localise, shortest
from avtorch.gap.result.counted_rows import CountedRows
from tests.bars import BAR
from tests.gap.records import log_of


def _shown(
    does: np.ndarray, record: CountedRows, *, nats: float = 200.0, felt: float = 0.0, paid: float = 10.0
) -> RowAttribution:
    size = does / does.sum() * nats
    moved = np.stack([np.sqrt(does), np.cumsum(np.sqrt(does)) * record.dt])
    return RowAttribution(record, size, paid, size, felt * size, moved)


@pytest.fixture(scope="module")
def record() -> CountedRows:
    return CountedRows.of(log_of(seconds=120.0, speed0=8.0))


def test_a_speed_range_is_named_and_a_uniform_cause_is_not(record: CountedRows) -> None:
    speed = record.measured[1, :, 0]
    slow = np.quantile(speed, 0.3)
    named = localise(_shown((speed < slow) + 0.0, record), onset_s=None, lag=0.3)
    part = next(w for w in named if w.axis == "speed")
    assert (part.begin, part.end) == pytest.approx((speed.min(), slow), abs=0.15)
    assert part.share > 0.9
    even = localise(_shown(np.ones(record.rows), record), onset_s=None, lag=0.3)
    assert {w.axis for w in even} <= {"signal", "frequency"}


def test_braking_is_named(record: CountedRows) -> None:
    command = record.command
    named = localise(_shown(np.maximum(-command, 0) ** 2 + 1e-9, record), onset_s=None, lag=0.05)
    part = next(w for w in named if w.axis == "command")
    assert float(part.end) < 0.15
    assert float(part.begin) == pytest.approx(command.min(), abs=0.3)


def test_an_onset_is_a_part_of_the_time(record: CountedRows) -> None:
    time = record.time
    named = localise(_shown((time > 70) + 0.0, record), onset_s=70.0, lag=0.3)
    part = next(w for w in named if w.axis == "time")
    assert (part.begin, part.end) == (70.0, time[-1])
    assert part.share == pytest.approx(1.0)


def test_what_gains_nothing_is_not_named(record: CountedRows) -> None:
    quiet = _shown(np.ones(record.rows), record)
    assert localise(replace(quiet, gained=np.zeros(record.rows)), onset_s=30.0, lag=0.3) == ()
    assert localise(replace(quiet, gained=-quiet.gained), onset_s=30.0, lag=0.3) == ()


def test_sensing_and_actuation_share(record: CountedRows) -> None:
    named = {w.begin: w.share for w in localise(_shown(np.ones(record.rows), record, felt=0.25), onset_s=None, lag=0.3)}
    assert (named["actuation"], named["sensing"]) == pytest.approx((0.75, 0.25))


def test_shortest_against_all_pairs(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    x, weight = rng.normal(size=40), rng.random(40)
    low, high = shortest(x, weight, 0.7)
    inside = (x >= low) & (x <= high)
    assert weight[inside].sum() >= 0.7 * weight.sum() - 1e-9
    pairs = [(b - a) for a in x for b in x if b >= a and weight[(x >= a) & (x <= b)].sum() >= 0.7 * weight.sum() - 1e-9]
    assert high - low == pytest.approx(min(pairs))


@pytest.mark.statistical
def test_false_discoveries_of_e_values(rotating_seed: int, draws_factor: int) -> None:
    """Log-normal e-values of mean 1 with much in common: parts named where nothing is, in few of many drives."""
    rng = np.random.default_rng(rotating_seed)
    named, drives = 0, 4000 * draws_factor
    for _ in range(drives):
        shared, own = rng.normal(), rng.normal(size=6)
        gains = 1.5 * (0.8 * shared + 0.6 * own) - 0.5 * 1.5**2
        named += min(_q_values(gains.tolist())) <= 0.05
    # one in twenty is allowed
    assert named < 0.05 * drives + BAR * np.sqrt(0.05 * 0.95 * drives)
    assert _q_values([]) == []
    assert _q_values([5.0, -3.0]) == pytest.approx([2 * np.exp(-5), 1.0])
