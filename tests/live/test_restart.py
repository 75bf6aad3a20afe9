"""A watch that is stopped, or killed, and started again goes on to the bit."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from threading import Event

import pytest

from avtorch.errors import InputError
from avtorch.live import (
    Counts,
    FileSink,
    FileSource,
    KeptCars,
    LineParser,
    LineSink,
    LiveSettings,
    LiveWatch,
    watch_source,
)
from tests.live.drives import fleet, lines

CHUNK = 997  # bytes, so that batches end in the middle of rows and windows


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("avtorch.live.source.CHUNK", CHUNK)


def begin(folder: Path, settings: LiveSettings, *, follow: bool = False) -> tuple[LiveWatch, FileSource, KeptCars]:
    counts = Counts()
    watch = LiveWatch(settings, counts)
    source = FileSource(folder / "rows.jsonl", LineParser(counts), follow=follow)
    return watch, source, KeptCars(folder / "state", source.identity)


class Interrupted(Exception):
    pass


class EndsAfter:
    """Ends the watch after so many windows: as Ctrl-C does, or as a crash."""

    def __init__(self, many: int, stop: Event | None = None) -> None:
        self.left, self.stop = many, stop

    def answered(self, answer, car, seconds) -> None:
        self.left -= 1
        if self.left == 0:
            if self.stop is None:
                raise Interrupted
            self.stop.set()


def uncut(folder: Path, settings: LiveSettings) -> list[str]:
    counts, told = Counts(), io.StringIO()
    watch = LiveWatch(settings, counts)
    kept = KeptCars(folder / "other_state")
    watch_source(FileSource(folder / "rows.jsonl", LineParser(counts)), watch, [LineSink(told)], kept=kept)
    return told.getvalue().splitlines()


SETTINGS = {
    "map": LiveSettings(),
    "sgld": LiveSettings(estimator="sgld"),
    "latent": LiveSettings(form="latent", mode="posterior"),
}


@pytest.mark.parametrize("which", SETTINGS)
def test_stopped_again_and_again_it_writes_what_an_uncut_one_writes(tmp_path: Path, which: str) -> None:
    (tmp_path / "rows.jsonl").write_bytes(lines(fleet(8.0)))
    settings, out = SETTINGS[which], tmp_path / "out.jsonl"
    total, starts = 0, 0
    while total < 9:
        watch, source, kept = begin(tmp_path, settings)
        stop = Event()
        sink = FileSink(out, resume=kept.same_source)
        watch_source(source, watch, [sink], stop=stop, kept=kept, answered=EndsAfter(1, stop).answered)
        sink.close()
        total, starts = watch.counts.windows, starts + 1
        assert watch.counts.repeated == 0
    assert starts >= 3
    assert out.read_text().splitlines() == uncut(tmp_path, settings)
    assert watch.counts.refused == {}


def test_killed_it_writes_each_window_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The state is written at any time before a crash; here after every batch."""
    monkeypatch.setattr(sys.modules["avtorch.live.watch_source"], "EVERY_S", 0.0)  # the function has its name
    monkeypatch.setattr("avtorch.live.source.CHUNK", 10 * CHUNK)  # a batch costs two files
    (tmp_path / "rows.jsonl").write_bytes(lines(fleet(12.0)))
    out = tmp_path / "out.jsonl"
    repeated = 0
    for crash in (3, 5, 6, 100):
        watch, source, kept = begin(tmp_path, SETTINGS["map"])
        sink = FileSink(out, resume=kept.same_source)
        try:
            watch_source(source, watch, [sink], kept=kept, answered=EndsAfter(crash).answered)
        except Interrupted:
            with out.open("a") as stream:
                stream.write('{"car": "re')  # half a line
        sink.close()
        repeated += watch.counts.repeated
        assert watch.counts.refused == {}, "rows read again are passed over, neither late nor doubled"
    assert repeated > 0, "a crash loses the states of the last batch"
    by_car: dict[str, list[str]] = {}
    for line in out.read_text().splitlines():
        by_car.setdefault(json.loads(line)["car"], []).append(line)
    plain: dict[str, list[str]] = {}
    for line in uncut(tmp_path, SETTINGS["map"]):
        plain.setdefault(json.loads(line)["car"], []).append(line)
    assert by_car == plain


def test_a_file_is_followed_cut_and_replaced(tmp_path: Path) -> None:
    """Half a line, the rest of it, then another file of the same name."""
    text = lines(fleet(8.0))
    half = text.index(b"\n", len(text) // 2) - 30
    path = tmp_path / "rows.jsonl"
    path.write_bytes(text[:half])
    watch, source, _ = begin(tmp_path, SETTINGS["map"], follow=True)
    rows, quiet, step, stop = [], 0, 0, Event()
    for batch in source.batches(stop):
        rows += batch.rows
        quiet = 0 if batch.rows else quiet + 1
        if quiet < 2:
            continue
        quiet, step = 0, step + 1
        if step == 1:
            assert len(rows) == text[:half].count(b"\n")
            with path.open("ab") as stream:
                stream.write(text[half:])
        elif step == 2:
            assert len(rows) == text.count(b"\n")
            (tmp_path / "new").write_bytes(text[:1000])
            (tmp_path / "new").replace(path)
        elif step == 3:
            assert len(rows) == text.count(b"\n") + text[:1000].count(b"\n")
            stop.set()
    assert step == 3
    assert not watch.counts.refused


def test_a_file_that_takes_the_place_of_another_has_a_header_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("time,accel_cmd,speed\n1,0.5,20\n")
    parser, stop, rows = LineParser(Counts()), Event(), []
    source = FileSource(path, parser, follow=True)
    for batch in source.batches(stop):
        rows += batch.rows
        if len(rows) == 2:
            stop.set()
        elif len(rows) == 1 and not (tmp_path / "old").exists():
            path.rename(tmp_path / "old")
            path.write_text("time,speed,accel_cmd\n2,20,0.5\n")
    assert [row.signals for row in rows] == [{"accel_cmd": 0.5, "speed": 20.0}] * 2
    assert not parser.counts.refused


def test_what_follows_is_read_by_a_header_below_empty_lines(tmp_path: Path) -> None:
    text = "\n\ntime,accel_cmd,speed\n1,0.5,20\n"
    (tmp_path / "rows.csv").write_text(text + "2,0.5,20\n")
    source = FileSource(tmp_path / "rows.csv", LineParser(Counts()))
    rows = [row for batch in source.batches(Event(), len(text)) for row in batch.rows]
    assert [row.time for row in rows] == [2.0]


def test_states_of_other_settings_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rows.jsonl").write_bytes(lines(fleet(4.0)))
    watch, source, kept = begin(tmp_path, SETTINGS["map"])
    watch_source(source, watch, [], kept=kept)
    watch, source, kept = begin(tmp_path, LiveSettings(window=3.0))
    with pytest.raises(InputError, match=r"watch.state: was begun with window 2.0, not 3.0; use the same"):
        kept.restore(watch)
    path = tmp_path / "state" / "watch.state"
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"watch\.state: is damaged"):
        begin(tmp_path, SETTINGS["map"])


def test_a_file_of_something_else_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine\n")
    with pytest.raises(InputError, match="line 1: is no answer of avtorch watch"):
        FileSink(tmp_path / "notes.txt")
    assert (tmp_path / "notes.txt").read_text() == "mine\n"
    for line in (
        '{"car": "red", "time": 1, "accel_cmd": 0, "speed": 9}',
        '{"car": "red", "window": "x"}',
        '{"car": ["red"]}',
        "[]",
    ):
        (tmp_path / "rows.jsonl").write_text(f"{line}\n{line}")
        with pytest.raises(InputError, match="line 1: is no answer of avtorch watch"):
            FileSink(tmp_path / "rows.jsonl", resume=True)
        assert (tmp_path / "rows.jsonl").read_text() == f"{line}\n{line}"
