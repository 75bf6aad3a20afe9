"""What to do about a gap once its cause is known: the setting that the car needs, and its plant in other tools'
terms."""

from avtorch.remedy.carla import CarlaPedals, to_carla
from avtorch.remedy.exported import Exported
from avtorch.remedy.exports import to_autoware, to_openpilot, write_exports
from avtorch.remedy.linearised import linearised
from avtorch.remedy.sumo import SumoType, to_sumo
from avtorch.remedy.what_to_set import WhatToSet, setting_for, what_to_set

__all__ = [
    "CarlaPedals",
    "Exported",
    "SumoType",
    "WhatToSet",
    "linearised",
    "setting_for",
    "to_autoware",
    "to_carla",
    "to_openpilot",
    "to_sumo",
    "what_to_set",
    "write_exports",
]
