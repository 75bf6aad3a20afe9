"""Commands that are no accelerations: maps from them to the acceleration they demand, by `fit_pedals`."""

from avtorch.pedals.export import MapTable, accel_table, brake_table, write_map
from avtorch.pedals.fit_map import HeldOut, PedalFit, fit_pedals
from avtorch.pedals.pedal_map import PedalMap, PedalTable

__all__ = [
    "HeldOut",
    "MapTable",
    "PedalFit",
    "PedalMap",
    "PedalTable",
    "accel_table",
    "brake_table",
    "fit_pedals",
    "write_map",
]
