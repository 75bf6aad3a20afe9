"""Recordings in the formats of the trade: MDF, ROS bags and MCAP, Apollo records, CAN logs, MAT files, Excel sheets.

Each format is read by a library of its own, an extra such as ``avtorch[mdf]``, loaded when a file of that format is
opened. ``avtorch[logs]`` brings all of them.
"""

from avtorch.io.formats.apart import open_recording
from avtorch.io.formats.kinds import is_recording

__all__ = ["is_recording", "open_recording"]
