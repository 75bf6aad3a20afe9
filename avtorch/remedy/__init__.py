"""What to do about a gap once its cause is known: the setting that the car needs, and its plant in other tools'
terms."""

from avtorch.remedy.exports import Exported, to_autoware, to_openpilot, write_exports
from avtorch.remedy.linearised import linearised
from avtorch.remedy.what_to_set import WhatToSet, setting_for, what_to_set

__all__ = [
    "Exported",
    "WhatToSet",
    "linearised",
    "setting_for",
    "to_autoware",
    "to_openpilot",
    "what_to_set",
    "write_exports",
]
