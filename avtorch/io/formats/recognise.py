"""Which format a file has: by how it begins first, and by its name where that says nothing."""

from __future__ import annotations

import os
import re
from pathlib import Path

from avtorch.errors import InputError
from avtorch.io.formats import kinds
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.opened import beginning
from avtorch.io.opening import place

NEED = "an MDF, ROS bag, MCAP, Apollo record, BLF, ASC, candump, MAT, Excel or OpenDocument file"
_AHEAD = 4096  # bytes that tell a format

_MAGIC = (
    (b"MDF ", kinds.MDF),
    (b"UnFinMF ", kinds.MDF),
    (b"#ROSBAG V", kinds.ROS1),
    (b"SQLite format 3\0", kinds.ROS2_SQLITE),
    (b"\x89MCAP0\r\n", kinds.ROS2_MCAP),
    (b"LOGG", kinds.BLF),
    (b"MATLAB 7.3 MAT-file", kinds.MAT73),
    (b"MATLAB 5.0 MAT-file", kinds.MAT5),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", kinds.XLS),
)
_HDF5 = b"\x89HDF\r\n\x1a\n"
_USERBLOCK = 512  # MATLAB's header before it
_BASE = re.compile(rb"^\s*base\s+(hex|dec)\b", re.I | re.M)
_ASC_DATE = re.compile(rb"^(\s*//[^\n]*\n)*\s*date\s", re.I)
_CANDUMP = re.compile(rb"^\s*\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{1,8}#")


def kind_at(path: str | os.PathLike[str]) -> Kind | None:
    """The format of the file or folder at `path`; None for one that is no recording, such as a CSV.

    Raises InputError where there is no regular file, and where the name promises a format that the content is not.
    """
    file = Path(path)
    if _is_folder(file):
        return kinds.ROS2_FOLDER if (file / "metadata.yaml").is_file() else None
    head = beginning(path, _AHEAD, need=NEED)
    found = _by_content(head, file.suffix.lower())
    if found is not None:
        return found
    named = _by_suffix(file)
    if named is not None:
        says = "is empty" if not head else f"named as {named.words} but its content is not"
        raise InputError(f"{place(path)}: {says}; a file that begins with {named.begins} is needed")
    return None


def is_kind(path: str | os.PathLike[str]) -> bool:
    """Whether the file at `path` is a recording by its content or by its name; False where there is none."""
    file = Path(path)
    try:
        return kind_at(path) is not None
    except InputError:
        try:
            return _by_suffix(file) is not None and file.is_file()
        except OSError:  # a name that no file can have
            return False


def _is_folder(file: Path) -> bool:
    try:
        return file.is_dir()
    except (OSError, ValueError):  # a name that no file can have; opening it says so
        return False


def _by_suffix(file: Path) -> Kind | None:
    suffix = file.suffix.lower()
    return next((kind for kind in kinds.KINDS if suffix in kind.suffixes), None)


def _by_content(head: bytes, suffix: str) -> Kind | None:
    if head[_USERBLOCK:].startswith(_HDF5) and head.startswith(b"MATLAB"):  # whatever version the text before it names
        return kinds.MAT73
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    if head.startswith(_HDF5) and suffix == ".mat":  # written by another program, without MATLAB's 512 bytes before it
        return kinds.MAT73
    if head.startswith(b"PK\x03\x04"):
        return _office(head, suffix)
    if _is_apollo(head):
        return kinds.APOLLO
    if _CANDUMP.match(head):
        return kinds.CANDUMP
    if _ASC_DATE.match(head) and _BASE.search(head):
        return kinds.ASC
    return None


def _is_apollo(head: bytes) -> bool:
    """Apollo numbers its records (``.record.00012``), and they begin with no word: a section of type 0 and some size
    up to 2048, in which the header's first field is the version."""
    return head[:4] == bytes(4) and 2 <= int.from_bytes(head[8:16], "little") <= 2048 and head[16:17] == b"\x08"


def _office(head: bytes, suffix: str) -> Kind | None:
    """A ZIP file may be anything: its name tells, or its first entry where the name does not."""
    if b"application/vnd.oasis.opendocument.spreadsheet" in head[:200] or suffix in kinds.ODS.suffixes:
        return kinds.ODS
    if suffix in kinds.EXCEL.suffixes or head[30:200].startswith((b"[Content_Types].xml", b"xl/", b"docProps/app.xml")):
        return kinds.EXCEL
    return None
