"""The formats of recordings: how messages call them, which file reads them, by which library, and how a file's format
is recognised: by how it begins first, and by its name where that says nothing.

A library is loaded when a file asks for it; its errors become one line.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from avtorch.errors import InputError, printable
from avtorch.io.opening import beginning, place


@dataclass(frozen=True)
class Kind:
    """One format: what messages call it, and the module of this package that opens it; what brings its library, None
    where avtorch's own requirements read it; suffixes in lower case, and how a file of it begins, in words.

    A file of such a suffix that does not begin so is refused, not guessed at.
    """

    words: str
    reader: str
    extra: str | None
    suffixes: tuple[str, ...]
    begins: str


MDF = Kind("MDF", "mdf", "mdf", (".mf4", ".mdf", ".mf3"), "'MDF' or 'UnFinMF'")
ROS1 = Kind("ROS 1 bag", "bags", "bags", (".bag",), "'#ROSBAG V2.0'")
ROS2_SQLITE = Kind("ROS 2 bag (SQLite)", "bags", "bags", (".db3",), "'SQLite format 3'")
ROS2_MCAP = Kind("ROS 2 bag (MCAP)", "bags", "bags", (".mcap",), "the byte 0x89 and 'MCAP0'")
ROS2_FOLDER = Kind("ROS 2 bag (folder)", "bags", "bags", (), "a folder with metadata.yaml")
BLF = Kind("CAN log (BLF)", "can", "can", (".blf",), "'LOGG'")
ASC = Kind("CAN log (ASC)", "can", "can", (".asc",), "a line 'date ...' and a line 'base hex' or 'base dec'")
CANDUMP = Kind("CAN log (candump)", "can", "can", (), "a line such as '(1700000000.000000) can0 123#0011'")
MAT5 = Kind("MAT", "matlab", None, (".mat",), "'MATLAB 5.0 MAT-file' or 'MATLAB 7.3 MAT-file'")
MAT73 = Kind("MAT 7.3", "matlab", "mat", (), "'MATLAB 7.3 MAT-file'")
EXCEL = Kind("Excel", "excel", "excel", (".xlsx", ".xlsm", ".xlsb"), "'PK', as a ZIP file")
XLS = Kind("Excel 97", "excel", "excel", (".xls",), "the bytes D0 CF 11 E0")
ODS = Kind("OpenDocument", "excel", "excel", (".ods",), "'PK', as a ZIP file")
APOLLO = Kind("Apollo record", "apollo", "apollo", (".record",), "a section of type 0 with its header")

PARQUET = Kind("Parquet", "parquet", None, (".parquet", ".pq"), "'PAR1'")

KINDS = (MDF, ROS1, ROS2_SQLITE, ROS2_MCAP, ROS2_FOLDER, BLF, ASC, CANDUMP, MAT5, MAT73, EXCEL, XLS, ODS, APOLLO)


def named(words: str) -> Kind:
    """The format of these words, each of which has its own."""
    return next(kind for kind in (*KINDS, PARQUET) if kind.words == words)


NEED = "an MDF, ROS bag, MCAP, Apollo record, BLF, ASC, candump, MAT, Excel or OpenDocument file"
_AHEAD = 4096  # bytes that tell a format

_MAGIC = (
    (b"MDF ", MDF),
    (b"UnFinMF ", MDF),
    (b"#ROSBAG V", ROS1),
    (b"SQLite format 3\0", ROS2_SQLITE),
    (b"\x89MCAP0\r\n", ROS2_MCAP),
    (b"LOGG", BLF),
    (b"MATLAB 7.3 MAT-file", MAT73),
    (b"MATLAB 5.0 MAT-file", MAT5),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", XLS),
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
    if os.path.isdir(path):
        return ROS2_FOLDER if (file / "metadata.yaml").is_file() else None
    head = beginning(path, _AHEAD, need=NEED)
    found = _by_content(head, file.suffix.lower())
    if found is not None:
        return found
    named = _by_suffix(file)
    if named is not None:
        says = "is empty" if not head else f"named as {named.words} but its content is not"
        raise InputError(f"{place(path)}: {says}; a file that begins with {named.begins} is needed")
    return None


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Whether the file at `path` is a recording: by its first bytes, or by its suffix where they are damaged.

    False for CSV, Parquet, and where there is no such file. Reads at most 4096 bytes and loads no library.
    """
    try:
        return kind_at(path) is not None
    except InputError:
        return _by_suffix(Path(path)) is not None and os.path.isfile(path)


def _by_suffix(file: Path) -> Kind | None:
    suffix = file.suffix.lower()
    return next((kind for kind in KINDS if suffix in kind.suffixes), None)


def _by_content(head: bytes, suffix: str) -> Kind | None:
    if head[_USERBLOCK:].startswith(_HDF5) and head.startswith(b"MATLAB"):  # whatever version the text before it names
        return MAT73
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    if head.startswith(_HDF5) and suffix == ".mat":  # written by another program, without MATLAB's 512 bytes before it
        return MAT73
    if head.startswith(b"PK\x03\x04"):
        return _office(head, suffix)
    if _is_apollo(head):
        return APOLLO
    if _CANDUMP.match(head):
        return CANDUMP
    if _ASC_DATE.match(head) and _BASE.search(head):
        return ASC
    return None


def _is_apollo(head: bytes) -> bool:
    """Apollo numbers its records (``.record.00012``), and they begin with no word: a section of type 0 and some size
    up to 2048, in which the header's first field is the version."""
    return head[:4] == bytes(4) and 2 <= int.from_bytes(head[8:16], "little") <= 2048 and head[16:17] == b"\x08"


def _office(head: bytes, suffix: str) -> Kind | None:
    """A ZIP file may be anything: its name tells, or its first entry where the name does not."""
    if b"application/vnd.oasis.opendocument.spreadsheet" in head[:200] or suffix in ODS.suffixes:
        return ODS
    if suffix in EXCEL.suffixes or head[30:200].startswith((b"[Content_Types].xml", b"xl/", b"docProps/app.xml")):
        return EXCEL
    return None


_REASON = 160  # characters of a library's message


def library(module: str, source: str, kind: Kind) -> ModuleType:
    """A module of the library of `kind`. Raises InputError for one that is not there or cannot be loaded."""
    try:
        return importlib.import_module(module)
    except Exception as fault:
        raise InputError(
            f"{source}: is {kind.words}; reading it needs {module}, which cannot be loaded ({reason(fault)}): "
            f"pip install 'avtorch[{kind.extra}]'"
        ) from None


@contextmanager
def guarded(where: str | Callable[[], str], need: str) -> Iterator[None]:
    """Within it, any error of a library becomes an InputError: `where` is the file, with the channel where one is
    read, or tells it when asked; `need` says what would be right."""
    try:
        yield
    except InputError:
        raise
    except BaseException as fault:
        # a panic of a library in Rust is no Exception; an interruption by the user is none either, and goes on
        panic = type(fault).__name__ == "PanicException"
        if not (panic or isinstance(fault, Exception)):
            raise
        what = "is damaged" if panic else "is damaged or of an unknown kind"
        at = where if isinstance(where, str) else where()
        raise InputError(f"{at}: {what} ({reason(fault)}); {need} is needed") from None


def reason(fault: BaseException) -> str:
    """A library's message: one short line without the paths it may hold."""
    text = next((line.strip() for line in str(fault).splitlines() if line.strip()), "")
    text = " ".join(os.path.basename(word) if word.count("/") > 2 else word for word in text.split())
    return printable(f"{type(fault).__name__}: {text}" if text else type(fault).__name__, _REASON)
