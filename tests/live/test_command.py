"""`avtorch watch`, as it is typed."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from avtorch.cli import main
from avtorch.cli.watch import host_and_port
from avtorch.errors import InputError
from tests.live.drives import drive, fleet, lines, until

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rows.jsonl").write_bytes(lines(fleet(8.0)))
    return tmp_path


def started(here: Path, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "avtorch.cli", "watch", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, cwd=here, env=environment, stderr=subprocess.PIPE, **options)


def test_a_line_a_window_and_a_count_at_the_end(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (here / "rows.jsonl").open("ab") as stream:
        stream.write(b'{"car": "red", "ti\n')
    assert main(["watch", "rows.jsonl"]) == 0
    told = capsys.readouterr()
    entries = [json.loads(line) for line in told.out.splitlines()]
    # open windows are closed at the end of a file that is not followed
    assert len(entries) == 12
    assert set(entries[0]) >= {"car", "window", "start_s", "end_s", "T_L", "K_L", "alerts", "why", "p_string_stable"}
    lines_ = told.err.splitlines()
    assert lines_[0].startswith("1200 rows of 3 cars, 12 windows, alerts: accepted_change ")
    assert lines_[1].startswith("left out: 1 corrupt (no JSON object")
    assert main(["watch", "rows.jsonl", "--quiet", "--out", "o.jsonl"]) == 0
    assert capsys.readouterr() == ("", "")
    assert [json.loads(line) for line in Path("o.jsonl").read_text().splitlines()] == entries


@pytest.mark.slow
def test_standard_input(here: Path) -> None:
    names = ("accel_cmd", "accel", "speed", "jerk")
    rows = [",".join(str(row[name]) for name in ("time", *names)) for row in drive(1.5, 0.5, 6.0)]
    text = "\n".join([",".join(("time", "u", *names[1:])), *rows])
    process = started(here, "-", "--map", "accel_cmd=u", "--car", "blue", stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    out, err = process.communicate(text.encode(), timeout=120)
    entries = [json.loads(line) for line in out.splitlines()]
    assert process.returncode == 0, err
    assert [(e["car"], e["end_s"]) for e in entries] == [("blue", 2.0), ("blue", 4.0), ("blue", 6.0)]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_followed_file_stopped_in_its_midst_and_gone_on_with(here: Path, number: int) -> None:
    text = lines(fleet(12.0))
    half = len(text) // 2
    (here / "live.jsonl").write_bytes(text[:half])
    arguments = ("live.jsonl", "--follow", "--state", "state", "--out", "out.jsonl")

    def written(least: int) -> bool:
        path = here / "out.jsonl"
        return path.exists() and path.read_bytes().count(b"\n") >= least

    first = started(here, *arguments)
    until(lambda: written(6) or first.poll() is not None)
    first.send_signal(number)
    _, err = first.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert first.returncode == 0, err
        assert b"state kept in state" in err
        assert (here / "state" / "watch.state").exists()
    with (here / "live.jsonl").open("ab") as stream:
        stream.write(text[half:])
    second = started(here, *arguments)
    until(lambda: written(15) or second.poll() is not None)
    second.send_signal(signal.SIGINT)
    assert second.communicate(timeout=60)
    (here / "whole.jsonl").write_bytes(text)
    assert main(["watch", "whole.jsonl", "--state", "other", "--out", "plain.jsonl", "--quiet"]) == 0
    assert (here / "out.jsonl").read_bytes() == (here / "plain.jsonl").read_bytes()


@pytest.mark.slow
def test_a_folder_of_states_is_of_one_watch_at_a_time(here: Path) -> None:
    from avtorch.io import sole_use

    with sole_use(here / "state", work="avtorch watch"):
        second = started(here, "rows.jsonl", "--state", "state", "--out", "o.jsonl")
        _, err = second.communicate(timeout=60)
    assert second.returncode == 2
    assert err.startswith(b"avtorch: state: in use by avtorch watch (pid ")
    assert not (here / "o.jsonl").exists()


@pytest.mark.slow
def test_reading_pauses_where_answers_are_not_taken(here: Path) -> None:
    """A reader of the answers that stops: the watch stops reading, and its memory stays what it was."""
    process = started(here, "-", "--window", "0.5", stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    os.set_blocking(process.stdin.fileno(), False)
    rows = [{"time": 0.05 * i, "accel_cmd": 0.0, "speed": 20.0} for i in range(60_000)]
    text = lines(rows)
    sent = 0
    quiet = time.monotonic()
    while sent < len(text) and time.monotonic() - quiet < 15.0:
        try:
            sent += os.write(process.stdin.fileno(), text[sent : sent + 4096])
            quiet = time.monotonic()
        except BlockingIOError:
            time.sleep(0.02)
    assert 0 < sent < len(text), "6000 answers are far more than a pipe holds"
    out: list[bytes] = []
    for line in iter(process.stdout.readline, b""):
        out.append(line)
        if len(out) == 100:  # fewer than the two pipes hold
            break
    process.kill()
    process.communicate()
    assert [json.loads(line)["window"] for line in out] == list(range(1, len(out) + 1))


def test_metrics_are_served_while_it_runs(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("prometheus_client")
    from avtorch.live import Batch, Counts, LineParser, LiveWatch, Metrics, watch_source

    counts = Counts()
    watch, parser = LiveWatch(counts=counts), LineParser(counts)
    metrics = Metrics(watch, "127.0.0.1", 0)
    pages = []

    class Lines:
        identity = None

        def batches(self, stop, start=None):
            for line in [*lines(fleet(4.2)).splitlines(), b"{"]:
                row = parser.row(line)
                yield Batch([] if row is None else [row])
            with urllib.request.urlopen(f"http://127.0.0.1:{metrics.port}/metrics", timeout=10) as page:
                pages.append(page.read().decode())

    try:
        watch_source(Lines(), watch, [], answered=metrics.answered)
    finally:
        metrics.close()
    found = dict(line.rsplit(" ", 1) for line in pages[0].splitlines() if not line.startswith("#"))
    assert float(found["avtorch_rows_total"]) == 630
    assert float(found['avtorch_refused_total{kind="corrupt"}']) == 1
    assert float(found["avtorch_windows_total"]) == 6
    assert float(found["avtorch_cars"]) == 3
    assert float(found["avtorch_latency_seconds_count"]) == 6
    assert 0 <= float(found['avtorch_p_string_stable{car="blue"}']) <= 1
    assert float(found['avtorch_alerts_total{detector="stability"}']) == counts.alerts["stability"]
    assert main(["watch", "rows.jsonl", "--prometheus", "0", "--out", "o.jsonl"]) == 0
    assert capsys.readouterr().err.startswith("Metrics: http://127.0.0.1:")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nothing.jsonl"], "nothing.jsonl: no such file"),
        (["."], ".: is a directory; a file of rows"),
        (["-", "--follow"], "--follow: has a meaning for a file of lines alone"),
        (["rows.jsonl", "--rate", "2"], "--rate: has a meaning for a recording alone"),
        (["rows.jsonl", "--prometheus", "x"], "--prometheus: found 'x', needs a port"),
        (["rows.jsonl", "--lateness", "-1"], "--lateness: found -1"),
        (["rows.jsonl", "--unit", "speed=furlong"], "furlong"),
        (["rows.jsonl", "--out", "."], ".: is no regular file"),
        (["rows.jsonl", "--out", "./rows.jsonl"], "--out: './rows.jsonl' is the source itself"),
        (["mqtt://localhost"], "MQTT: found 'mqtt://localhost', without a topic"),
        (["rows.jsonl", "--out", "mqtt://localhost/a/#"], "answers need one topic"),
    ],
)
def test_bad_input_is_one_line(
    here: Path, refused: Callable[[list[str]], str], arguments: list[str], told: str
) -> None:
    assert told in refused(["watch", *arguments])


def test_a_closed_standard_input_is_one_line(
    here: Path, refused: Callable[[list[str]], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    assert "standard input is closed" in refused(["watch", "-"])


@pytest.mark.parametrize("module", ["paho", "prometheus_client"])
def test_the_extra_is_named_where_it_is_missing(
    here: Path, refused: Callable[[list[str]], str], monkeypatch: pytest.MonkeyPatch, module: str
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == module else find(name, *more))
    option = ["--out", "mqtt://localhost/a"] if module == "paho" else ["--prometheus", "0"]
    assert "pip install 'avtorch[live]'" in refused(["watch", "rows.jsonl", *option])


def test_addresses_of_metrics() -> None:
    assert host_and_port("9100") == ("127.0.0.1", 9100)
    assert host_and_port("0.0.0.0:9100") == ("0.0.0.0", 9100)
    with pytest.raises(InputError, match="needs a port"):
        host_and_port("localhost:70000")
