"""Good logs: read, mapped, merged, cut into segments, written and read again."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.io import Log, check
from avtorch.io.assemble import held

from .drives import drive, write

GOOD = drive()
SIGNALS = ("time", "accel_cmd", "accel", "speed", "jerk", "spacing", "lead_speed", "lead_accel", "grade")


def same(a: Log, b: Log) -> None:
    for name in (*SIGNALS, "engaged", "segment"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            np.testing.assert_array_equal(x, y, err_msg=name)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_round_trip_to_the_bit(tmp_path, suffix, fresh_seed):
    rng = np.random.default_rng(fresh_seed)
    n = len(GOOD["time"])
    gap = np.where(np.arange(n) >= 700, 5.0, 0.0)
    columns = drive(noise=0.05, seed=fresh_seed) | {
        "time": GOOD["time"] + gap + 1e-3 * rng.random(n),
        "jerk": rng.standard_normal(n),
        "engaged": (np.arange(n) > 100).astype(float),
        "spacing": 20 + rng.random(n),
        "lead_speed": GOOD["speed"],
        "lead_accel": rng.standard_normal(n),
        "grade": 0.01 * rng.standard_normal(n),
        "segment": np.where(np.arange(n) < 300, 4, 7),
    }
    log = Log.from_arrays(**columns)
    assert log.segment.max() == 2
    log.write(tmp_path / f"lap.{suffix}")
    same(log, Log.read(tmp_path / f"lap.{suffix}"))
    assert [p.name for p in tmp_path.iterdir()] == [f"lap.{suffix}"]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-50, 50, allow_subnormal=True), min_size=2, max_size=20),
    st.floats(0.006, 0.09),
)
def test_any_float_survives_the_csv(tmp_path_factory, values, step):
    path = tmp_path_factory.mktemp("csv") / "lap.csv"
    log = Log.from_arrays(time=step * np.arange(len(values)), accel_cmd=values, accel=values)
    log.write(path)
    same(log, Log.read(path))


def test_csv_and_parquet_say_the_same(tmp_path):
    write(tmp_path / "a.csv", GOOD)
    # narrow types and whole numbers are as good as float64
    pq.write_table(pa.table({k: pa.array(v) for k, v in GOOD.items()}), tmp_path / "a.parquet")
    same(Log.read(tmp_path / "a.csv"), Log.read(tmp_path / "a.parquet"))


def test_parquet_time_stamps_are_seconds(tmp_path):
    ticks = np.round((GOOD["time"] + 1.7e9) * 1e6).astype(np.int64)
    columns = {k: pa.array(v) for k, v in GOOD.items()} | {"time": pa.array(ticks).cast(pa.timestamp("us"))}
    columns["engaged"] = pa.array([True] * 1500)
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    log = Log.read(tmp_path / "a.parquet")
    # float64 resolves 2.4e-7 s at 1.7e9 s
    np.testing.assert_allclose(log.time - 1.7e9, GOOD["time"], atol=3e-7)
    assert log.engaged.all()


def test_names_units_and_ignored_columns(tmp_path):
    odd = {
        "t_ms": GOOD["time"] * 1e3,
        "CAN.ACC_X": GOOD["accel"] / 9.80665,
        "v": GOOD["speed"] * 3.6,
        "accel_cmd": GOOD["accel_cmd"] * 100,
        "slope": np.full(1500, 2.0),
        "comment": ["fine"] * 1500,
    }
    path = write(tmp_path / "lap.csv", odd)
    names = ["time=t_ms", "accel=CAN.ACC_X", "speed=v", "grade=slope"]
    units = {"time": "ms", "accel": "g", "speed": "km/h", "accel_cmd": "cm/s²", "grade": "deg"}
    log = Log.read(path, map=names, unit=units)
    for name in ("time", "accel", "speed", "accel_cmd"):
        np.testing.assert_allclose(getattr(log, name), GOOD[name], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(log.grade, np.tan(np.radians(2.0)))
    assert log.ignored == ("comment",)
    assert any("columns ignored: comment" in note for note in check(log).notes)
    # the same out of the file beside the log; an argument overrules it
    lines = ["[map]", *(f'{n.split("=")[0]} = "{n.split("=")[1]}"' for n in names), "[unit]"]
    lines += [f'{k} = "{v}"' for k, v in units.items()]
    (tmp_path / "lap.toml").write_text("\n".join(lines), encoding="utf-8")
    same(log, Log.read(path))
    with pytest.raises(InputError, match="10 to 200 Hz"):
        Log.read(path, unit=["time=s"])


def test_the_right_line_is_reported_for_quoted_line_breaks(tmp_path):
    path = tmp_path / "lap.csv"
    path.write_text('time,accel_cmd,speed,note\n0,1,2,"two\nlines"\n0.1,1,x,\n')
    with pytest.raises(InputError, match=r"row 2 \(line 4\), column 'speed'"):
        Log.read(path)


def test_byte_order_mark_line_ends_and_trailing_blank_lines(tmp_path):
    path = tmp_path / "lap.csv"
    path.write_bytes(b"\xef\xbb\xbftime,accel_cmd,speed,\r\n0,1,2,\r\n0.1,1,2,\r\n\r\n\r\n")
    log = Log.read(path)
    assert log.rows == 2
    assert log.ignored == ("(unnamed 4)",)


def test_gaps_and_new_values_of_segment_cut_the_drive():
    n = len(GOOD["time"])
    time = GOOD["time"] + np.where(np.arange(n) >= 400, 2.0, 0.0) + np.where(np.arange(n) >= 900, 0.05, 0.0)
    log = Log.from_arrays(**(GOOD | {"time": time}))
    assert [(s.start, s.stop) for s in log.segments()] == [(0, 400), (400, n)]  # 0.07 s at 50 Hz: lost rows, no gap
    seen = check(log)
    assert [(g.row, round(g.seconds, 6)) for g in seen.gaps] == [(400, 2.02)]
    assert seen.late_rows == 1
    assert any("gap of 2.02 s after row 400" in note for note in seen.notes)
    assert log.rate_hz == pytest.approx(50)
    assert log.seconds == pytest.approx(n / 50 - 2 / 50 + 0.05)
    # another drive: its value may come back, and its time may start anew
    drives = np.repeat([3, 5, 3], [500, 500, n - 1000])
    fresh = np.concatenate([GOOD["time"][:500], GOOD["time"][: n - 500]])
    log = Log.from_arrays(**(GOOD | {"time": fresh, "segment": drives}))
    assert [s.start for s in log.segments()] == [0, 500, 1000]
    assert log.segment.tolist() == np.repeat([0, 1, 2], [500, 500, n - 1000]).tolist()
    # such as a time stamp in nanoseconds or a hash: numbers that no int64 holds, and neighbours in float64
    for large in (2.0**63, 1e300):
        named = np.where(drives == drives[0], large, np.nextafter(large, np.inf))
        log = Log.from_arrays(**(GOOD | {"time": fresh, "segment": named}))
        assert [s.start for s in log.segments()] == (np.flatnonzero(np.diff(named, prepend=np.nan) != 0)).tolist()
    with pytest.raises(InputError, match="row 501, column 'time': goes back"):
        Log.from_arrays(**(GOOD | {"time": fresh}))


def test_masks():
    n = len(GOOD["time"])
    speed = GOOD["speed"].copy()
    speed[:50] = 0.1
    engaged = np.ones(n)
    engaged[200:230] = 0
    log = Log.from_arrays(time=GOOD["time"], accel_cmd=GOOD["accel_cmd"], speed=speed, engaged=engaged)
    expected = np.ones(n, bool)
    # a driver's rows, and the two seconds at 50 Hz after them
    expected[:50] = expected[200:330] = False
    np.testing.assert_array_equal(log.usable, expected)
    seen = check(log)
    assert (seen.masked_rows, seen.driver_rows, seen.settling_rows, seen.standstill_rows) == (180, 30, 100, 50)
    without = Log.from_arrays(time=GOOD["time"], accel_cmd=GOOD["accel_cmd"], accel=GOOD["accel"])
    assert without.usable.all()
    part = log[100:300]
    assert part.rows == 200
    # a hundred before the driver's thirty, and seventy that settle
    assert part.usable.sum() == 100


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_held_is_the_last_value_that_had_arrived(data):
    stamps = np.cumsum(data.draw(st.lists(st.floats(0.01, 2), min_size=1, max_size=15)))
    clock = np.sort(data.draw(st.lists(st.floats(-1, 30), min_size=1, max_size=30)))
    values = np.arange(len(stamps)) * 1.5
    got, age = held(clock, stamps, values)
    for t, x, a in zip(clock, got, age, strict=True):
        past = [i for i, s in enumerate(stamps) if s <= t]
        if past:
            assert x == values[past[-1]]
            assert a == t - stamps[past[-1]]
        else:
            assert np.isnan(x)
            assert np.isinf(a)


def test_signals_with_their_own_stamps_are_held(tmp_path):
    slow = slice(0, None, 5)  # speed at 10 Hz, its messages 4 ms late on the way
    stamps = GOOD["time"][slow] + 0.004
    pad = [""] * (1500 - len(stamps))
    own = {k: v for k, v in GOOD.items() if k != "speed"}
    columns = own | {
        "t_speed": [*map(repr, stamps.tolist()), *pad],
        "speed": [*map(repr, GOOD["speed"][slow].tolist()), *pad],
    }
    log = Log.read(write(tmp_path / "lap.csv", columns), stamp=["speed=t_speed"])
    expected, _ = held(GOOD["time"], stamps, GOOD["speed"][slow])
    assert log.rows == 1499  # nothing had arrived in the first row
    np.testing.assert_array_equal(log.speed, expected[1:])
    assert log.ignored == ()
    assert any("1 rows left out where speed had not arrived" in note for note in check(log).notes)
    # and written only in the rows where it arrived
    sparse = [repr(float(x)) if i % 5 == 0 else "" for i, x in enumerate(GOOD["speed"])]
    log = Log.read(write(tmp_path / "sparse.csv", own | {"speed": sparse}), stamp=["speed=time"])
    np.testing.assert_array_equal(log.speed, np.repeat(GOOD["speed"][slow], 5))
    with pytest.raises(InputError, match=r"row 2 \(line 3\), column 'speed': is empty"):
        Log.read(tmp_path / "sparse.csv")


def test_a_signal_that_falls_silent_makes_a_gap(tmp_path):
    speed = [repr(float(x)) if i % 5 == 0 and not 500 <= i < 800 else "" for i, x in enumerate(GOOD["speed"])]
    log = Log.read(write(tmp_path / "lap.csv", GOOD | {"speed": speed}), stamp=["speed=time"])
    # held for three of its steps of 0.1 s, counted from row 495, then left out until it speaks again
    assert [(s.start, s.stop) for s in log.segments()] == [(0, 511), (511, 511 + 700)]
    assert log.time[511] == GOOD["time"][800]


def test_broken_stamps(tmp_path):
    stamps = GOOD["time"].copy()
    stamps[7] = stamps[5]
    path = write(tmp_path / "lap.csv", GOOD | {"t2": stamps})
    with pytest.raises(InputError, match=r"row 8 \(line 9\), column 't2' \(stamp of speed\): goes back"):
        Log.read(path, stamp=["speed=t2"])
    half = [repr(float(x)) for x in GOOD["time"]]
    half[3] = ""
    with pytest.raises(InputError, match=r"row 4 \(line 5\), column 't2': is empty where 'speed' is not"):
        Log.read(write(tmp_path / "lap.csv", GOOD | {"t2": half}), stamp=["speed=t2"])
    with pytest.raises(InputError, match="share 0 rows"):
        Log.read(write(tmp_path / "lap.csv", GOOD | {"t2": GOOD["time"] + 1e6}), stamp=["speed=t2"])
    # the last arrival written into every row is no repetition
    last = np.repeat(GOOD["time"][::5], 5)
    columns = GOOD | {"t2": last, "speed": np.repeat(GOOD["speed"][::5], 5)}
    assert Log.read(write(tmp_path / "lap.csv", columns), stamp=["speed=t2"]).rows == 1500


@pytest.mark.statistical
def test_ten_and_two_hundred_hertz_and_jitter(rotating_seed):
    rng = np.random.default_rng(rotating_seed)
    for rate in (10, 200):
        columns = drive(rate=rate)
        columns["time"] = columns["time"] + 0.4 / rate * rng.random(len(columns["time"]))
        log = Log.from_arrays(**columns)
        assert len(log.segments()) == 1
        # the median step of n jittered ones strays by less than 5 %: 5 sigma of a spread of 0.16 steps over sqrt(300)
        assert log.rate_hz == pytest.approx(rate, rel=0.06)
        assert check(log).jitter > 0.1
        assert any("jitters" in note for note in check(log).notes)
