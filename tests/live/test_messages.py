"""Late, doubled, reordered and corrupt messages: counted, survived, and without effect on what follows."""

from __future__ import annotations

import io
import json
import random
from collections import Counter
from functools import cache

import pytest

from avtorch.errors import InputError
from avtorch.live import Batch, Counts, LineParser, LineSink, LiveSettings, LiveWatch, Row, watch_source
from tests.live.drives import drive, fleet, lines


class Rows:
    """A source of rows that are there."""

    identity = None

    def __init__(self, rows, size=97):
        self.rows, self.size = rows, size

    def batches(self, stop, start=None):
        for first in range(0, len(self.rows), self.size):
            yield Batch(self.rows[first : first + self.size])


def answered(rows, settings=None, size=97):
    watch, told = LiveWatch(settings), io.StringIO()
    made = [Row(r.get("car", "car"), r["time"], {k: v for k, v in r.items() if k not in ("car", "time")}) for r in rows]
    watch_source(Rows(made, size), watch, [LineSink(told)])
    return watch, [json.loads(line) for line in told.getvalue().splitlines()]


@cache
def of_fleet():
    return answered(fleet())


@cache
def of_one():
    """Of the rows of one car."""
    return answered(drive(0.3, 1.0))[1]


def of_car(entries, car):
    return [entry for entry in entries if entry["car"] == car]


def test_each_car_has_its_own_belief_and_alerts():
    watch, entries = of_fleet()
    assert {car: len(of_car(entries, car)) for car in ("red", "blue", "green")} == dict.fromkeys(watch.cars, 6)
    for car, (lag, gain) in {"red": (0.3, 1.0), "blue": (1.5, 0.5)}.items():
        used = [e for e in of_car(entries, car) if e["used"]]
        assert used
        # five posterior SDs of one window
        assert all(abs(e["T_L"]["mean"] - lag) < 5 * e["T_L"]["sd"] for e in used)
        assert all(abs(e["K_L"]["mean"] - gain) < 5 * e["K_L"]["sd"] for e in used)
    assert any("stability" in e["alerts"] for e in of_car(entries, "blue"))
    assert not any(e["alerts"] for e in of_car(entries, "red"))
    alerted = next(e for e in of_car(entries, "blue") if e["alerts"])
    assert len(alerted["why"]) == len(alerted["alerts"])
    assert watch.counts.alerts["stability"] == sum("stability" in e["alerts"] for e in entries)
    assert [e["window"] for e in of_car(entries, "green")] == [1, 2, 3, 4, 5, 6]


def test_the_answers_are_those_of_an_estimate(tmp_path):
    """The same windows as `estimate` of the same log, by the same estimator."""
    from avtorch import Log, estimate

    rows = drive(1.5, 0.5)
    log = Log.from_arrays(**{name: [row[name] for row in rows] for name in rows[0]})
    offline = estimate(log, estimator="map", form="jerk").windows
    _, entries = answered([dict(row) for row in rows])
    assert [e["end_s"] for e in entries] == [round(w.window.end_s, 9) for w in offline]
    for entry, w in zip(entries, offline, strict=True):
        belief = w.window.belief
        assert entry["n"] == int(w.window.n[0])
        assert entry["alerts"] == w.report.names()
        # the mode has no noise; its draws, of which P is a share of a thousand, have another seed
        assert entry["T_L"]["mean"] == pytest.approx(belief.stat("T_L")["mean"], abs=0.2 * belief.stat("T_L")["sd"])
        assert entry["p_string_stable"] == pytest.approx(float(w.report.p_string_stable[0]), abs=0.1)


def test_the_size_of_batches_has_no_effect():
    for size in (1, 10_000):
        assert answered(fleet(), size=size)[1] == of_fleet()[1]


def test_rows_out_of_order_within_the_lateness_are_put_in_their_place():
    rows = fleet()
    mixed = list(rows)
    shuffle = random.Random(1)
    for first in range(0, len(mixed), 6):  # two rows of each car
        part = mixed[first : first + 6]
        shuffle.shuffle(part)
        mixed[first : first + 6] = part
    settings = LiveSettings(lateness=0.1)
    watch, entries = answered(mixed, settings)
    _, plain = answered(rows, settings)
    assert watch.counts.reordered > 100
    assert not watch.counts.refused
    for car in watch.cars:
        assert of_car(entries, car) == of_car(plain, car)


def test_doubled_rows_change_nothing():
    rows = fleet()
    twice = [row for row in rows for _ in range(2)]
    watch, entries = answered(twice)
    assert watch.counts.refused == {"doubled": len(rows)}
    assert entries == of_fleet()[1]


def test_late_rows_are_left_out():
    rows = [dict(row) for row in drive(0.3, 1.0)]
    late = [*rows[:200], *rows[205:240], *rows[200:205], *rows[240:]]  # 0.7 s behind
    watch, entries = answered(late)
    assert watch.counts.refused == {"late": 5}
    assert sum(e["n"] for e in entries) == len(rows) - 5


def test_corrupt_messages_are_counted_by_kind():
    rows = fleet()
    text = lines(rows).splitlines(keepends=True)
    bad = {
        b'{"car": "red", "time": 1.0, "accel_c\n': "corrupt",
        b"\xff\xfe\x00\n": "corrupt",
        b"[1, 2]\n": "corrupt",
        b'{"car": "\\ud800", "time": 1.0, "accel_cmd": 0.1, "accel": 0.1, "jerk": 0, "speed": 3}\n': "corrupt",
        b'{"car": {"a": 1}, "time": 1.0}\n': "corrupt",
        b'{"car": "red", "accel_cmd": 0.1, "accel": 0.1, "jerk": 0, "speed": 3}\n': "incomplete",
        b'{"car": "red", "time": 5.0, "accel_cmd": 0.1, "jerk": 0, "speed": 3}\n': "incomplete",
        b'{"car": "red", "time": 5.0, "accel_cmd": null, "accel": 0.1, "jerk": 0, "speed": 3}\n': "incomplete",
        b'{"car": "red", "time": "5", "accel_cmd": 0.1, "accel": 0.1, "jerk": 0, "speed": 3}\n': "implausible",
        b'{"car": "red", "time": NaN, "accel_cmd": 0.1, "accel": 0.1, "jerk": 0, "speed": 3}\n': "implausible",
        b'{"car": "red", "time": 5.0, "accel_cmd": Infinity, "accel": 0.1, "jerk": 0, "speed": 3}\n': "implausible",
        b'{"car": "red", "time": 5.0, "accel_cmd": "x", "accel": 0.1, "jerk": 0, "speed": 3}\n': "implausible",
        b'{"car": "red", "time": 5.0, "accel_cmd": 1e9, "accel": 0.1, "jerk": 0, "speed": 3}\n': "implausible",
    }
    counts = Counts()
    parser = LineParser(counts)
    for line in bad:
        text.insert(len(text) // 2, line)
        text.insert(300, line)
    watch, told = LiveWatch(counts=counts), io.StringIO()
    made = [row for line in text if (row := parser.row(line)) is not None]
    watch_source(Rows(made), watch, [LineSink(told)])
    assert counts.refused == Counter(2 * list(bad.values()))
    assert [json.loads(line) for line in told.getvalue().splitlines()] == of_fleet()[1]


def test_a_number_too_large_for_its_unit_is_implausible():
    counts = Counts()
    parser = LineParser(counts, unit=["speed=km/h"])
    assert parser.row(b'{"time": 1, "accel_cmd": 0, "speed": 1' + 400 * b"0" + b"}") is None
    assert counts.refused == {"implausible": 1}


def test_one_wrong_time_does_not_make_the_rows_behind_it_late():
    rows = [dict(row) for row in drive(0.3, 1.0)]
    for wrong in (1e9, -5e5):
        spoiled = list(rows)
        spoiled.insert(300, {**rows[300], "time": wrong})
        watch, entries = answered(spoiled)
        assert watch.counts.refused == {"jumped": 1}
        assert entries == of_one()


def test_a_clock_that_was_set_begins_a_new_stretch():
    rows = [dict(row) for row in drive(0.3, 1.0)]
    later = [{**row, "time": round(row["time"] + 1_700_000_000.0, 6)} for row in rows]
    watch, entries = answered([*rows, *later, *rows])
    assert not watch.counts.refused
    assert watch.counts.rows == 3 * len(rows)
    ends = [e["end_s"] for e in entries]
    one = [e["end_s"] for e in of_one()]
    assert ends == [*one, *(round(end + 1_700_000_000.0, 6) for end in one), *one]
    counted = [e["n"] for e in entries]
    assert counted == counted[: len(one)] * 3


def test_a_gap_ends_a_window_early():
    rows = [dict(row) for row in drive(0.3, 1.0)]
    _, entries = answered([*rows[:150], *rows[200:]])
    assert [(e["start_s"], e["end_s"], e["n"]) for e in entries][:3] == [
        (0.0, 2.0, 100),
        (2.0, 3.0, 50),
        (4.0, 6.0, 100),
    ]


def test_columns_in_the_wrong_unit_are_told_and_survived():
    rows = [{**row, "accel": row["accel"] / 9.81} for row in drive(0.3, 1.0, 30.0)]
    watch, entries = answered(rows)
    assert watch.counts.refused["contradictory"] > 0
    told = [e for e in entries if "refused" in e]
    assert "accel" in told[0]["refused"]


def test_more_cars_than_are_allowed_are_counted():
    watch, entries = answered(fleet(), LiveSettings(cars=2))
    assert set(watch.cars) == {"red", "blue"}
    assert watch.counts.refused == {"too many cars": len(drive(0.3, 1.0))}
    assert {e["car"] for e in entries} == {"red", "blue"}


@pytest.mark.slow
def test_what_is_kept_of_a_car_is_bounded():
    """A sender of a row each 0.1 ms, for ten windows."""
    settings = LiveSettings(window=0.5, lateness=5.0)
    watch = LiveWatch(settings)
    signals = {"accel_cmd": 0.1, "speed": 20.0}
    for first in range(0, 60_000, 1000):
        watch.take(Batch([Row("red", 1e-4 * i, signals) for i in range(first, first + 1000)]))
        assert len(watch.cars["red"].order.waiting) <= 5000


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"window": 0.0}, "window"),
        ({"lateness": -1.0}, "lateness"),
        ({"cars": 0}, "cars"),
        ({"form": "other"}, "form"),
        ({"estimator": "other"}, "estimator"),
    ],
)
def test_settings_out_of_range_are_refused(given, named):
    with pytest.raises(InputError, match=named):
        LiveSettings(**given)


def test_csv_and_json_lines_give_the_same_rows():
    rows = fleet(2.0)
    names = ("car", "time", "accel_cmd", "accel", "speed", "jerk")
    table = [",".join(names), *(",".join(str(row[name]) for name in names) for row in rows)]
    by_csv, by_json = LineParser(Counts()), LineParser(Counts())
    assert [by_csv.row(line.encode()) for line in table][1:] == [by_json.row(line) for line in lines(rows).splitlines()]
    with pytest.raises(InputError, match="first line: found a, b; needs"):
        LineParser(Counts()).row(b"a,b\n")
    with pytest.raises(InputError, match="grade"):
        LineParser(Counts(), unit=["grade=%"])


def test_csv_cells_that_are_empty_or_no_numbers_are_counted():
    counts = Counts()
    parser, watch = LineParser(counts), LiveWatch(counts=counts)
    table = b"time,accel_cmd,speed\n0,0.1,20\n0.02,,20\n0.04,0.1,fast\n0.06,0.1\n,0.1,20\n0.1,0.1,20\n"
    rows = [row for line in table.splitlines() if (row := parser.row(line)) is not None]
    watch.take(Batch(rows))
    assert counts.refused == {"incomplete": 2, "implausible": 1, "corrupt": 1}
    assert counts.rows == 2
