"""The logs of a fleet: files, globs, folders and manifests, in paths or URLs, each with its car and its content's hash.

A manifest is a CSV file that names the logs, their cars and dates, and whatever else is known of them.
"""

from __future__ import annotations

import csv
import glob
import hashlib
import importlib.util
import io
import os
import re
import stat
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path, PurePath
from typing import Any, Literal

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.answer_set import is_of_answer
from avtorch.io.formats import is_recording
from avtorch.io.mapping import mapping_beside, mapping_place
from avtorch.io.opening import TooLarge, kind_of, place, read_regular

INSTALL = "pip install 'avtorch[fleet]'"
_CAN = (".blf", ".asc", ".log")
"""Suffixes of logs that a database beside them decodes."""


KEY, LABEL, STATUS = b"avtorch.key", b"avtorch.label", b"avtorch.status"


def marks_of(path: str | os.PathLike[str]) -> dict[bytes, bytes]:
    """The marks of a Parquet file; none where it is missing, damaged, or not of a fleet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_schema(path).metadata or {}
    except (OSError, ValueError, pa.ArrowException):
        return {}


def is_rows(path: str | os.PathLike[str]) -> bool:
    """Whether a Parquet file holds rows of a fleet, and no log."""
    return KEY in marks_of(path)


def is_url(text: str) -> bool:
    """Whether `text` is for fsspec: `s3://bucket/drive.csv`, and no path."""
    return "://" in text


def file_system(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it. Raises `InputError` where it cannot be reached."""
    if importlib.util.find_spec("fsspec") is None:
        raise InputError(f"{place(url)}: is a URL; reading it needs fsspec: {INSTALL}")
    from fsspec.core import url_to_fs

    try:
        return url_to_fs(url)
    except Exception as fault:  # each store has errors of its own, a missing package among them
        raise InputError(f"{place(url)}: cannot be reached ({one_line(fault)})") from None


def url_of(files: Any, path: str) -> str:
    """The URL of a path in a file system, as `file_system` takes it."""
    return str(files.unstrip_protocol(path))


@contextmanager
def fetched(log: str) -> Iterator[Path]:
    """The log as a local file: itself, or for a URL a copy with the mapping beside it, removed afterwards.

    Of a store only these two files are fetched: other files that a mapping names, databases and folders are not. Raises
    `InputError` where it cannot be fetched.
    """
    if not is_url(log):
        yield Path(log)
        return
    files, path = file_system(log)
    with tempfile.TemporaryDirectory(prefix="avtorch-") as folder:
        local = Path(folder) / (Path(path).name or "log")
        try:
            files.get_file(path, str(local))
            mapping = mapping_place(Path(path))
            if mapping.name != local.name and files.exists(str(mapping)):
                files.get_file(str(mapping), str(local.with_name(mapping.name)))
        except FileNotFoundError:
            raise InputError(f"{place(log)}: no such file") from None
        except Exception as fault:
            raise InputError(f"{place(log)}: cannot be fetched ({one_line(fault)})") from None
        yield local


def content_hash(log: Path) -> tuple[str, int]:
    """SHA-256 over a log and everything that says how to read it, and the bytes of the log itself.

    That is the mapping beside it, the files that it names, and the databases beside a CAN log. Raises `InputError` for
    what is no regular file, or folder of such files.
    """
    try:
        own = sorted(p for p in log.rglob("*") if p.is_file()) if log.is_dir() else [log]
        files = (*own, *_beside(log))
    except InputError:
        raise
    except (OSError, ValueError) as fault:  # a name too long or with a null, a folder that is closed
        raise InputError(f"{place(log)}: cannot be read ({_why(fault)})") from None
    state, size = hashlib.sha256(), 0
    for number, file in enumerate(files):
        try:
            info = os.stat(file)
            if not stat.S_ISREG(info.st_mode):  # opening a pipe would wait for its writer
                raise InputError(f"{place(file)}: is {kind_of(info.st_mode)}; a log is needed")
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256")
        except FileNotFoundError:
            raise InputError(f"{place(file)}: no such file") from None
        except InputError:
            raise
        except (OSError, ValueError) as fault:
            raise InputError(f"{place(file)}: cannot be read ({_why(fault)})") from None
        state.update(f"{file.name}:{info.st_size}:".encode("utf-8", "backslashreplace"))
        state.update(digest.digest())
        size += info.st_size if number < len(own) else 0
    return state.hexdigest(), size


def _beside(log: Path) -> list[Path]:
    mapping = mapping_beside(log)
    found = [] if mapping is None or not mapping.is_file() else [mapping]
    if log.suffix.lower() in _CAN and log.is_file():
        found += sorted(p for p in log.parent.glob("*.dbc") if p.is_file())
    return found


def _why(fault: OSError | ValueError) -> str:
    return printable(str(getattr(fault, "strerror", None) or fault), 160)


def one_line(fault: BaseException) -> str:
    """The kind of an error and its message."""
    text = " ".join(str(fault).split())
    return printable(f"{type(fault).__name__}: {text}" if text else type(fault).__name__, 160)


MOST = 256 * 2**20
"""Most bytes of a manifest."""
_HEAD = 4096
NEED = "a header such as log,car,date"


def is_manifest(source: str) -> bool:
    """Whether a file is a manifest and no log: a `.csv` whose header has `log`, and `car` or no `time` as logs have."""
    if not source.lower().endswith(".csv"):
        return False
    try:
        if is_url(source):
            with fetched(source) as local:
                head = _head(local)
        else:
            head = _head(Path(source))
    except (InputError, OSError, ValueError):
        return False
    try:
        names = [name.strip().lower() for name in next(csv.reader([head], delimiter=_delimiter(head)), [])]
    except csv.Error:
        return False
    return "log" in names and ("car" in names or "time" not in names)


def _delimiter(head: str) -> str:
    """What separates the columns of a header: a comma, or the semicolon of spreadsheets where the comma is decimal."""
    return ";" if ";" in head and "," not in head else ","


def _head(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        return stream.read(_HEAD).decode("utf-8-sig", "replace").partition("\n")[0]


def read_manifest(source: str) -> list[FleetLog]:
    """The rows of a manifest; relative paths of logs are relative to its folder.

    Raises `InputError` naming file, line and column: for a missing or doubled column, a line of another length, an
    empty log or car, a log given twice, and a date that is not ISO 8601.
    """
    shown = place(source)
    with fetched(source) as local:
        try:
            raw = read_regular(local, most=MOST, need="a manifest")
        except TooLarge as fault:
            raise InputError(f"{fault}; split the fleet") from None
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        line = raw.count(b"\n", 0, fault.start) + 1
        raise InputError(f"{shown}: line {line}: is not UTF-8; a manifest is a CSV file in UTF-8") from None
    reader = csv.reader(io.StringIO(text), delimiter=_delimiter(text.partition("\n")[0]), strict=True)
    rows: list[FleetLog] = []
    first: dict[str, int] = {}
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
            if row.identity in first:
                raise InputError(f"{where}, column log: {quoted(row.place)} is already in row {first[row.identity]}")
            rows.append(row)
            first[row.identity] = len(rows)
    except csv.Error as fault:
        raise InputError(f"{shown}: line {reader.line_num}: is no CSV ({fault})") from None
    if not rows:
        raise InputError(f"{shown}: has no row below its header; needs a log in each")
    return rows


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
    if not is_url(log) and not os.path.isabs(log):
        parent = source.rpartition("/")[0] if is_url(source) else os.path.dirname(source)
        log = f"{parent}/{log}" if is_url(source) else os.path.normpath(os.path.join(parent, log))
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
    def file_name(self) -> str:
        """Of its rows: the log's own name, and a part that no other log has."""
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", _stem(self.place))[:40].strip(".") or "log"
        return f"{stem}-{hashlib.sha256(self.identity.encode('utf-8', 'surrogatepass')).hexdigest()[:12]}.parquet"


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
    one, a log's car is its folder's name where the logs lie in several folders, else its own name. In a folder, tables
    and recordings are taken by their suffix or first bytes, and nothing in `leave_out`, the fleet's own folder.

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
    found = dict.fromkeys(path for source in given for path in _logs_of(source, hidden))
    seen: dict[str, str] = {}
    for path in found:  # one log named twice, as logs/a.csv and ./logs/a.csv
        seen.setdefault(FleetLog(path, "").identity, path)
    return _named(list(seen.values()))


def _named(paths: Sequence[str]) -> LogList:
    folders = {path: _parent(path) for path in paths}
    several = len(set(folders.values())) > 1
    cars = {path: PurePath(folders[path]).name if several else _stem(path) for path in paths}
    if several:
        names = _apart(set(folders.values()))
        cars = {path: names[folder] for path, folder in folders.items()}
    else:
        names = Counter(cars.values())
        cars = {p: PurePath(p).name if names[c] > 1 else c for p, c in cars.items()}
    logs = tuple(FleetLog(path, printable(cars[path]) or "car") for path in paths)
    return LogList(logs, "folder" if several else "file")


def _apart(folders: Iterable[str]) -> dict[str, str]:
    """A name for each folder: its last part, and before it as many as tell it from others that end alike.

    So fleet_a/car_1 and fleet_b/car_1 are two cars, as red/run_1/data and blue/run_1/data are.
    """
    alike: dict[str, list[str]] = {}
    for folder in folders:
        alike.setdefault(PurePath(folder).name, []).append(folder)
    names = {}
    for together in alike.values():
        parts = {folder: PurePath(folder).parts for folder in together}
        count = 1
        while len({parts[folder][-count:] for folder in together}) < len(together):
            count += 1
        names |= {folder: "/".join(parts[folder][-count:]) for folder in together}
    return names


def _logs_of(source: str, leave_out: Path | None) -> list[str]:
    if is_url(source):
        return _in_store(source)
    path = Path(source)
    if path.is_dir() and not is_recording(path):
        found = _below(path, leave_out)
        if not found:
            raise InputError(
                f"{place(source)}: no log in this folder; needs tables ({', '.join(TABLES)}) or recordings"
            )
        return found
    if os.path.lexists(source):
        return [source]
    if glob.has_magic(source):
        matched = sorted(glob.glob(source, recursive=True))
        found = [log for path in matched for log in _matched(Path(path), leave_out)]
        if found:
            return found
        raise InputError(f"{place(source)}: matches no log; needs a glob such as 'logs/**/*.csv'")
    raise InputError(f"{place(source)}: no such file")


def _matched(path: Path, leave_out: Path | None) -> list[str]:
    """What a glob names with one of its matches; nothing of the fleet's own folder, nor other answers."""
    if leave_out is not None and Path(os.path.abspath(path)).is_relative_to(leave_out):
        return []
    if path.is_dir() and not is_recording(path):
        return _below(path, leave_out)
    return [] if _is_answer(path) else [str(path)]


def _below(folder: Path, leave_out: Path | None) -> list[str]:
    found: list[str] = []
    for root, folders, names in os.walk(folder, onerror=_closed):
        here = Path(root)
        folders[:] = sorted(
            f for f in folders if not f.startswith(".") and Path(os.path.abspath(here / f)) != leave_out
        )
        bags = [f for f in folders if is_recording(here / f)]
        folders[:] = [f for f in folders if f not in bags]
        found += [str(here / name) for name in (*bags, *sorted(names)) if name in bags or _is_log(here / name)]
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
    return path.suffix == ".parquet" and is_rows(path)


def _is_table(name: str) -> bool:
    return name.lower().removesuffix(".gz").endswith(TABLES)


def _in_store(url: str) -> list[str]:
    files, path = file_system(url)
    try:
        if glob.has_magic(path):
            found = [p for p in files.glob(path) if not files.isdir(p)]
        elif files.isdir(path):
            found = [p for p in files.find(path) if _is_table(p) or p.lower().endswith(RECORDINGS)]
        else:
            found = [path] if files.exists(path) else []
    except Exception as fault:
        raise InputError(f"{place(url)}: cannot be listed ({type(fault).__name__}: {fault})") from None
    if not found:
        raise InputError(f"{place(url)}: no log there")
    return sorted(url_of(files, p) for p in found)


def _parent(path: str) -> str:
    return path.rpartition("/")[0] if is_url(path) else os.path.dirname(os.path.abspath(path))


def _stem(path: str) -> str:
    name = PurePath(path.rstrip("/")).name
    return PurePath(name.removesuffix(".gz")).stem
