"""What must not change an answer: where a clock begins, units, the order of columns, blocks, threads, hash seeds, sign.

One check an invariance, each over the public functions, as scikit-learn's estimator checks. Tolerances are what float64
resolves: "to the bit" where both ways meet in the same numbers, else the rounding of the input, carried through.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import avtorch
from avtorch.follower import diagnose_follower
from avtorch.gap import DeadTime, plant
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.hypotheses import Candidate
from avtorch.inference import BeliefStream, SamplerSettings
from avtorch.io import Log, check
from avtorch.results import estimates_answer
from avtorch.validation.windows import windows_of_log
from tests.follower.loops import CTG, followed_log
from tests.gap.records import log_of

Numbers = dict[str, Any]

OFFSETS = (1.2e9, 1.7e9 + 0.123, -5e8)
EFFECTS = ("dead_time", "aerodynamic_drag")
SIGNALS = ("accel_cmd", "accel", "speed", "jerk", "spacing", "lead_speed")
RATE_HZ = 25


def _drive(seconds: float = 50.0, rate_hz: int = RATE_HZ, seed: int = 1) -> Log:
    car = plant([DeadTime(0.25)], T_L=0.4, K_L=0.9)
    return log_of(car, seconds=seconds, rate_hz=rate_hz, rng=np.random.default_rng(seed))


@pytest.fixture(scope="module")
def drive() -> Log:
    """50 s at 25 Hz with a dead time and little noise."""
    log = _drive()
    assert log.accel is not None
    jerk = np.gradient(log.accel, log.time) + 0.05 * np.random.default_rng(2).standard_normal(log.rows)
    return _with(log, jerk=jerk)


@pytest.fixture(scope="module")
def behind() -> Log:
    """A follower, 100 s at 10 Hz."""
    return followed_log("constant_time_gap", CTG, seconds=100, rng=np.random.default_rng(3))


def _columns(log: Log) -> dict[str, Any]:
    return {name: getattr(log, name) for name in ("time", *SIGNALS) if getattr(log, name) is not None}


def _with(log: Log, *, unit: Mapping[str, str] | None = None, **columns: Any) -> Log:
    following = log.accel_cmd is None
    return Log.from_arrays(name="log", unit=unit, following=following, **(_columns(log) | columns))


def _written(log: Log, folder: Path, names: tuple[str, ...], **given: Any) -> Log:
    columns = _columns(log)
    rows = zip(*(columns[name].tolist() for name in names), strict=True)
    path = folder / "log.csv"
    path.write_text("\n".join([",".join(names), *(",".join(map(repr, row)) for row in rows)]) + "\n", encoding="utf-8")
    return Log.read(path, **given)


# the public functions, each with all that it answers as plain numbers and words


def _diagnosis(log: Log) -> Numbers:
    return avtorch.diagnose(log, effects=EFFECTS, pairs=False).to_dict()


def _estimate(log: Log) -> Numbers:
    answer = estimates_answer(avtorch.estimate(log, 5.0, estimator="map"))
    return {key: value for key, value in answer.items() if key != "seconds_per_window"}


def _follower(log: Log) -> Numbers:
    found = diagnose_follower(log, law="constant_time_gap", cause=False)
    return {name: q.to_dict() for name, q in found.parameters.items()}


def _quality(log: Log) -> Numbers:
    return check(log).to_dict()


def _stream(log: Log) -> Numbers:
    stream = BeliefStream(settings=SamplerSettings(chains=4, draws=8, burn_in=4), kept=20)
    columns = {name: torch.from_numpy(getattr(log, name)) for name in stream.form.columns}
    seen = stream.feed(torch.from_numpy(log.time[:500]), {n: x[:500] for n, x in columns.items()})
    return {
        "windows": [
            {"start_s": w.start_s, "end_s": w.end_s, "mean": w.belief.mean.tolist(), "draws": w.belief.draws.tolist()}
            for w in seen
        ]
    }


def _validation(log: Log) -> Numbers:
    found = windows_of_log(log, window=2.0)
    z = torch.zeros(1, len(found), len(found.names), dtype=torch.float64)
    return {
        "density": found.density.log_prob(z).tolist(),
        "start_s": found.start_s.tolist(),
        "end_s": found.end_s.tolist(),
    }


FUNCTIONS: dict[str, Callable[[Log], Numbers]] = {
    "diagnose": _diagnosis,
    "estimate": _estimate,
    "check": _quality,
    "stream": _stream,
    "validate": _validation,
}


@pytest.fixture(scope="module")
def answers(drive: Log) -> dict[str, Numbers]:
    return {name: function(drive) for name, function in FUNCTIONS.items()}


# the parts of an answer on the log's own clock, which move with it
ON_THE_CLOCK = ("start_s", "end_s", "time_s", "onset_s", "epoch_s")
_EPOCH_NOTE = re.compile("times are shown from the log's start")


def _leaves(answer: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All numbers and words of an answer, by where they stand."""
    if isinstance(answer, Mapping):
        for name, value in answer.items():
            yield from _leaves(value, f"{key}.{name}")
    elif isinstance(answer, (list, tuple)):
        kept = [x for x in answer if not (isinstance(x, str) and _EPOCH_NOTE.match(x))]
        for i, value in enumerate(kept):
            yield from _leaves(value, f"{key}.{i}")
    else:
        yield key, answer


def _same(found: Any, expected: Any, *, offset: float = 0.0, rel: float = 0.0, absolute: float = 0.0) -> None:
    """All leaves alike; those on the log's own clock `offset` [s] later, to what a stamp of that size resolves."""
    one, two = dict(_leaves(found)), dict(_leaves(expected))
    assert one.keys() == two.keys()
    for key, value in two.items():
        last = [part for part in key.split(".") if not part.isdigit()][-1]
        if isinstance(value, float) and (last in ON_THE_CLOCK or "epochs_s" in key):
            # one rounding of the sum, and one of the stamp it began with
            assert one[key] == pytest.approx(value + offset, rel=0, abs=2 * float(np.spacing(abs(offset) + 1e3))), key
        elif isinstance(value, float) and (rel or absolute):
            assert one[key] == pytest.approx(value, rel=rel, abs=absolute), key
        else:
            assert one[key] == value, key


# 1. where the clock begins


@pytest.mark.slow
@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_where_the_clock_begins_changes_nothing(
    name: str, offset: float, drive: Log, answers: dict[str, Numbers]
) -> None:
    """To the bit: the stamps' decimals survive the offset, and time from the start is made of them."""
    moved = _with(drive, time=drive.time + offset)
    assert moved.elapsed.tobytes() == drive.elapsed.tobytes()
    assert moved.time.tobytes() == (drive.time + offset).tobytes()
    _same(FUNCTIONS[name](moved), answers[name], offset=offset)


@pytest.mark.slow
def test_where_a_followers_clock_begins_changes_nothing(behind: Log) -> None:
    _same(_follower(_with(behind, time=behind.time + OFFSETS[1])), _follower(behind))


@pytest.mark.slow
def test_two_drives_need_not_share_a_clock() -> None:
    """Neither in a comparison nor in a diagnosis, which uses only the drives."""
    one, two = _drive(60.0, seed=5), _drive(60.0, seed=6)
    later = [replace(log, time=log.time + offset) for log, offset in zip((one, two), OFFSETS, strict=False)]
    told = avtorch.compare(*later).to_dict()
    for side in ("before", "after"):
        told[side]["epochs_s"] = [0.0]
    _same(told, avtorch.compare(one, two).to_dict())
    record, near = CountedRows.of(later), CountedRows.of([one, two])
    np.testing.assert_allclose(record.time, near.time, atol=1e-6)  # a stamp of 1e9 s is rounded to 1e-7 s
    assert record.log.tolist() == near.log.tolist()
    assert set(record.log.tolist()) == {0, 1}


@pytest.mark.slow
def test_an_onset_is_on_the_clock_of_its_log() -> None:
    """The accelerometer has an offset from 40 s on."""
    log = log_of(plant([], T_L=0.4, K_L=0.9), seconds=80.0, rate_hz=20, rng=np.random.default_rng(6))
    assert log.accel is not None
    log = _with(log, accel=log.accel + np.where(log.time > 40.0, 0.5, 0.0))
    near, far = (
        avtorch.diagnose(_with(log, time=log.time + offset), effects=["sensor_bias", "dead_time"], pairs=False)
        for offset in (0.0, OFFSETS[1])
    )
    assert near.verdict.names == far.verdict.names == ("sensor_bias",)
    assert near.onset_s == near.onset_from_start_s == pytest.approx(40.0, abs=1.0)
    # to what a stamp of that size resolves
    assert far.onset_from_start_s == pytest.approx(near.onset_from_start_s, abs=1e-6)
    assert far.onset_from_start_s is not None
    assert far.onset_s == pytest.approx(far.onset_from_start_s + OFFSETS[1], abs=1e-6)


@pytest.mark.parametrize("rate_hz", [10, 30, 60, 100, 120])
@pytest.mark.parametrize("jitter", [0.0, 0.001])
def test_rate_grouping_gaps_and_steps_hold_at_any_offset(rate_hz: int, jitter: float) -> None:
    """At 30, 60 and 120 Hz stamps are no decimals; two rows lost at 30 Hz are just no gap, at every offset."""
    rng = np.random.default_rng(4)
    ticks = np.arange(60 * rate_hz) / rate_hz
    ticks = np.delete(ticks, [200, 201])
    # recorders write microseconds
    time = ticks if jitter == 0 else np.round(ticks + rng.uniform(-jitter, jitter, len(ticks)), 6)
    command = np.sin(0.7 * ticks)
    logs = [
        Log.from_arrays(time=time + offset, accel_cmd=command, accel=np.sin(0.7 * ticks - 0.2) + 0.01)
        for offset in (0.0, *OFFSETS)
    ]
    near, *far = (CountedRows.of(log) for log in logs)
    assert near.group == max(1, rate_hz // 20)
    for log, record in zip(logs[1:], far, strict=True):
        # an even clock is off by half a microsecond at either end of a minute, a step of one that jitters by one
        assert log.rate_hz == pytest.approx(logs[0].rate_hz, rel=1e-6 * rate_hz if jitter else 2e-8)
        assert len(log.segments()) == len(logs[0].segments())
        assert (record.group, record.rows, len(record.drives)) == (near.group, near.rows, len(near.drives))
        assert np.abs(log.elapsed - logs[0].elapsed).max() <= 1e-6


def test_a_clock_that_was_set_while_it_ran_starts_a_segment_as_fine_as_the_first() -> None:
    """A logger that starts at 0 and then hears the time: both segments are even, and nothing is 1.7e9 s long."""
    time = np.arange(2000) / RATE_HZ
    stamps = np.concatenate([time[:1000], time[1000:] + OFFSETS[1]])
    log = Log.from_arrays(time=stamps, accel_cmd=np.sin(time), accel=np.sin(time - 0.3))
    assert len(log.segments()) == 2
    assert np.diff(log.elapsed[1000:]) == pytest.approx(1 / RATE_HZ, rel=1e-9)
    assert 0 < log.elapsed[1000] - log.elapsed[999] <= 1.0
    assert log.seconds == pytest.approx(2 * 999 / RATE_HZ)


def test_signals_with_clocks_of_their_own_share_the_offset(tmp_path: Path, drive: Log) -> None:
    """A value stamped at the very row counts as arrived, though offset and unit round both clocks anew."""
    stamps = drive.time[::2] + 0.0
    held = []
    for offset in (0.0, *OFFSETS):
        for unit, scale in (("s", 1.0), ("ms", 1e3), ("us", 1e6)):
            path = tmp_path / "log.csv"
            cells = [[repr(scale * t) for t in (drive.time + offset).tolist()]]
            cells += [[repr(x) for x in getattr(drive, name).tolist()] for name in ("accel_cmd", "accel", "speed")]
            cells.append([repr(scale * t) if i % 2 == 0 else "" for i, t in enumerate((drive.time + offset).tolist())])
            cells[3] = [x if i % 2 == 0 else "" for i, x in enumerate(cells[3])]
            lines = [",".join(row) for row in zip(*cells, strict=True)]
            path.write_text("\n".join(["time,accel_cmd,accel,speed,gps", *lines]) + "\n", encoding="utf-8")
            held.append(Log.read(path, stamp={"speed": "gps"}, unit={"time": unit}))
    assert len(stamps) == drive.rows // 2
    for log in held:
        assert log.speed is not None
        assert log.speed.tobytes() == held[0].speed.tobytes()  # type: ignore[union-attr]
        assert np.abs(log.elapsed - held[0].elapsed).max() <= 1e-6


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_what_is_written_is_read_to_the_bit(suffix: str, tmp_path: Path, drive: Log) -> None:
    log = _with(drive, time=drive.time + OFFSETS[1])
    log.write(tmp_path / f"log.{suffix}")
    again = Log.read(tmp_path / f"log.{suffix}")
    assert again.time.tobytes() == log.time.tobytes()
    assert again.elapsed.tobytes() == log.elapsed.tobytes()


def test_no_computation_reads_the_recorders_clock() -> None:
    """`Log.time` is for people and files; all else takes `elapsed`. These may show or keep stamps."""
    shown = {
        "decision/estimation.py",
        "gap/engine/drive_data.py", "io/quality.py",
        "live/source.py", "validation/windows.py",
    }  # fmt: skip
    package = Path(avtorch.__file__).parent
    found = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if re.search(r"\blog\.time\b", path.read_text(encoding="utf-8"))
    }
    assert found == shown


# 2. units


def _counted(log: Log, unit: str, offset: float) -> Log:
    ticks = np.round((log.time + offset) * {"ms": 1e3, "us": 1e6}[unit]).astype(np.int64)
    return _with(log, time=ticks, unit={"time": unit})


@pytest.mark.parametrize("unit", ["ms", "us"])
@pytest.mark.parametrize("offset", [0.0, *OFFSETS])
def test_whole_ticks_are_read_as_seconds(unit: str, offset: float, drive: Log) -> None:
    """To the bit, since 1970 too: a quotient of whole numbers is rounded once, as the decimals are."""
    assert _counted(drive, unit, offset).elapsed.tobytes() == drive.elapsed.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_unit_of_time_changes_nothing(name: str, drive: Log, answers: dict[str, Numbers]) -> None:
    """To the bit, counted in milliseconds since 1970."""
    _same(FUNCTIONS[name](_counted(drive, "ms", OFFSETS[1])), answers[name], offset=OFFSETS[1])


UNITS = {
    "speed": ("km/h", 3.6),
    "accel": ("g", 1 / 9.80665),
    "accel_cmd": ("cm/s2", 100.0),
    "jerk": ("g/s", 1 / 9.80665),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_units_of_signals_change_nothing(name: str, drive: Log, answers: dict[str, Numbers]) -> None:
    """There and back costs two roundings of 1.1e-16. Slopes are differences over steps of 1e-4, which let through ten
    thousand times that, and what a fit makes of them is divided once more by what little of the gap could be closed.
    """
    columns = {signal: getattr(drive, signal) * factor for signal, (_, factor) in UNITS.items()}
    other = _with(drive, **columns, unit={signal: unit for signal, (unit, _) in UNITS.items()})
    assert other.speed is not None
    np.testing.assert_array_max_ulp(other.speed, drive.speed, 2)  # type: ignore[arg-type]
    _same(FUNCTIONS[name](other), answers[name], rel=1e-3, absolute=1e-6)


# 3. the order of columns


def test_the_order_of_columns_changes_nothing(tmp_path: Path, drive: Log) -> None:
    """To the bit: every function gets the same log."""
    names = tuple(_columns(drive))
    given = _written(drive, tmp_path, names)
    turned = _written(drive, tmp_path, names[::-1])
    for name in ("elapsed", *names):
        assert getattr(turned, name).tobytes() == getattr(given, name).tobytes() == getattr(drive, name).tobytes()
    assert check(turned).to_dict() == check(given).to_dict()


# 4. blocks


@pytest.mark.parametrize("offset", [0.0, OFFSETS[1]])
def test_how_rows_come_in_blocks_changes_nothing(offset: float, drive: Log) -> None:
    """To the bit, wherever the clock begins."""
    cuts = sorted(np.random.default_rng(7).integers(0, 500, 12).tolist())
    seen = []
    for edges in ([0, 500], [0, *cuts, 500], range(0, 501)):
        stream = BeliefStream(settings=SamplerSettings(chains=4, draws=8, burn_in=4), kept=20)
        columns = {name: torch.from_numpy(getattr(drive, name)) for name in stream.form.columns}
        windows = []
        for a, b in pairwise(edges):
            time = torch.from_numpy(drive.time[a:b] + offset)
            windows += stream.feed(time, {n: x[a:b] for n, x in columns.items()})
        seen.append([(w.start_s, w.end_s, w.belief.draws.numpy().tobytes()) for w in windows + stream.flush()])
    assert len(seen[0]) == 10
    assert seen[1] == seen[0]
    assert seen[2] == seen[0]


# 5. threads and hash seeds


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_number_of_threads_changes_nothing(name: str, drive: Log, answers: dict[str, Numbers]) -> None:
    """To rounding: two threads may add up in another order, which a fit carries through as units do."""
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2 if before == 1 else 1)
        found = FUNCTIONS[name](drive)
    finally:
        torch.set_num_threads(before)
    _same(found, answers[name], rel=1e-5, absolute=1e-7)


_IN_A_PROCESS = """
import json, sys
import torch
from avtorch import diagnose, estimate
from avtorch.io import Log, check
from avtorch.results import estimates_answer
torch.set_num_threads(1)
log = Log.read(sys.argv[1])
answer = estimates_answer(estimate(log, 5.0, estimator="map"))
del answer["seconds_per_window"]
found = diagnose(log, effects=["dead_time", "aerodynamic_drag"], pairs=True)
print(json.dumps([check(log).to_dict(), answer, found.to_dict()]))
"""


@pytest.mark.slow
def test_the_hash_seed_changes_no_byte(tmp_path: Path, drive: Log) -> None:
    """Each in a process of its own: what is kept in sets must not come out in their order."""
    drive.write(tmp_path / "log.csv")
    told = []
    for seed in ("1", "2"):
        environment = os.environ | {"PYTHONHASHSEED": seed}
        call = [sys.executable, "-c", _IN_A_PROCESS, str(tmp_path / "log.csv")]
        told.append(subprocess.run(call, env=environment, capture_output=True, check=True).stdout)
    assert json.loads(told[0])[2]["verdict"]["names"]
    assert told[0] == told[1]


# 6. the sign of everything


def test_the_sign_of_everything_changes_no_estimate(drive: Log) -> None:
    """To the bit: the likelihood of lag and gain holds squares and products only. A speed has no mirror image."""
    signals = {name: getattr(drive, name) for name in ("accel_cmd", "accel", "jerk")}
    logs = [
        Log.from_arrays(time=drive.time, **{name: sign * values for name, values in signals.items()})
        for sign in (1.0, -1.0)
    ]
    one, two = ([w.window.belief for w in avtorch.estimate(log, 5.0).windows] for log in logs)
    assert len(one) == 10
    for some, other in zip(one, two, strict=True):
        assert torch.equal(some.draws, other.draws)
        assert torch.equal(some.excited, other.excited)


def _fits(log: Log | Sequence[Log], *effects: str) -> dict[str, Candidate]:
    """What a diagnosis rests on: every candidate's evidence and parameters, all of them listed."""
    found = avtorch.diagnose(log, effects=effects, pairs=False, prior=dict.fromkeys(effects, 1e6))
    return {c.name: c for c in found.candidates}


def test_the_sign_of_everything_changes_no_fit_of_the_acceleration(drive: Log) -> None:
    """Of effects that know no direction; to rounding, as sums of squares are the same and slopes only turned round."""
    assert drive.accel_cmd is not None
    assert drive.accel is not None
    one, two = (
        _fits(
            Log.from_arrays(time=drive.time, accel_cmd=sign * drive.accel_cmd, accel=sign * drive.accel),
            "dead_time", "second_order_actuator",
        )
        for sign in (1.0, -1.0)
    )  # fmt: skip
    assert one.keys() == two.keys()
    assert "none" in one
    for name, found in one.items():
        assert two[name].probability == pytest.approx(found.probability, rel=1e-6)
        if found.log_evidence is not None:
            assert two[name].log_evidence == pytest.approx(found.log_evidence, rel=1e-6, abs=1e-6)
        for key, q in found.parameters.items():
            assert two[name].parameters[key].mean == pytest.approx(q.mean, rel=1e-6)


# 7. the same drive twice


@pytest.mark.slow
def test_a_diagnosis_of_a_drive_given_twice_is_the_same(drive: Log) -> None:
    one, two = (avtorch.diagnose(logs, effects=EFFECTS, pairs=False) for logs in ([drive], [drive, drive]))
    assert two.verdict.names == one.verdict.names == ("dead_time",)
    for name, q in one.winner.parameters.items():
        again = two.winner.parameters[name]
        assert again.mean == pytest.approx(q.mean, abs=0.2 * q.sd)
        assert again.sd == pytest.approx(q.sd / math.sqrt(2), rel=0.25)
    assert one.winner.log_evidence is not None
    assert two.winner.log_evidence == pytest.approx(2 * one.winner.log_evidence, rel=0.15)


def test_a_drive_beside_itself_has_not_changed() -> None:
    log = _drive(70.0)
    told = avtorch.compare(log, log)
    assert not told.changed
    assert told.p_value == pytest.approx(1.0)
    for moved in (*told.car.values(), *told.gap.values()):
        assert moved.before == moved.after
        assert moved.ratio.mean == pytest.approx(1.0)


def test_the_windows_of_a_drive_given_twice_lie_alike(drive: Log) -> None:
    """Time starts anew with the second segment: the same bounds and rows, and beliefs that the prior carried over moves
    by less than the spread of both."""
    columns: dict[str, Any] = {name: np.concatenate([x, x]) for name, x in _columns(drive).items()}
    both = _with(drive, **columns, segment=np.repeat([0, 1], drive.rows))
    windows = [w.window for w in avtorch.estimate(both, 5.0, estimator="map").windows]
    assert len(windows) == 20
    for a, b in zip(windows[:10], windows[10:], strict=True):
        assert (a.start_s, a.end_s, a.n.tolist()) == (b.start_s, b.end_s, b.n.tolist())
        assert torch.equal(a.belief.excited, b.belief.excited)
        one, two = a.belief, b.belief
        spread = torch.hypot(one.sd, two.sd)
        assert bool(((one.mean - two.mean).abs() <= 3 * spread).all())
