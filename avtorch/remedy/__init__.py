"""What to do about a gap once its cause is known: the setting that the car needs, and its plant in other tools'
terms."""

from avtorch.remedy.exports import to_autoware, to_carla, to_openpilot, to_sumo, write_exports
from avtorch.remedy.trial import Trial
from avtorch.remedy.what_to_set import WhatToSet, setting_for, what_to_set

__all__ = [
    "Trial",
    "WhatToSet",
    "setting_for",
    "to_autoware",
    "to_carla",
    "to_openpilot",
    "to_sumo",
    "what_to_set",
    "write_exports",
]
