"""Files that are not logs, some of them hostile: one printable line each, at once and in little memory."""

from __future__ import annotations

import os
import re
import socket
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io import Log, check, read_following, read_leader, tables, write_json
from avtorch.io.tables import read_table

from .drives import drive, write
from .formats.survival import in_time

GOOD = drive(seconds=4.0)
HEAD = "time,accel_cmd,speed\n"
READERS: dict[str, Callable[[Path], object]] = {
    "log": Log.read,
    "leader": read_leader,
    "following": read_following,
}


@pytest.fixture(autouse=True)
def _in_time() -> Iterator[None]:
    with in_time():
        yield


def refused(read: Callable[[], object], *words: str) -> str:
    with pytest.raises(InputError) as fault:
        read()
    said = str(fault.value)
    assert said.isprintable(), said
    without_folder = re.sub(r"^/\S*/", "", said)  # whose length is that of a place for tests
    assert len(without_folder) < 500, said
    for word in words:
        assert word in said, said
    return said


# messages ---------------------------------------------------------------------------------------------------


def test_a_message_is_one_printable_line_whatever_is_in_it() -> None:
    said = str(InputError("lap\x1b[31m\r\nof\u202e\x9b\udc80\x00" + 5000 * "x"))
    assert said.startswith(r"lap\x1b[31m\r\nof\u202e\x9b\udc80\x00xxx")
    assert said.isprintable()
    assert len(said) <= 1000
    assert str(InputError(said)) == said
    assert printable("m/s² größe 速度 a\u00a0b") == "m/s² größe 速度 a\u00a0b"
    assert quoted("speed\u00a0") == r"'speed\xa0'"
    assert quoted(50 * "a", 10) == "'aaaaaaaaaa'... (40 more characters)"
    assert listed(["a"] * 15) == ", ".join(["a"] * 12) + " and 3 more"


# what is opened ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_only_regular_files_are_opened(read: Callable[[Path], object], tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    refused(lambda: read(tmp_path / "pipe.csv"), "is no regular file")
    refused(lambda: read(Path("/dev/zero")), "/dev/zero: is no regular file")
    refused(lambda: read(tmp_path), "is a directory")
    with socket.socket(socket.AF_UNIX) as end:
        end.bind(str(tmp_path / "end.csv"))
        refused(lambda: read(tmp_path / "end.csv"), "cannot be read")


def test_a_link_to_a_log_is_a_log(tmp_path: Path) -> None:
    write(tmp_path / "lap.csv", GOOD)
    (tmp_path / "link.csv").symlink_to(tmp_path / "lap.csv")
    assert Log.read(tmp_path / "link.csv").rows == 200
    (tmp_path / "circle.csv").symlink_to(tmp_path / "circle.csv")
    refused(lambda: Log.read(tmp_path / "circle.csv"), "cannot be read")


def test_a_file_beyond_the_limit_is_not_read(tmp_path: Path) -> None:
    huge = tmp_path / "huge.csv"
    huge.write_text(HEAD)
    os.truncate(huge, tables.MOST_BYTES + 1)  # a hole: it takes no room on the disk
    tracemalloc.start()
    refused(lambda: Log.read(huge), "536,870,913 bytes; needs 536,870,912 at most")
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_names_that_no_file_has(read: Callable[[Path], object], tmp_path: Path) -> None:
    refused(lambda: read(tmp_path / (300 * "x" + ".csv")), "name too long")
    refused(lambda: read(tmp_path / "a\0b.csv"), "null byte")
    refused(lambda: read(tmp_path / "\x1b[31mred\n.csv"), r"\x1b[31mred\n.csv: no such file")
    refused(lambda: read(tmp_path / "\udcff.csv"), "no such file")


def test_a_name_with_no_room_for_a_mapping_beside_it(tmp_path: Path) -> None:
    """255 bytes are a name; with `.toml` for `.csv` they are one too many, so there is no such file."""
    path = write(tmp_path / (251 * "x" + ".csv"), GOOD)
    assert Log.read(path).rows == 200


# the mapping beside a log -----------------------------------------------------------------------------------


def with_mapping(tmp_path: Path, text: str) -> Path:
    (tmp_path / "lap.toml").write_text(text, encoding="utf-8")
    return write(tmp_path / "lap.csv", GOOD)


SECRET = "root:x:0:0:root:/root"


def test_a_mapping_is_no_link(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text(f"{SECRET}\n", encoding="utf-8")
    write(tmp_path / "lap.csv", GOOD)
    (tmp_path / "lap.toml").symlink_to(tmp_path / "secret")
    assert "root:x" not in refused(lambda: Log.read(tmp_path / "lap.csv"), "lap.toml: is a symbolic link")
    (tmp_path / "lap.toml").unlink()
    os.mkfifo(tmp_path / "lap.toml")
    refused(lambda: Log.read(tmp_path / "lap.csv"), "lap.toml: is no regular file")


MAPPINGS = {
    "deep": ("a=" + 5000 * "[", "nested too deeply"),
    "dots": (50_000 * "a." + "a=1", "more than 64 dots"),
    "huge": ("#" * 1_000_001, "needs 1,000,000 at most"),
    "number": ("[unit]\nspeed = " + 5000 * "9", "out of range"),
    "steered": ('[map]\n"\\u001b[31m" = "a"\n', r"'\x1b[31m' is no signal"),
    "long": (f'[unit]\nspeed = "{10_000 * "u"}"\n', "not known for speed"),
    "long_key": (f'"{10_000 * "u"}" = 1\n', "is not known"),
    "twice": (f"[unit]\nspeed = 'm/s'\nspeed = '{SECRET}'\n", "line 3, column"),
    "binary": ("a = \x01", "line 1, column 5"),
    "syntax": ("[map", "no readable TOML"),
    "table": ("[maps]\naccel='a'", "[maps] is not known"),
    "no_table": ("map = 3", "map is no table"),
    "dotted": ("[map]\naccel.x = 'a'", "[map] accel: is a dict"),
    "signal": ("[map]\nacc = 'a'", "'acc' is no signal"),
    "unit": ("[unit]\nspeed = 'furlongs'", "not known for speed"),
}


@pytest.mark.parametrize("case", MAPPINGS)
def test_a_mapping_that_is_no_mapping(tmp_path: Path, case: str) -> None:
    text, what = MAPPINGS[case]
    said = refused(lambda: Log.read(with_mapping(tmp_path, text)), "lap.toml", what)
    assert SECRET not in said


def test_a_mapping_in_another_encoding(tmp_path: Path) -> None:
    log = with_mapping(tmp_path, "")
    (tmp_path / "lap.toml").write_bytes(b"[map]\naccel = 'gr\xf6\xdfe'\n")
    refused(lambda: Log.read(log), "line 2: is not UTF-8")
    (tmp_path / "lap.toml").write_bytes(b"\xef\xbb\xbf[unit]\nspeed = 'm/s'\n")
    assert Log.read(log).rows == 200


# text -------------------------------------------------------------------------------------------------------

TEXTS = {
    "mark_only": (b"\xef\xbb\xbf", "is empty"),
    "separators_only": ("\u2028\u2029\x85\n".encode(), "is empty; a header line"),
    "blank_first": (b"\n" + HEAD.encode() + b"0,1,2\n", "has one row"),
    "json": (b'{"time": [0, 1], ' + b'"column": 1, ' * 8000 + b'"a": 2}', "looks like JSON"),
    "json_list": (b'[{"time": 0}, ' * 1000, "looks like JSON"),
    "wide": (",".join(f"c{i}" for i in range(10_001)).encode(), "has 10,001 columns; needs 10,000"),
    "line": (HEAD.encode() + b"0," * 600_000, "a row has more than 1,000,000 characters"),
    "row": (HEAD.encode() + b'"\n",' * 400_000, "a row has more than 1,000,000 characters"),
    "cell": (HEAD.encode() + b"0,0," + b"9" * 10_000_000, "a row has more than 1,000,000 characters"),
    "quoted_cell": (HEAD.encode() + b'0,0,"' + b"9" * 500_000 + b'"', "line 2: cannot be split into cells"),
    "returns": (b"time,accel_cmd,speed\r0,1,2\r0.1,\0,2\r", "is no text"),
}


@pytest.mark.parametrize("case", TEXTS)
def test_text_that_is_no_table(tmp_path: Path, case: str) -> None:
    content, what = TEXTS[case]
    path = tmp_path / "lap.csv"
    path.write_bytes(content)
    refused(lambda: Log.read(path), what)


def test_many_long_names_of_columns_are_counted_not_recited(tmp_path: Path) -> None:
    path = tmp_path / "lap.csv"
    path.write_text(",".join(f"{90 * 'n'}{i}" for i in range(5000)) + "\n" + 4999 * "," + "\n")
    refused(lambda: Log.read(path), "and 4997 more")
    refused(lambda: read_leader(path), "and 4997 more")


def test_lines_end_at_line_ends_only(tmp_path: Path) -> None:
    """A form feed or U+2028 in a cell is part of it; a cell that holds one is refused at its own row and line."""
    rows = "0,1,2,x\x0c\u2028\x1e\x85y\n0.1,1,2,z\n" + "".join(f"{i / 10},1,2,\n" for i in range(2, 9))
    path = tmp_path / "lap.csv"
    path.write_text("time,accel_cmd,speed,remark\n" + rows, encoding="utf-8", newline="")
    assert Log.read(path).rows == 9
    path.write_text(f"time,accel_cmd,speed,remark\n{rows}0.9,1,2\x0c3,\n", encoding="utf-8", newline="")
    refused(lambda: Log.read(path), r"row 10 (line 11), column 'speed': '2\x0c3' is no number")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_a_row_is_named_by_its_first_line(tmp_path: Path, end: str) -> None:
    path = tmp_path / "lap.csv"
    head = f'time,accel_cmd,speed,"re{end}mark"{end}'
    path.write_text(f'{head}0,1,2,"a{end}{end}b"{end}0.1,1,2,{end}0.2,1,fast,"c{end}"{end}', newline="")
    refused(lambda: Log.read(path), "row 3 (line 7), column 'speed'")
    path.write_text(f'{head}0,1,2,"a{end}{end}b"{end}0.1,1,2{end}', newline="")
    refused(lambda: Log.read(path), "row 2 (line 6): has 3 cells where the header has 4")


NUMBERS = {
    "１２": "is no number", "1_000": "is no number", "0x10": "is no number", "1e400": "is infinite",
    "-1e400": "is infinite", "NaN": "is NaN", "-Infinity": "is infinite", "1\x0c": "is no number",
    "\u20031": "is no number", "1.5.2": "is no number", "1e": "is no number", "٣": "is no number",
    "1" * 5000: "is infinite",
}  # fmt: skip


@pytest.mark.parametrize("cell", NUMBERS, ids=ascii)
def test_a_number_is_decimal_and_ascii(tmp_path: Path, cell: str) -> None:
    path = tmp_path / "lap.csv"
    path.write_text(f"{HEAD}0,1,2\n0.1,1,{cell}\n", encoding="utf-8", newline="")
    refused(lambda: Log.read(path), "row 2 (line 3), column 'speed'", NUMBERS[cell])
    if cell == cell.strip():  # an option is trimmed before it is read
        refused(lambda: Log.read(write(path, GOOD), unit=[f"speed={cell}"]), "not known for speed")


def test_spaces_and_signs_around_a_number_are_read(tmp_path: Path) -> None:
    path = tmp_path / "lap.csv"
    path.write_text(HEAD + "".join(f" {i / 10}\t, +1 ,1.5e1\n" for i in range(5)))
    log = Log.read(path)
    assert log.accel_cmd is not None
    assert log.speed is not None
    assert log.accel_cmd.tolist() == [1.0] * 5
    assert log.speed.tolist() == [15.0] * 5


def test_too_many_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the columns that are read; the others do not count."""
    path = write(tmp_path / "lap.csv", GOOD | {f"x{i}": GOOD["accel"] for i in range(20)})
    monkeypatch.setattr("avtorch.io.tables.MOST_CELLS", 800)
    assert Log.read(path).rows == 200
    monkeypatch.setattr("avtorch.io.tables.MOST_CELLS", 799)
    refused(lambda: Log.read(path), "has more than 199 rows of 4 columns")


@pytest.mark.slow
def test_blank_lines_at_the_end_take_no_memory(tmp_path: Path) -> None:
    path = write(tmp_path / "lap.csv", GOOD)
    with path.open("a") as stream:
        stream.write("\n" * 100_000)
    tracemalloc.start()
    assert Log.read(path).rows == 200
    assert tracemalloc.get_traced_memory()[1] < 5e6  # as lists of cells they would take 100 bytes each
    tracemalloc.stop()


# shown ------------------------------------------------------------------------------------------------------


def test_names_from_a_file_steer_no_screen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from avtorch.cli.talk import Talk

    steer = "\x1b[2J\u202egpj\x9b31m\x07"
    path = write(tmp_path / f"lap{steer}.csv", GOOD | {f"a{steer}": GOOD["accel"]})
    log = Log.read(path)
    notes = check(log).notes
    assert log.name.isprintable()
    assert all(note.isprintable() for note in notes)
    assert any(r"columns ignored: a\x1b[2J\u" in note for note in notes)
    talk = Talk(json=False, quiet=False)
    talk.notes(steer, [steer])
    out = tmp_path / f"[/bold]{steer}"
    out.mkdir(parents=True)
    talk.done(out, {})
    shown = capsys.readouterr().out
    assert "\\x1b[2J" in shown
    assert shown.replace("\n", "").isprintable()


def test_answers_hold_no_raw_control_characters(tmp_path: Path) -> None:
    import json

    said = {"a\x1b": "\u202e\x7f\x9b\u2028\udc80\U000e0041 größe 速度\n"}
    write_json(tmp_path / "a.json", said)
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert text.replace("\n", "").isprintable()
    assert "größe 速度" in text
    assert json.loads(text) == said


# Parquet ----------------------------------------------------------------------------------------------------


def parquet(path: Path, columns: dict, **options: object) -> Path:
    pq.write_table(pa.table(columns), path, **options)
    return path


@pytest.mark.usefixtures("in_this_process")
def test_only_the_columns_that_are_needed_are_decoded(tmp_path: Path) -> None:
    """A column that nobody asked for may be large or of any kind: here a text of 20 MB in each of 1000 rows."""
    columns = {name: np.resize(values, 1000) for name, values in GOOD.items()} | {"time": np.arange(1000) / 50}
    notes = pa.DictionaryArray.from_arrays(pa.array(np.zeros(1000, np.int32)), pa.array([20_000_000 * "x"]))
    columns |= {"notes": notes, "frames": [[1]] * 1000}
    path = parquet(tmp_path / "lap.parquet", columns, compression="zstd", store_schema=False)
    assert path.stat().st_size < 200_000
    log = Log.read(path)
    assert log.rows == 1000
    assert log.ignored == ("notes", "frames")


def test_rows_are_counted_before_they_are_decoded(tmp_path: Path) -> None:
    same = pa.DictionaryArray.from_arrays(pa.array(np.zeros(7_000_000, np.int8)), pa.array([1.0]))
    path = parquet(tmp_path / "lap.parquet", {name: same for name in ("time", "accel_cmd", "speed")})
    assert path.stat().st_size < 200_000
    refused(lambda: Log.read(path), "has 7,000,000 rows of 3 columns that are read; needs 20,000,000 cells")


@pytest.mark.usefixtures("in_this_process")
def test_columns_that_hold_no_numbers(tmp_path: Path) -> None:
    n = len(GOOD["time"])
    for values, what in (
        ([[1.0]] * n, "holds list<"),
        ([{"a": 1.0}] * n, "holds struct<"),
        ([b"1"] * n, "holds binary"),
        ([200 * "9"] * n, "holds texts of 200 bytes"),
        (["fast"] * n, "row 1, column 'speed': 'fast' is no number"),
        (["１"] * n, "is no number"),
    ):
        path = parquet(tmp_path / "lap.parquet", GOOD | {"speed": pa.array(values)})
        refused(lambda path=path: Log.read(path), "column 'speed': ", what)


@pytest.mark.usefixtures("in_this_process")
def test_text_and_categories_of_numbers_are_read(tmp_path: Path) -> None:
    speed = pa.array([repr(float(x)) for x in GOOD["speed"]])
    for values in (speed, speed.dictionary_encode(), pa.array(GOOD["speed"]).dictionary_encode()):
        path = parquet(tmp_path / "lap.parquet", GOOD | {"speed": values})
        log = Log.read(path)
        assert log.speed is not None
        assert np.array_equal(log.speed, GOOD["speed"])


@pytest.mark.usefixtures("in_this_process")
def test_a_name_with_a_dot_beside_the_one_that_is_read(tmp_path: Path) -> None:
    path = parquet(tmp_path / "lap.parquet", {"speed.raw": -GOOD["speed"]} | GOOD | {"time.x": ["a"] * 200})
    log = Log.read(path)
    assert log.speed is not None
    assert np.array_equal(log.speed, GOOD["speed"])


# arrays -----------------------------------------------------------------------------------------------------


def test_arrays_that_are_none() -> None:
    n = len(GOOD["time"])
    masked = np.ma.masked_array(GOOD["speed"], mask=np.arange(n) == 7)
    assert "row 8, column 'speed': is NaN" in Log.from_arrays(**(GOOD | {"speed": masked})).remarks[0]
    for values, what in (
        ([[1.0], [1.0, 2.0]], "speed is no array of numbers"),
        ([10**400] * n, "row 1, column 'speed': is infinite"),
        ([b"1"] * n, "a bytes is no number"),
        ([1j] * n, "a complex is no number"),
        (["\x1b[31m"] * n, r"'\x1b[31m' is no number"),
    ):
        refused(lambda values=values: Log.from_arrays(name="lap\n", **(GOOD | {"speed": values})), r"lap\n: ", what)


def test_a_plain_table_reads_the_columns_it_is_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path / "lap.csv", GOOD)
    table = read_table(path, wanted=["speed"])
    assert table.rows == 200
    assert np.array_equal(table.numbers("speed"), GOOD["speed"])
    with pytest.raises(KeyError):
        table.numbers("accel")


def test_a_damaged_parquet_footer_does_not_end_the_process(tmp_path: Path) -> None:
    """One bit says that `speed` is required, not optional; pyarrow 26 then calls std::terminate for its statistics."""
    path = parquet(tmp_path / "lap.parquet", GOOD)
    raw = path.read_bytes()
    assert raw.count(b"\x25\x02\x18\x05speed") == 1
    path.write_bytes(raw.replace(b"\x25\x02\x18\x05speed", b"\x25\x00\x18\x05speed"))
    with pytest.raises(InputError, match=r"lap\.parquet: (is )?damaged"):
        Log.read(path)


@pytest.mark.parametrize("more", [True, False])
def test_row_groups_of_another_schema_are_refused(tmp_path: Path, more: bool) -> None:
    """pyarrow would look the last column up beyond the end of a list."""
    path = parquet(tmp_path / "lap.parquet", GOOD, store_schema=False)
    three = {name: GOOD[name] for name in ("time", "accel_cmd", "speed")}
    raw, other = path.read_bytes(), parquet(tmp_path / "other.parquet", three, store_schema=False).read_bytes()
    assert len(GOOD) == 4
    rows = b"\x16\x90\x03\x19"  # the field `num_rows` of 200, behind the schema and before the row groups
    schemas, groups = zip(
        *(x[-8 - int.from_bytes(x[-8:-4], "little") : -8].split(rows) for x in (raw, other)), strict=True
    )
    orders = bytes([0x19, ((4 if more else 3) << 4) | 12])  # of columns: a list at the end that may be missing
    kept, _, _ = groups[not more].rpartition(orders + b"\x1c")
    footer = schemas[more] + rows + kept + b"\x00"
    body = raw[: -8 - int.from_bytes(raw[-8:-4], "little")]
    path.write_bytes(body + footer + len(footer).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(InputError, match=r"lap\.parquet: (is )?damaged"):
        Log.read(path)
