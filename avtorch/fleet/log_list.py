"""The logs of a fleet: files, globs, folders and manifests, in paths or URLs, each with its car."""

from __future__ import annotations

import glob
import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Literal

from avtorch.errors import InputError, printable
from avtorch.fleet.manifest import is_manifest, read_manifest
from avtorch.fleet.marks import is_rows
from avtorch.fleet.places import file_system, is_url, url_of
from avtorch.io.answer_set import is_of_answer
from avtorch.io.formats import is_recording
from avtorch.io.opening import place

TABLES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".pq")
"""Suffixes of tables that a folder is searched for, also with `.gz`; recordings are recognised by themselves."""
RECORDINGS = (".mf4", ".mdf", ".bag", ".db3", ".mcap", ".blf", ".asc", ".mat", ".xlsx", ".xlsm", ".record")
"""Suffixes of recordings in an object store, where no file is opened to recognise it."""

CarFrom = Literal["manifest", "folder", "file"]


@dataclass(frozen=True)
class FleetLog:
    """A log of a fleet: its `place` (path or URL), `car`, `date` (ISO 8601, None: not known) and further `tags`.

    Example:
        >>> from avtorch.fleet import FleetLog
        >>> log = FleetLog("logs/car_7/monday.csv", "car_7", "2026-11-23", {"route": "A9"})
        >>> log.file_name.startswith("monday-"), log.car
        (True, 'car_7')
    """

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
    """The `logs` of a fleet, and where the names of the cars are from.

    Example:
        >>> from avtorch.fleet import FleetLog, LogList
        >>> LogList((FleetLog("a.csv", "a"),), "file").car_from
        'file'
    """

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

    Example:
        >>> from pathlib import Path
        >>> from avtorch.fleet import find_logs
        >>> for name in ("red/monday.csv", "red/tuesday.csv", "blue/monday.csv"):
        ...     Path("logs", name).parent.mkdir(parents=True, exist_ok=True)
        ...     _ = Path("logs", name).write_text("time,accel_cmd,speed")
        >>> found = find_logs("logs")
        >>> [log.car for log in found.logs], found.car_from
        (['blue', 'red', 'red'], 'folder')
    """
    given = [os.fspath(s) for s in ([sources] if isinstance(sources, (str, os.PathLike)) else sources)]
    if not given:
        raise InputError("logs: found none, needs files, a glob, a folder or a manifest")
    manifests = [source for source in given if is_manifest(source)]
    if manifests:
        if len(given) > 1:
            raise InputError(f"{place(manifests[0])}: is a manifest; needs to be the only source")
        rows = read_manifest(manifests[0])
        return LogList(tuple(FleetLog(r.log, r.car, r.date, r.tags) for r in rows), "manifest")
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
