"""The report of a diagnosis: one HTML file that a reader opens anywhere."""

from avtorch.report.origin import Origin
from avtorch.report.page import report_html, write_report

__all__ = ["Origin", "report_html", "write_report"]
