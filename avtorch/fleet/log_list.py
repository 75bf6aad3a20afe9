"""The logs of a fleet: files, globs, folders and manifests, in paths or URLs, each with its car and its content's hash.

A manifest is a CSV file that names the logs, their cars and dates, and whatever else is known of them.
"""

from __future__ import annotations

import csv
import glob
import hashlib
import io
import os
import re
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from itertools import takewhile
from pathlib import Path, PurePath
from typing import Any, Literal

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.answers import is_of_answer
from avtorch.io.formats import is_recording
from avtorch.io.mapping import mapping_beside, mapping_place
from avtorch.io.opening import opened, place, read_regular

_CAN = (".blf", ".asc", ".log")
"""Suffixes of logs that a database beside them decodes."""

KEY = b"avtorch.key"


def key_of(path: str | os.PathLike[str]) -> bytes | None:
    """The key of a Parquet file of a fleet's rows; None where it is missing, damaged, or of something else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return (pq.read_schema(path).metadata or {}).get(KEY)
    except (OSError, ValueError, pa.ArrowException):
        return None


def is_url(text: str) -> bool:
    """Whether `text` is for fsspec: `s3://bucket/drive.csv`, and no path."""
    return "://" in text


@contextmanager
def _store(url: str) -> Iterator[tuple[Any, str]]:
    """The file system of a URL, and the path in it; what it raises within becomes an `InputError`."""
    try:
        from fsspec.core import url_to_fs

        yield url_to_fs(url)
    except FileNotFoundError:
        raise InputError(f"{place(url)}: no such file") from None
    except Exception as fault:  # each store has errors of its own, a missing package among them
        raise InputError(f"{place(url)}: cannot be reached ({one_line(fault)})") from None


@contextmanager
def fetched(log: str) -> Iterator[Path]:
    """The log as a local file: itself, or for a URL a copy with the mapping beside it, removed afterwards.

    Of a store only these two files are fetched: other files that a mapping names, databases and folders are not. Raises
    `InputError` where it cannot be fetched.
    """
    if not is_url(log):
        yield Path(log)
        return
    with tempfile.TemporaryDirectory(prefix="avtorch-") as folder:
        with _store(log) as (files, path):
            local = Path(folder) / (Path(path).name or "log")
            files.get_file(path, str(local))
            mapping = mapping_place(Path(path))
            if mapping.name != local.name and files.exists(str(mapping)):
                files.get_file(str(mapping), str(local.with_name(mapping.name)))
        yield local


def content_hash(log: Path) -> tuple[str, int]:
    """SHA-256 over a log and everything that says how to read it, and the bytes of the log itself.

    That is the mapping beside it, the files that it names, and the databases beside a CAN log. Raises `InputError` for
    what is no regular file, or folder of such files.
    """
    state = hashlib.sha256()
    own = sorted(p for p in log.rglob("*") if p.is_file()) if os.path.isdir(log) else [log]
    size = sum(_hashed(file, state) for file in own)
    for file in _beside(log):
        _hashed(file, state)
    return state.hexdigest(), size


def _hashed(file: Path, state: Any) -> int:
    """Feed a file's name and content to `state`; returns its bytes."""
    with opened(file, need="a log") as stream:
        size = os.fstat(stream.fileno()).st_size
        state.update(f"{file.name}:{size}:".encode("utf-8", "backslashreplace"))
        state.update(hashlib.file_digest(stream, "sha256").digest())  # pyright: ignore[reportArgumentType]
    return size


def _beside(log: Path) -> list[Path]:
    mapping = mapping_beside(log)
    found = [] if mapping is None or not mapping.is_file() else [mapping]
    if log.suffix.lower() in _CAN and log.is_file():
        found += sorted(p for p in log.parent.glob("*.dbc") if p.is_file())
    return found


def one_line(fault: BaseException) -> str:
    """The kind of an error and its message."""
    text = " ".join(str(fault).split())
    return printable(f"{type(fault).__name__}: {text}" if text else type(fault).__name__, 400)


MOST = 256 * 2**20
"""Most bytes of a manifest."""
NEED = "a header such as log,car,date"


def is_manifest(source: str) -> bool:
    """Whether a file is a manifest and no log: a `.csv` whose header has `log`, and `car` or no `time` as logs have."""
    if not source.lower().endswith(".csv"):
        return False
    try:
        with fetched(source) as local, opened(local, need="a manifest") as stream:
            head = stream.readline(4096).decode("utf-8-sig", "replace")
        names = [name.strip().lower() for name in next(_cells(head), [])]
    except (InputError, OSError, csv.Error):
        return False
    return "log" in names and ("car" in names or "time" not in names)


def _cells(text: str) -> Any:
    """A reader of CSV, its columns separated by a comma, or by the semicolon of spreadsheets where the comma is
    decimal."""
    head = text.partition("\n")[0]
    delimiter = ";" if ";" in head and "," not in head else ","
    return csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)


def read_manifest(source: str) -> list[FleetLog]:
    """The rows of a manifest; relative paths of logs are relative to its folder.

    Raises `InputError` naming file, line and column: for a missing or doubled column, a line of another length, an
    empty log or car, a log given twice, and a date that is not ISO 8601.
    """
    shown = place(source)
    with fetched(source) as local:
        raw = read_regular(local, most=MOST, need="a manifest")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        line = raw.count(b"\n", 0, fault.start) + 1
        raise InputError(f"{shown}: line {line}: is not UTF-8; a manifest is a CSV file in UTF-8") from None
    reader = _cells(text)
    rows: dict[str, FleetLog] = {}
    try:
        names = [name.strip() for name in next(reader, [])]
        for column in ("log", "car"):
            if column not in names:
                raise InputError(f"{shown}: line 1: has no column {column}; needs {NEED}, found {listed(names)}")
        if len(set(names)) < len(names) or not all(names):
            raise InputError(f"{shown}: line 1: found {listed(names)}, needs a name of its own for each column")
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            where = f"{shown}: row {len(rows) + 1} (line {reader.line_num})"
            row = _row(source, where, names, cells)
            if row.identity in rows:
                number = list(rows).index(row.identity) + 1
                raise InputError(f"{where}, column log: {quoted(row.place)} is already in row {number}")
            rows[row.identity] = row
    except csv.Error as fault:
        raise InputError(f"{shown}: line {reader.line_num}: is no CSV ({fault})") from None
    if not rows:
        raise InputError(f"{shown}: has no row below its header; needs a log in each")
    return list(rows.values())


def _row(source: str, where: str, names: list[str], cells: list[str]) -> FleetLog:
    if len(cells) != len(names):
        raise InputError(f"{where}: has {len(cells)} cells, needs {len(names)}, as the header has")
    entry = {name: cell.strip() for name, cell in zip(names, cells, strict=True)}
    for column in ("log", "car"):
        if not entry[column]:
            raise InputError(f"{where}, column {column}: is empty; needs {'a path' if column == 'log' else 'a name'}")
    log, car, date = entry.pop("log"), entry.pop("car"), entry.pop("date", "")
    if date:
        try:
            datetime.fromisoformat(date)
        except ValueError:
            raise InputError(
                f"{where}, column date: found {quoted(date)}, needs a date such as 2026-11-23 or 2026-11-23T08:30"
            ) from None
    if is_url(source) and not is_url(log) and not os.path.isabs(log):
        log = f"{source.rpartition('/')[0]}/{log}"
    elif not is_url(log):
        log = os.path.normpath(os.path.join(os.path.dirname(source), log))
    return FleetLog(log, car, date or None, {key: value for key, value in entry.items() if value})


TABLES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".pq")
"""Suffixes of tables that a folder is searched for, also with `.gz`; recordings are recognised by themselves."""
RECORDINGS = (".mf4", ".mdf", ".bag", ".db3", ".mcap", ".blf", ".asc", ".mat", ".xlsx", ".xlsm", ".record")
"""Suffixes of recordings in an object store, where no file is opened to recognise it."""

CarFrom = Literal["manifest", "folder", "file"]


@dataclass(frozen=True)
class FleetLog:
    """A log of a fleet: its `place` (path or URL), `car`, `date` (ISO 8601, None: not known) and further `tags`."""

    place: str
    car: str
    date: str | None = None
    tags: Mapping[str, str] = field(default_factory=dict)

    @property
    def shown(self) -> str:
        """The place as rows, answers and messages show it, bytes that are no text escaped."""
        return printable(self.place)

    @property
    def identity(self) -> str:
        """Where it lies, whatever folder the command is given in."""
        return self.place if is_url(self.place) else os.path.abspath(self.place)

    @property
    def name(self) -> str:
        """Of its rows: the log's own name, and a part that no other log has."""
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", _stem(self.place))[:40].strip(".") or "log"
        return f"{stem}-{hashlib.sha256(self.identity.encode('utf-8', 'surrogatepass')).hexdigest()[:12]}"


@dataclass(frozen=True)
class LogList:
    """The `logs` of a fleet, and where the names of the cars are from."""

    logs: tuple[FleetLog, ...]
    car_from: CarFrom


def find_logs(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    leave_out: str | os.PathLike[str] | None = None,
) -> LogList:
    """The logs that `sources` name: files, globs (`**` for any depth), folders with all below, URLs, or one manifest.

    A manifest is a CSV file with the columns `log`, `car` and, if wanted, `date` and others, which become tags. Without
    one, a log's car is its folder where the logs lie in several folders, named from below the folder that holds them
    all, else its own name. In a folder, tables and recordings are taken by their suffix or first bytes, and nothing in
    `leave_out`, the fleet's own folder.

    Raises `InputError` where a source has no log, for a manifest beside other sources, and for errors in a manifest by
    line and column.
    """
    given = [os.fspath(s) for s in ([sources] if isinstance(sources, (str, os.PathLike)) else sources)]
    if not given:
        raise InputError("logs: found none, needs files, a glob, a folder or a manifest")
    manifests = [source for source in given if is_manifest(source)]
    if manifests:
        if len(given) > 1:
            raise InputError(f"{place(manifests[0])}: is a manifest; needs to be the only source")
        return LogList(tuple(read_manifest(manifests[0])), "manifest")
    hidden = None if leave_out is None else Path(os.path.abspath(leave_out))
    found: dict[str, str] = {}
    for source in given:
        for path in _logs_of(source, hidden):  # one log named twice, as logs/a.csv and ./logs/a.csv
            found.setdefault(FleetLog(path, "").identity, path)
    return _named(list(found.values()))


def _named(paths: list[str]) -> LogList:
    folders = {path: PurePath(_parent(path)).parts for path in paths}
    several = len(set(folders.values())) > 1
    if several:
        shared = len(list(takewhile(lambda parts: len(set(parts)) == 1, zip(*folders.values(), strict=False))))
        cars = {path: "/".join(parts[shared:] or parts[-1:]) for path, parts in folders.items()}
    else:
        count = Counter(map(_stem, paths))
        cars = {path: PurePath(path).name if count[_stem(path)] > 1 else _stem(path) for path in paths}
    logs = tuple(FleetLog(path, printable(cars[path]) or "car") for path in paths)
    return LogList(logs, "folder" if several else "file")


def _logs_of(source: str, leave_out: Path | None) -> list[str]:
    if is_url(source):
        found = _in_store(source)
    elif os.path.lexists(source):
        found = _below(Path(source), leave_out)
    elif glob.has_magic(source):
        matched = [Path(path) for path in sorted(glob.glob(source, recursive=True))]
        own = [p for p in matched if leave_out is None or not Path(os.path.abspath(p)).is_relative_to(leave_out)]
        found = [log for path in own if not _is_answer(path) for log in _below(path, leave_out)]
    else:
        raise InputError(f"{place(source)}: no such file")
    if not found:
        raise InputError(f"{place(source)}: no log there; needs tables ({', '.join(TABLES)}) or recordings")
    return found


def _below(path: Path, leave_out: Path | None) -> list[str]:
    """The logs in a folder; of a file and of a recording that is a folder, itself."""
    if not path.is_dir() or is_recording(path):
        return [str(path)]
    found: list[str] = []
    for root, folders, names in os.walk(path, onerror=_closed):
        here = Path(root)
        known = sorted(f for f in folders if not f.startswith(".") and Path(os.path.abspath(here / f)) != leave_out)
        bags = [f for f in known if is_recording(here / f)]
        folders[:] = [f for f in known if f not in bags]
        found += [str(here / name) for name in (*bags, *names) if name in bags or _is_log(here / name)]
    return sorted(found)


def _closed(fault: OSError) -> None:
    raise InputError(f"{place(fault.filename or '.')}: cannot be searched for logs ({fault.strerror or fault})")


def _is_log(path: Path) -> bool:
    """Whether a file of a folder is one to read: a table or a recording, no manifest, and nothing that avtorch has
    written there."""
    if path.name.startswith(".") or not path.is_file() or _is_answer(path) or is_manifest(str(path)):
        return False
    return _is_table(path.name) or is_recording(path)


def _is_answer(path: Path) -> bool:
    if path.name == "manoeuvre.csv" and is_of_answer(path, "diagnosis.json"):
        return True
    return path.suffix == ".parquet" and key_of(path) is not None


def _is_table(name: str) -> bool:
    return name.lower().removesuffix(".gz").endswith(TABLES)


def _in_store(url: str) -> list[str]:
    with _store(url) as (files, path):
        if glob.has_magic(path):
            found = [p for p in files.glob(path) if not files.isdir(p)]
        elif files.isdir(path):
            found = [p for p in files.find(path) if _is_table(p) or p.lower().endswith(RECORDINGS)]
        else:
            found = [path] if files.exists(path) else []
        return sorted(str(files.unstrip_protocol(p)) for p in found)


def _parent(path: str) -> str:
    return path.rpartition("/")[0] if is_url(path) else os.path.dirname(os.path.abspath(path))


def _stem(path: str) -> str:
    name = PurePath(path.rstrip("/")).name
    return PurePath(name.removesuffix(".gz")).stem
