"""What rosbags opens: a bag of ROS 1, a file or a folder of ROS 2, each checked before the library meets it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from avtorch.errors import InputError
from avtorch.io.formats import kinds
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import library
from avtorch.io.formats.opened import in_memory, opened

_METADATA = 2**24  # bytes of a folder's metadata.yaml
_FILES = 10_000  # of a folder


def open_bag(file: Path, kind: Kind, source: str) -> Any:
    """An opened reader of rosbags, with `connections`, `messages` and `close`."""
    if kind is kinds.ROS1:
        rosbag1 = library("rosbags.rosbag1", source, kind)
        opened(file, need="a ROS 1 bag").close()
        reader = rosbag1.Reader(file)
        reader.open()
        return reader
    storages = library("rosbags.rosbag2", source, kind).Reader.STORAGE_PLUGINS
    if kind is kinds.ROS2_FOLDER:
        in_memory(file / "metadata.yaml", most=_METADATA, need="the metadata of a ROS 2 bag")
        for count, part in enumerate(sorted(file.iterdir())):
            if count >= _FILES:
                raise InputError(f"{source}: holds more than {_FILES:,} files; a ROS 2 bag is needed")
            if part.name != "metadata.yaml" and not part.is_dir():
                opened(part, need="a regular file in a bag's folder").close()
                if part.suffix == ".db3":
                    _check_database(part, source)
        reader = storages["dir"](file)
    elif kind is kinds.ROS2_SQLITE:
        _check_database(file, source)
        reader = storages[".db3"](file)
    else:
        opened(file, need="an MCAP file").close()
        reader = storages[".mcap"](file)
    reader.open()
    return reader


def _check_database(file: Path, source: str) -> None:
    """A bag has plain tables. A view may compute without end where a table is read."""
    opened(file, need="a ROS 2 bag").close()
    if any(mark in str(file) for mark in "?#%"):  # rosbags passes the name on as an address
        raise InputError(f"{source}: has one of ? # % in its path; a path without is needed for SQLite")
    with closing(sqlite3.connect(f"file:{quote(str(file))}?mode=ro&immutable=1", uri=True)) as database:
        kinds_ = dict(database.execute("SELECT type, count(*) FROM sqlite_master GROUP BY type").fetchall())
        virtual = database.execute("SELECT count(*) FROM sqlite_master WHERE sql LIKE 'create virtual%'").fetchone()[0]
        names = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if kinds_.get("view") or kinds_.get("trigger") or virtual:
        raise InputError(f"{source}: is an SQLite file with views or triggers; a ROS 2 bag has plain tables")
    if not {"topics", "messages"} <= names:
        raise InputError(f"{source}: is an SQLite file without the tables topics and messages of a ROS 2 bag")
