"""Recordings in the formats of the trade: MDF, ROS bags and MCAP, Apollo records, CAN logs, MAT files, Excel sheets.

Each format is read by a library of its own, an extra such as ``avtorch[mdf]``, loaded when a file of that format is
opened. ``avtorch[logs]`` brings all of them.
"""

from __future__ import annotations

import os
from collections.abc import Collection

from avtorch.errors import InputError
from avtorch.io.formats.apart import open_apart
from avtorch.io.formats.kinds import NEED, is_recording, kind_at
from avtorch.io.formats.listed import Recording
from avtorch.io.opening import place

__all__ = ["is_recording", "open_recording"]


def open_recording(path: str | os.PathLike[str], names: Collection[str] = ()) -> Recording:
    """Open a recording; its format is recognised by how it begins, then by its suffix.

    A CAN log is decoded by the ``.dbc`` of its name beside it, or the only one in its folder. Names are listed and no
    samples are read, except where a format has to be read to be listed (MAT before 7.3, Excel).

    Each is read in a process of its own, which a damaged file may end or fill, and in another one for channels that are
    not among `names`, which are read as it is opened, as far as it has them.

    Raises InputError naming the file: for what is no regular file or no recording, for a damaged one, for one whose
    library is not installed (with the command that installs it), and for a CAN log without a database.
    """
    kind = kind_at(path)
    if kind is None:
        what = "a directory without the metadata.yaml of a ROS 2 bag" if os.path.isdir(path) else "no recording"
        raise InputError(f"{place(path)}: is {what}; {NEED} is needed")
    return open_apart(path, kind, names)
