"""The formats of recordings: how messages call them, which file reads them, and what has to be installed for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """One format."""

    words: str
    """As messages call it."""
    reader: str
    """The module of this package that opens it."""
    suffixes: tuple[str, ...]
    """In lower case. A file of this name that does not begin as the format does is refused, not guessed at."""
    begins: str
    """How a file of this format begins, in words."""


MDF = Kind("MDF", "mdf", (".mf4", ".mdf", ".mf3"), "'MDF' or 'UnFinMF'")
ROS1 = Kind("ROS 1 bag", "bags", (".bag",), "'#ROSBAG V2.0'")
ROS2_SQLITE = Kind("ROS 2 bag (SQLite)", "bags", (".db3",), "'SQLite format 3'")
ROS2_MCAP = Kind("ROS 2 bag (MCAP)", "bags", (".mcap",), "the byte 0x89 and 'MCAP0'")
ROS2_FOLDER = Kind("ROS 2 bag (folder)", "bags", (), "a folder with metadata.yaml")
BLF = Kind("CAN log (BLF)", "can", (".blf",), "'LOGG'")
ASC = Kind("CAN log (ASC)", "can", (".asc",), "a line 'date ...' and a line 'base hex' or 'base dec'")
CANDUMP = Kind("CAN log (candump)", "can", (), "a line such as '(1700000000.000000) can0 123#0011'")
MAT5 = Kind("MAT", "matlab", (".mat",), "'MATLAB 5.0 MAT-file' or 'MATLAB 7.3 MAT-file'")
MAT73 = Kind("MAT 7.3", "matlab", (), "'MATLAB 7.3 MAT-file'")
EXCEL = Kind("Excel", "excel", (".xlsx", ".xlsm", ".xlsb"), "'PK', as a ZIP file")
XLS = Kind("Excel 97", "excel", (".xls",), "the bytes D0 CF 11 E0")
ODS = Kind("OpenDocument", "excel", (".ods",), "'PK', as a ZIP file")

KINDS = (MDF, ROS1, ROS2_SQLITE, ROS2_MCAP, ROS2_FOLDER, BLF, ASC, CANDUMP, MAT5, MAT73, EXCEL, XLS, ODS)
