"""Pages that a reader opens anywhere: the report of a diagnosis, and a page of every other answer.

Names are loaded when first used: the page of a fleet that was only checked needs neither torch nor matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avtorch.report.credibility import write_credibility
    from avtorch.report.diagnosis import write_report
    from avtorch.report.fleet import write_fleet_page
    from avtorch.report.page import Origin

__all__ = ["Origin", "write_credibility", "write_fleet_page", "write_report"]

_HOME = {"Origin": "page", "write_credibility": "credibility", "write_fleet_page": "fleet", "write_report": "diagnosis"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"avtorch.report.{_HOME[name]}"), name)
