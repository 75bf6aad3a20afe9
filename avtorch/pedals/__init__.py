"""Commands that are no accelerations: maps from them to the acceleration they demand.

Example:
    >>> import numpy as np
    >>> from avtorch import Log
    >>> from avtorch.pedals import fit_pedals
    >>> time = np.arange(0.0, 120.0, 0.05)
    >>> throttle = 0.3 + 0.2 * np.sin(0.5 * time)
    >>> speed = 15.0 + 1.2 * np.sin(0.5 * time - np.pi / 2)  # its slope is three times what is beyond 0.3
    >>> log = Log.from_arrays(time=time, throttle=throttle, speed=speed)
    >>> commanded = fit_pedals(log).map.commanded(log)  # what estimate and diagnose take
    >>> bool(np.ptp(commanded.accel_cmd) > 1.0)
    True
"""

from avtorch.pedals.export import MapTable, accel_table, brake_table, read_map, write_map
from avtorch.pedals.fit_map import HeldOut, PedalFit, fit_pedals
from avtorch.pedals.pedal_drive import PedalCommand
from avtorch.pedals.pedal_map import PedalMap, PedalTable

__all__ = [
    "HeldOut",
    "MapTable",
    "PedalCommand",
    "PedalFit",
    "PedalMap",
    "PedalTable",
    "accel_table",
    "brake_table",
    "fit_pedals",
    "read_map",
    "write_map",
]
