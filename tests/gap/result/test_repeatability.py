"""Commands given twice: what is left between the two is noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch.gap.result import sentences
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.gap_size import SETTLED_S, WINDOW_S, GapSize, Repeatability, repeatability
from avtorch.gap.result.hypotheses import Candidate, Verdict
from avtorch.gap.result.log_facts import LogFacts
from avtorch.io import Log
from tests.bars import BAR

DT = 0.05
NOISE_A, NOISE_V = 0.08, 0.03


def log_of(command: np.ndarray, rng: np.random.Generator) -> Log:
    keep = np.exp(-DT / 0.3)
    accel = np.asarray(lfilter([0.0, 0.9 * (1 - keep)], [1.0, -keep], command))
    speed = 30 + np.cumsum(accel) * DT
    return Log.from_arrays(
        time=np.arange(len(command)) * DT,
        accel_cmd=command,
        accel=accel + NOISE_A * rng.standard_normal(len(command)),
        speed=speed + NOISE_V * rng.standard_normal(len(command)),
    )


def steps(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Of two seconds each, after all of which the car is as fast as before."""
    sizes = rng.uniform(-1, 1, round(seconds / 2))
    return np.repeat(sizes - sizes.mean(), round(2 / DT))


@pytest.mark.statistical
def test_a_manoeuvre_driven_twice_gives_the_noise(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    manoeuvre = steps(40, rng)
    told = repeatability(
        CountedRows.of(log_of(np.concatenate([steps(20, rng), manoeuvre, steps(14, rng), manoeuvre]), rng))
    )
    assert told is not None
    assert told.pairs in (2, 3, 4)  # a window whose commands hardly move is left out
    assert told.seconds == pytest.approx(told.pairs * (WINDOW_S - SETTLED_S))
    rows = told.seconds / DT
    # a standard deviation from this many rows has an error of 1 / sqrt(2 rows); five of them
    assert told.floor_accel == pytest.approx(NOISE_A, rel=BAR / np.sqrt(2 * rows))
    # the noise of the speed at each start stays in: one squared normal a pair, of mean 1
    excess = (float(told.floor_speed or 0.0) / NOISE_V) ** 2 - 1
    assert -BAR * np.sqrt(2 / rows) < excess < 1 + BAR * np.sqrt(2 / told.pairs)


@pytest.mark.statistical
def test_a_manoeuvre_driven_once_gives_no_noise(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    assert repeatability(CountedRows.of(log_of(steps(120, rng), rng))) is None
    # a command that stands still is no manoeuvre
    assert repeatability(CountedRows.of(log_of(np.full(2400, 0.1), rng))) is None
    assert repeatability(CountedRows.of(log_of(steps(16, rng), rng))) is None


@pytest.mark.statistical
def test_drives_may_repeat_each_other(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    manoeuvre = steps(30, rng)
    told = repeatability(CountedRows.of([log_of(manoeuvre, rng), log_of(manoeuvre, rng)]))
    assert told is not None
    assert told.pairs >= 2


def test_the_answer_says_so() -> None:
    gap = GapSize(True, rollout_rmse_accel=0.2, repeats=Repeatability(2, 14.0, 0.08, None))
    assert gap.to_dict()["repeats"] == {"pairs": 2, "seconds": 14.0, "floor_accel": 0.08, "floor_speed": None}
    log = LogFacts(280, 1, 14.0, 20.0, ("accel",))
    each = tuple(Candidate(name, p, 0.0) for name, p in (("none", 0.9), ("unknown", 0.1)))
    told = sentences.gap(Diagnosis(log, {}, gap, each, Verdict(("none",), ("none",), False, "")))
    assert told[1].startswith("Under repeated commands (14 s) the car repeats accelerations to 0.08 m/s²;")
    assert GapSize(False).to_dict()["repeats"] is None
