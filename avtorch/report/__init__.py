"""Pages that a reader opens anywhere: the report of a diagnosis, and a page of every other answer.

Names are loaded when first used: the page of a fleet that was only checked needs neither torch nor matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avtorch.report.comparison import comparison_html
    from avtorch.report.credibility import credibility_page, write_credibility
    from avtorch.report.diagnosis import report_html, write_report
    from avtorch.report.estimates import estimates_html
    from avtorch.report.fleet import fleet_html, write_fleet_page
    from avtorch.report.page import Origin
    from avtorch.report.run import run_html
    from avtorch.report.validation import validation_html

__all__ = [
    "Origin",
    "comparison_html",
    "credibility_page",
    "estimates_html",
    "fleet_html",
    "report_html",
    "run_html",
    "validation_html",
    "write_credibility",
    "write_fleet_page",
    "write_report",
]

_HOME = {
    "Origin": "page",
    "credibility_page": "credibility",
    "report_html": "diagnosis",
    "write_credibility": "credibility",
    "write_fleet_page": "fleet",
    "write_report": "diagnosis",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"avtorch.report.{_HOME.get(name, name.removesuffix('_html'))}"), name)
