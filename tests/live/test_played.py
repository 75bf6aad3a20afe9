"""Recordings played back: ROS 2 bags, as an MCAP file and as a folder with a database, and Parquet."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest
from mcap_ros2.writer import Writer

from avtorch import Log
from avtorch.cli import main
from avtorch.errors import InputError
from avtorch.live import KeptCars, LineSink, LiveWatch, PlayedLog, watch_source
from tests.io.formats.test_bags import cdr, folder_of
from tests.live.drives import drive

NAMES = ("accel_cmd", "accel", "speed", "jerk")
START_NS = 1_700_000_000 * 10**9


def mcap(path: Path) -> Path:
    definition = "".join(f"float64 {name}\n" for name in NAMES)
    with path.open("wb") as stream:
        writer = Writer(stream)
        schema = writer.register_msgdef("car/msg/Motion", definition)
        for row in drive(1.5, 0.5, 6.0):
            stamp = START_NS + round(row["time"] * 1e9)
            message = {name: row[name] for name in NAMES}
            writer.write_message("/car", schema, message, log_time=stamp, publish_time=stamp)
        writer.finish()
    return path


def database(path: Path) -> Path:
    """A folder of `ros2 bag record`: a topic a signal, each message at the time at which it was recorded."""
    rows = drive(1.5, 0.5, 6.0)
    topics = {f"/{name}": ("std_msgs/msg/Float64", [cdr("d", row[name]) for row in rows]) for name in NAMES}
    return folder_of(path, topics, [START_NS + round(row["time"] * 1e9) for row in rows], late=0)


def parquet(path: Path) -> Path:
    rows = drive(1.5, 0.5, 6.0)
    Log.from_arrays(**{name: [row[name] for row in rows] for name in ("time", *NAMES)}).write(path)
    return path


@pytest.mark.parametrize(
    ("write", "file", "channel"), [(mcap, "drive.mcap", "/car/{}"), (database, "drive", "/{}/data")]
)
def test_a_bag_gives_the_windows_of_its_rows(
    write: Callable[[Path], Path], file: str, channel: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = [part for name in NAMES for part in ("--map", f"{name}={channel.format(name)}")]
    assert main(["watch", str(write(tmp_path / file)), *maps]) == 0
    told = capsys.readouterr()
    by_bag = [json.loads(line) for line in told.out.splitlines()]
    assert main(["watch", str(parquet(tmp_path / "drive.parquet"))]) == 0
    by_table = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [e["car"] for e in by_bag] == ["drive"] * 3
    assert [e["end_s"] - START_NS / 1e9 for e in by_bag] == pytest.approx([2.0, 4.0, 6.0], abs=1e-6)  # of float64
    for one, other in zip(by_bag, by_table, strict=True):
        assert one["n"] == other["n"]
        assert one["T_L"]["mean"] == pytest.approx(other["T_L"]["mean"], rel=1e-4)  # stamps rounded to 1 us
        assert one["alerts"] == other["alerts"]
    assert told.err.startswith("300 rows of 1 car, 3 windows")


@pytest.mark.usefixtures("in_this_process")
def test_it_goes_on_at_the_row_where_it_stopped(tmp_path: Path) -> None:
    path, told = parquet(tmp_path / "drive.parquet"), io.StringIO()
    for _ in range(3):
        watch, stop, source = LiveWatch(), Event(), PlayedLog(path, rate=100.0)
        kept = KeptCars(tmp_path / "state", source.identity)
        end = lambda *_, stop=stop: stop.set()  # noqa: E731
        watch_source(source, watch, [LineSink(told)], stop=stop, kept=kept, answered=end)
    whole = io.StringIO()
    watch_source(PlayedLog(path), LiveWatch(), [LineSink(whole)])
    assert told.getvalue().splitlines() == whole.getvalue().splitlines()[:2]
    assert watch.counts.rows == 300


@pytest.mark.usefixtures("in_this_process")
def test_it_is_played_at_its_rate(tmp_path: Path) -> None:
    begun = time.monotonic()
    rows = sum(len(batch.rows) for batch in PlayedLog(parquet(tmp_path / "d.parquet"), rate=20.0).batches(Event()))
    assert rows == 300
    assert time.monotonic() - begun >= 5.98 / 20.0


@pytest.mark.usefixtures("in_this_process")
def test_what_cannot_be_played_is_refused(tmp_path: Path) -> None:
    rows = drive(1.5, 0.5, 6.0)
    Log.from_arrays(
        time=[r["time"] for r in rows], speed=[r["speed"] for r in rows], throttle=[0.1 for _ in rows]
    ).write(tmp_path / "pedals.parquet")
    with pytest.raises(InputError, match="accel_cmd"):
        PlayedLog(tmp_path / "pedals.parquet")
    with pytest.raises(InputError, match="rate: found 0, needs"):
        PlayedLog(parquet(tmp_path / "drive.parquet"), rate=0.0)
