"""Pages that a reader opens anywhere: the report of a diagnosis, and the page of a fleet.

Names are loaded when first used: the page of a fleet that was only checked needs neither torch nor matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avtorch.report.fleet_page import fleet_html, write_fleet_page
    from avtorch.report.origin import Origin
    from avtorch.report.page import report_html, write_report

__all__ = ["Origin", "fleet_html", "report_html", "write_fleet_page", "write_report"]

_HOME = {"Origin": "origin", "fleet_html": "fleet_page", "write_fleet_page": "fleet_page"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"avtorch.report.{_HOME.get(name, 'page')}"), name)
