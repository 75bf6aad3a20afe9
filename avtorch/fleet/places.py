"""Where logs lie: paths, and URLs of object stores; what belongs to a log, and the hash of its content."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from avtorch.errors import InputError, printable
from avtorch.io.mapping import mapping_beside, mapping_place, read_mapping
from avtorch.io.opening import kind_of, place

INSTALL = "pip install 'avtorch[fleet]'"
_CAN = (".blf", ".asc", ".log")
"""Suffixes of logs that a database beside them decodes."""


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
        raise InputError(f"{place(url)}: cannot be reached ({_reason(fault)})") from None


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
            raise InputError(f"{place(log)}: cannot be fetched ({_reason(fault)})") from None
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
    if found:
        try:
            named = {one.file for one in read_mapping(log).elsewhere.values()}
        except InputError:  # said when the log is read
            named = set()
        found += [file for name in sorted(named) if (file := log.parent / name).is_file()]
    if log.suffix.lower() in _CAN and log.is_file():
        found += sorted(p for p in log.parent.glob("*.dbc") if p.is_file())
    return found


def _why(fault: OSError | ValueError) -> str:
    return printable(str(getattr(fault, "strerror", None) or fault), 160)


def _reason(fault: Exception) -> str:
    text = " ".join(str(fault).split())
    return printable(f"{type(fault).__name__}: {text}" if text else type(fault).__name__, 160)
