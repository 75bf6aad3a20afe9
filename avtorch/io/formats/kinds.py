"""The formats of recordings: how messages call them, which file reads them, and what has to be installed for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Library:
    """What reads a format: the module, the name under which it is installed, and the extra that brings it."""

    module: str
    package: str
    extra: str


@dataclass(frozen=True)
class Kind:
    """One format."""

    words: str
    """As messages call it."""
    reader: str
    """The module of this package that opens it."""
    library: Library | None
    """None where avtorch's own requirements read it."""
    suffixes: tuple[str, ...]
    """In lower case. A file of this name that does not begin as the format does is refused, not guessed at."""
    begins: str
    """How a file of this format begins, in words."""


_ASAMMDF = Library("asammdf", "asammdf", "mdf")
_ROSBAGS = Library("rosbags", "rosbags", "bags")
_CAN = Library("can", "python-can", "can")
_H5PY = Library("h5py", "h5py", "mat")
_CALAMINE = Library("python_calamine", "python-calamine", "excel")
_CYBER = Library("cyber_record", "cyber-record", "apollo")

MDF = Kind("MDF", "mdf", _ASAMMDF, (".mf4", ".mdf", ".mf3"), "'MDF' or 'UnFinMF'")
ROS1 = Kind("ROS 1 bag", "bags", _ROSBAGS, (".bag",), "'#ROSBAG V2.0'")
ROS2_SQLITE = Kind("ROS 2 bag (SQLite)", "bags", _ROSBAGS, (".db3",), "'SQLite format 3'")
ROS2_MCAP = Kind("ROS 2 bag (MCAP)", "bags", _ROSBAGS, (".mcap",), "the byte 0x89 and 'MCAP0'")
ROS2_FOLDER = Kind("ROS 2 bag (folder)", "bags", _ROSBAGS, (), "a folder with metadata.yaml")
BLF = Kind("CAN log (BLF)", "can", _CAN, (".blf",), "'LOGG'")
ASC = Kind("CAN log (ASC)", "can", _CAN, (".asc",), "a line 'date ...' and a line 'base hex' or 'base dec'")
CANDUMP = Kind("CAN log (candump)", "can", _CAN, (), "a line such as '(1700000000.000000) can0 123#0011'")
MAT5 = Kind("MAT", "matlab", None, (".mat",), "'MATLAB 5.0 MAT-file' or 'MATLAB 7.3 MAT-file'")
MAT73 = Kind("MAT 7.3", "matlab", _H5PY, (), "'MATLAB 7.3 MAT-file'")
EXCEL = Kind("Excel", "excel", _CALAMINE, (".xlsx", ".xlsm", ".xlsb"), "'PK', as a ZIP file")
XLS = Kind("Excel 97", "excel", _CALAMINE, (".xls",), "the bytes D0 CF 11 E0")
ODS = Kind("OpenDocument", "excel", _CALAMINE, (".ods",), "'PK', as a ZIP file")
APOLLO = Kind("Apollo record", "apollo", _CYBER, (".record",), "a section of type 0 with its header")

KINDS = (MDF, ROS1, ROS2_SQLITE, ROS2_MCAP, ROS2_FOLDER, BLF, ASC, CANDUMP, MAT5, MAT73, EXCEL, XLS, ODS, APOLLO)


def named(words: str) -> Kind:
    """The format of these words, each of which has its own."""
    return next(kind for kind in KINDS if kind.words == words)
