"""How we know: draws held against references, with the error that chance makes."""

from avtorch.validation.agreement import Agreement, agreement, between
from avtorch.validation.stein import Stein, stein_discrepancy
from avtorch.validation.validate import NutsSettings, Validation, validate
from avtorch.validation.verdict import Verdict
from avtorch.validation.windows import Windows, synthetic_windows, windows_from_prior, windows_of_log

__all__ = [
    "Agreement",
    "NutsSettings",
    "Stein",
    "Validation",
    "Verdict",
    "Windows",
    "agreement",
    "between",
    "stein_discrepancy",
    "synthetic_windows",
    "validate",
    "windows_from_prior",
    "windows_of_log",
]
