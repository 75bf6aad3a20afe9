"""Damaged logs and recordings: refused in one printable line, or read as an independent, simple reading has them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avtorch.errors import printable
from avtorch.io import Log, check, read_following, read_leader
from avtorch.io.leaders import RawLeader

from .mutations import AWKWARD, fuzzed, mutated, outcome

ROWS = 24
_T = np.arange(ROWS) / 20
COLUMNS: dict[str, list[Any]] = {
    "time": _T.tolist(),
    "accel_cmd": np.sin(3 * _T).tolist(),
    "accel": np.sin(3 * _T - 0.4).tolist(),
    "speed": (12 - np.cos(3 * _T)).tolist(),
}
MORE = COLUMNS | {
    "engaged": [1] * 20 + [0] * 4,
    "segment": [0] * 12 + [1] * 12,
    "grade": [0.01] * ROWS,
    "spacing": [20.5] * ROWS,
    "lead_speed": [12.0] * ROWS,
    "remark": ["a", 'b "c"', "d, e", "f\ng"] * 6,
}
SIGNALS = [name for name in MORE if name not in ("engaged", "segment", "remark")]


def text(columns: dict[str, list[Any]], end: str = "\n") -> bytes:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator=end)
    writer.writerows([list(columns), *zip(*columns.values(), strict=True)])
    return stream.getvalue().encode()


CSVS = [text(COLUMNS), text(MORE), text(MORE, "\r\n"), b"\xef\xbb\xbf" + text(COLUMNS), text(COLUMNS) + b"\n\n"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def plain(raw: bytes) -> str:
    """The text as its byte order mark says, else UTF-8, else Windows-1252."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252")


DECIMAL_COMMA = re.compile(r"^(\s*[+-]?\d*),(\d+(?:[eE][+-]?\d+)?\s*)$")


def simple(raw: bytes) -> tuple[list[str], list[list[str]]]:
    """Header and rows as the csv module has them, without empty lines, and without blank rows at the end.

    Commas or semicolons stand between cells, whichever the header has more of.
    """
    lines = plain(raw)
    head = next(line for line in lines.splitlines() if line.strip())
    separator = max(",;", key=head.count)
    rows = csv.reader(io.StringIO(lines, newline=""), delimiter=separator)
    table = [row for row in rows if "".join(row).strip() or len(row) > 1]
    while not any(cell.strip() for cell in table[-1]):
        table.pop()
    cells = [cell for row in table[1:] for cell in row]
    if sum(bool(DECIMAL_COMMA.fullmatch(cell)) for cell in cells) > sum("." in cell for cell in cells):
        table[1:] = [[DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row] for row in table[1:]]
    return table[0], table[1:]


def numbers_in(raw: bytes) -> set[float]:
    """Every number of a text, whatever stands between its cells."""
    rows = [row for mark in ",;" for row in csv.reader(io.StringIO(plain(raw), newline=""), delimiter=mark)]
    return {number for row in rows for cell in row for number in (_float(cell), _float(cell.replace(",", ".")))}


def left_out(log: Log) -> int:
    """Rows that the remarks say are not there."""
    more = [int(words.split()[0]) for words in log.remarks if words.endswith("for a cell that is no valid value")]
    return sum(words.endswith("; the row is left out") for words in log.remarks) + sum(more)


def check_log(log: Log, head: list[str], rows: list[list[Any]]) -> None:
    """Every row is there or told, every number is that of its cell, every other column is noted."""
    notes = check(log).notes
    assert all(printable(note) == note for note in notes)
    assert all(np.isfinite(values).all() for name in SIGNALS if (values := getattr(log, name)) is not None)
    assert all((np.diff(log.elapsed[part]) > 0).all() for part in log.segments())
    if "time" not in head:  # another layout, in which a mutation has put it
        return
    assert log.rows + left_out(log) == len(rows)
    kept = in_file(log, head, rows)
    assert len(kept) == log.rows
    for name in SIGNALS:
        values = getattr(log, name)
        assert (values is not None) == (name in head)
        if values is not None:
            cells = [row[head.index(name)] for row in kept]
            assert values.tolist() == [float(cell) for cell in cells], name
            assert all(cell.isascii() and "_" not in cell for cell in cells), name
    if "engaged" in head:
        assert log.engaged.tolist() == [_state(row[head.index("engaged")]) == 1 for row in kept]
    if "segment" in head:
        drive = [float(row[head.index("segment")]) for row in kept]
        assert {k for k in range(1, len(drive)) if drive[k] != drive[k - 1]} <= {part.start for part in log.segments()}
    others = [name for name in head if name not in (*SIGNALS, "engaged", "segment", "jerk", "lead_accel")]
    assert len(log.ignored) == len(others)
    assert not others or any(note.startswith("columns ignored: ") for note in notes)


def in_file(log: Log, head: list[str], rows: list[list[Any]]) -> list[list[Any]]:
    """The rows of a file that a log holds, by their stamps, in their order."""
    at = iter(rows)
    found = []
    for stamp in log.time.tolist():
        for row in at:
            if len(row) == len(head) and _number(row[head.index("time")]) == stamp and _finite(row, head):
                found.append(row)
                break
    return found


def _finite(row: list[Any], head: list[str]) -> bool:
    return all(np.isfinite(_number(row[head.index(name)])) for name in SIGNALS if name in head)


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return np.nan


def _state(cell: str) -> float:
    return {"true": 1.0, "false": 0.0}.get(cell.strip().lower(), _number(cell))


def check_numbers(log: Log, columns: Mapping[str, list[Any]]) -> None:
    """Every row of `columns` is in the log or told, and every number is that of its cell."""
    head = list(columns)
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    assert log.rows + left_out(log) == len(rows)
    kept = in_file(log, head, rows)
    for name in SIGNALS:
        if getattr(log, name) is not None and name in head:
            assert getattr(log, name).tolist() == [float(row[head.index(name)]) for row in kept], name


@pytest.mark.slow
@fuzzed("csv")
@given(raw=mutated(CSVS))
def test_damaged_csv(folder: Path, raw: bytes) -> None:
    path = folder / "lap.csv"
    path.write_bytes(raw)
    log = outcome(lambda: Log.read(path))
    if log is not None and raw[:4] != b"PAR1":
        check_log(log, *simple(raw))


FINITE = st.floats(0, 20).map(lambda x: repr(x).encode())
# what float() takes for a number, and no log means
NOTATIONS = st.sampled_from([b"1_0", "１２".encode(), "٣".encode(), b"1_2.5", "1٫5".encode(), b"Infinity", b"0x1F"])
CELLS = st.one_of(
    FINITE, NOTATIONS, st.floats().map(lambda x: repr(x).encode()), st.sampled_from(AWKWARD), st.binary(max_size=6)
)


@pytest.mark.slow
@fuzzed("csv_cells")
@given(
    cells=st.lists(st.tuples(st.integers(0, ROWS), st.integers(0, 9), CELLS), min_size=1, max_size=2),
    order=st.permutations(range(len(MORE))),
    doubled=st.integers(0, 30),
)  # fmt: skip
def test_odd_cells_and_headers(folder: Path, cells: list, order: list[int], doubled: int) -> None:
    """Cells, names of columns among them, exchanged where the rest stays whole; columns in any order, or one twice."""
    table = [[str(x).encode() for x in row] for row in [list(MORE), *zip(*MORE.values(), strict=True)]]
    for row, column, cell in cells:
        table[row][column] = cell
    order = [*order, doubled] if doubled < len(MORE) else order
    quote = [[b'"' + row[i].replace(b'"', b'""') + b'"' for i in order] for row in table]
    raw = b"\n".join(b",".join(row) for row in quote) + b"\n"
    path = folder / "lap.csv"
    path.write_bytes(raw)
    log = outcome(lambda: Log.read(path))
    if log is not None:
        check_log(log, *simple(raw))


def parquet(columns: dict[str, Any], **options: Any) -> bytes:
    stream = io.BytesIO()
    pq.write_table(pa.table(columns), stream, **options)
    return stream.getvalue()


PARQUETS = [
    parquet(COLUMNS),
    parquet(COLUMNS, compression="none", use_dictionary=False),
    parquet(MORE, compression="zstd", row_group_size=10),
    parquet(COLUMNS | {"speed": [repr(x) for x in COLUMNS["speed"]]}, store_schema=False),
    parquet(COLUMNS | {"frames": [[1, 2]] * ROWS, "speed.raw": ["x"] * ROWS}),
    parquet(COLUMNS | {"grade": [0.01] * 20 + [None] * 4}),
    parquet(COLUMNS | {"engaged": [True] * ROWS, "grade": pa.array([1] * ROWS, pa.int8())}, version="1.0"),
]


@pytest.mark.slow
@fuzzed("parquet")
@given(raw=mutated(PARQUETS))
def test_damaged_parquet(folder: Path, raw: bytes) -> None:
    path = folder / "lap.parquet"
    path.write_bytes(raw)
    log = outcome(lambda: Log.read(path))
    if log is not None:
        names = [name for name in SIGNALS if getattr(log, name) is not None]
        schema = pq.read_schema(io.BytesIO(raw))
        table = pq.read_table(io.BytesIO(raw), columns=[name for name in schema.names if name in names])
        check_numbers(log, {name: table.column(name).to_pylist() for name in table.column_names})
        assert all(printable(note) == note for note in check(log).notes)


STILL = [12.0] * ROWS
NGSIM = {
    "event": [1] * 12 + [2] * 12,
    "time": [*_T[:12], *_T[:12]],
    "spacing": STILL,
    "speed": STILL,
    "lead_speed": STILL,
}
I_24 = {
    "Time": COLUMNS["time"],
    "Velocity": STILL,
    "SpaceGap": [30.0] * 20 + [252.0] * 4,
    "RelativeVelocity": [0.0] * ROWS,
}
ASTAZERO = {"Time": COLUMNS["time"], "SpeedDoppler1": STILL, "SpeedDoppler2": STILL, "Spacing2": STILL, "Accel2": STILL}
ZALAZONE = {"Time": COLUMNS["time"], "Speed1": STILL, "Speed2": STILL, "IVS1": STILL}
LEADERS = [text({"time": COLUMNS["time"], "speed": COLUMNS["speed"]}), text(NGSIM), text(I_24), text(ASTAZERO)]
LEADERS.append(b"Vehicle_order,Audi(A8),BMW(X5)\nRows,24\n" + text(ZALAZONE))


@fuzzed("leaders")
@given(raw=mutated(LEADERS), event=st.sampled_from([None, 1, 2]), vehicle=st.sampled_from([None, None, 2]))
def test_damaged_recordings(folder: Path, raw: bytes, event: int | None, vehicle: int | None) -> None:
    path = folder / "leader.csv"
    path.write_bytes(raw)
    leader = outcome(lambda: read_leader(path, event=event, vehicle=vehicle))
    log = outcome(lambda: read_following(path, event=event, vehicle=vehicle))
    found = [x for x in (leader, log) if x is not None]
    numbers = numbers_in(raw) if found else set()
    for x in found:
        assert printable(x.name) == x.name
        assert np.isfinite(x.speed).all()
        assert (x.speed >= (0 if isinstance(x, RawLeader) else -2)).all()  # a plain log may roll back a little
        assert (np.diff(x.time) > 0).all()
        assert isinstance(x, RawLeader) or x.spacing is not None
        # as recorded, or in km/h; what is below zero was set to zero
        known = {0.0} | {y for v in numbers for y in (v, v / 3.6)}
        assert set(x.speed.tolist()) <= known


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return 0.0


VALUES = st.one_of(
    st.floats(), st.integers(-(10**400), 10**400), st.none(), st.booleans(), st.text(max_size=5), st.binary(max_size=3),
    st.complex_numbers(), st.lists(st.integers(), max_size=2), st.dates(), st.decimals(),
)  # fmt: skip
DTYPES = ["f2", "f4", "i4", "i8", "u1", "?", "U8", "S8", "O", "c16", "M8[ns]", "m8[s]"]


@pytest.mark.slow
@fuzzed("arrays")
@given(data=st.data())
def test_odd_arrays(data: st.DataObject) -> None:
    """Signals as arrays of any kind and shape, with odd values in them, in columns that are there or not."""
    columns: dict[str, Any] = {name: np.asarray(MORE[name]) for name in MORE if name != "remark"}
    for name in data.draw(st.lists(st.sampled_from(list(columns)), unique=True, max_size=3)):
        kind = data.draw(st.sampled_from(["value", "dtype", "drop", "none", "shape", "masked", "name", "any"]))
        if kind == "value":
            values = columns[name].tolist()
            values[data.draw(st.integers(0, ROWS - 1))] = data.draw(VALUES)
            columns[name] = values
        elif kind == "dtype":
            try:
                columns[name] = columns[name].astype(data.draw(st.sampled_from(DTYPES)))
            except (TypeError, ValueError):
                continue
        elif kind == "drop":
            del columns[name]
        elif kind == "none":
            columns[name] = None
        elif kind == "shape":
            columns[name] = columns[name].reshape(data.draw(st.sampled_from([(24, 1), (2, 12), (1, 24)])))
        elif kind == "masked":
            columns[name] = np.ma.masked_array(columns[name], mask=np.arange(ROWS) == data.draw(st.integers(0, ROWS)))
        elif kind == "name":
            columns[data.draw(st.text(max_size=5))] = columns[name]
        else:
            columns[name] = data.draw(VALUES)
    # drawn before: within `outcome` its limits would be those of hypothesis, too
    called = data.draw(st.text(max_size=5))
    log = outcome(lambda: Log.from_arrays(name=called, **columns))
    if log is not None:
        assert printable(log.name) == log.name
        there = {name: x for name, x in columns.items() if name in SIGNALS and x is not None}
        check_numbers(log, {name: list(x.filled(np.nan) if np.ma.isMA(x) else x) for name, x in there.items()})
