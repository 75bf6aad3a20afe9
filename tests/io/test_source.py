"""A log may be a `Log`, a path or a data frame, for every function that takes one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from avtorch import GLVDPlant, Leader, Log, check, compare, diagnose, estimate, simulate
from avtorch.errors import InputError
from avtorch.io import as_log, as_logs
from avtorch.io.tables import frame_table


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Leader.default(start=50.0, duration=54.0, dt=0.1), plant=GLVDPlant(0.5, 0.9)).log()


def columns(log: Log) -> dict[str, np.ndarray]:
    names = ("time", "accel_cmd", "accel", "speed")
    return {name: values for name in names if (values := getattr(log, name)) is not None}


class OnlyArrow:
    """A frame of a library that knows Arrow's protocol alone."""

    def __init__(self, table: pa.Table) -> None:
        self._table = table

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        return self._table.__arrow_c_stream__(requested_schema)


def pandas_frame(given: dict[str, np.ndarray]) -> Any:
    return pytest.importorskip("pandas").DataFrame(given)


def polars_frame(given: dict[str, np.ndarray]) -> Any:
    return pytest.importorskip("polars").DataFrame(given)


FRAMES = {
    "pandas": pandas_frame,
    "polars": polars_frame,
    "arrow": pa.table,
    "capsule": lambda given: OnlyArrow(pa.table(given)),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_a_frame_of_any_library_is_read_to_the_bit(kind: str, log: Log) -> None:
    read = as_log(FRAMES[kind](columns(log)))
    for name, values in columns(log).items():
        assert np.array_equal(getattr(read, name), values), name


@pytest.mark.parametrize("kind", ["pandas", "polars"])
def test_names_and_units_are_given_as_for_a_file(kind: str, log: Log) -> None:
    assert log.speed is not None
    given = {"t": log.time, "cmd": log.accel_cmd, "v": 3.6 * log.speed}
    read = as_log(FRAMES[kind](given), map={"time": "t", "accel_cmd": "cmd", "speed": "v"}, unit=["speed=km/h"])
    # one rounding on the way there and one on the way back
    np.testing.assert_allclose(read.speed, log.speed, rtol=1e-15)


def test_an_index_of_times_is_the_clock(log: Log) -> None:
    pandas = pytest.importorskip("pandas")
    given = {name: values for name, values in columns(log).items() if name != "time"}
    start = pandas.Timestamp("2026-01-05 12:00:00")
    frame = pandas.DataFrame(given, index=start + pandas.to_timedelta(log.time, unit="s"))
    read = as_log(frame)
    assert read.epoch_s == start.timestamp()
    np.testing.assert_allclose(read.elapsed, log.elapsed, atol=1e-6)  # stamps of microseconds
    named = pandas.DataFrame(given, index=pandas.Index(log.time, name="time"))
    assert np.array_equal(as_log(named).time, log.time)


def test_rows_that_were_left_out_of_a_frame_leave_no_column_behind(log: Log) -> None:
    frame = pandas_frame(columns(log))
    read = as_log(frame[frame["time"] > 10.0])
    assert read.time[0] > 10.0
    assert read.rows < log.rows


def test_text_and_missing_cells_are_read_as_in_a_file(log: Log) -> None:
    given: dict[str, Any] = {name: [str(x) for x in values] for name, values in columns(log).items()}
    assert np.array_equal(as_log(pa.table(given)).accel_cmd, log.accel_cmd)
    given["speed"][4] = None
    read = as_log(pa.table(given))
    assert read.rows == log.rows - 1
    given["speed"][4] = "fast"
    assert "'fast' is no number" in as_log(pa.table(given)).remarks[0]


def test_a_column_that_is_no_number_does_not_disturb(log: Log) -> None:
    table = pa.table(columns(log)).append_column("where", pa.array([[1.0, 2.0]] * log.rows))
    assert frame_table(table).names == ("time", "accel_cmd", "accel", "speed")
    assert as_log(table).rows == log.rows


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"time": [0.0]}, r"log: found a dict, needs a Log, a path or a DataFrame"),
        (3.5, "log: found a float, needs a Log, a path or a DataFrame"),
        ([], "log: found a list, needs a Log, a path or a DataFrame"),
        (pa.table({"time": [0.0, 0.1]}), "DataFrame: column 'accel_cmd' is missing"),
    ],
)
def test_anything_else_is_one_clear_line(given: Any, said: str) -> None:
    with pytest.raises(InputError, match=said):
        as_log(given)


def test_names_for_a_log_that_has_been_read_are_refused(log: Log) -> None:
    with pytest.raises(InputError, match="map: found beside a Log, which has been read"):
        estimate(log, map={"speed": "v"})


def test_several_logs_may_be_of_any_kind(log: Log, tmp_path: Path) -> None:
    log.write(tmp_path / "a.csv")
    read = as_logs([tmp_path / "a.csv", str(tmp_path / "a.csv"), log, pa.table(columns(log))])
    assert [one.rows for one in read] == [log.rows] * 4
    assert read[2] is log
    with pytest.raises(InputError, match="logs: found a int"):
        as_logs([log, 3])  # type: ignore[list-item]


@pytest.mark.slow
def test_every_function_answers_the_same_of_a_path_a_frame_and_a_log(log: Log, tmp_path: Path) -> None:
    log.write(tmp_path / "a.parquet")
    whole = pa.table({**columns(log), "jerk": log.jerk}) if log.jerk is not None else pa.table(columns(log))
    kinds: list[Any] = [log, tmp_path / "a.parquet", whole]
    estimated = [estimate(one, estimator="map").windows[-1].window.belief.mean.tolist() for one in kinds]
    assert estimated[0] == estimated[1] == estimated[2]
    diagnosed = [diagnose(one, effects=["sensor_bias"], pairs=False).probability("sensor_bias") for one in kinds]
    assert diagnosed[0] == diagnosed[1] == diagnosed[2]
    compared = [compare(one, [kinds[0]], effects=[]).p_value for one in kinds]
    assert compared[0] == compared[1] == compared[2]


def test_a_check_proposes_how_to_read_a_frame(log: Log) -> None:
    assert log.speed is not None
    frame = pandas_frame({"Zeit [s]": log.time, "AccReq": log.accel_cmd, "VehSpd_kph": 3.6 * log.speed})
    found = check(frame)
    assert found.proposal is not None
    assert found.proposal.map["accel_cmd"] == "AccReq"
    assert found.proposal.unit == {"speed": "km/h"}
    assert found.log is not None
    assert found.log.rows == log.rows
    given = check(frame, map={"time": "Zeit [s]", "accel_cmd": "AccReq", "speed": "VehSpd_kph"}, unit="speed=km/h")
    assert given.proposal is not None
    assert {one.reason.split(",")[0] for name, one in given.proposal.signals.items() if name != "time"} == {"as given"}
    assert given.log is not None
    lacking = check(pa.table({"time": [0.0, 0.1]}))
    assert lacking.log is None
    assert lacking.fault is not None
