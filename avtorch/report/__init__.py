"""Pages that a reader opens anywhere: the report of a diagnosis, and a page of every other answer.

Names are loaded when first used: the page of a fleet that was only checked needs neither torch nor matplotlib.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avtorch.report.comparison import comparison_html, write_comparison_page
    from avtorch.report.credibility import credibility_page, write_credibility
    from avtorch.report.diagnosis import report_html, write_report
    from avtorch.report.estimates import estimates_html, write_estimates_page
    from avtorch.report.fleet import fleet_html, write_fleet_page
    from avtorch.report.origin import Origin
    from avtorch.report.run import run_html, write_run_page
    from avtorch.report.validation import validation_html, write_validation_page

__all__ = [
    "Origin",
    "comparison_html",
    "credibility_page",
    "estimates_html",
    "fleet_html",
    "report_html",
    "run_html",
    "validation_html",
    "write_comparison_page",
    "write_credibility",
    "write_estimates_page",
    "write_fleet_page",
    "write_report",
    "write_run_page",
    "write_validation_page",
]

_HOME = (
    {"Origin": "origin", "report_html": "diagnosis", "write_report": "diagnosis"}
    | {
        "credibility_page": "credibility",
        "write_credibility": "credibility",
    }
    | {
        name: kind
        for kind in ("comparison", "estimates", "fleet", "run", "validation")
        for name in (f"{kind}_html", f"write_{kind}_page")
    }
)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"avtorch.report.{_HOME[name]}"), name)
