"""Validation: draws compared with references, with their Monte Carlo error.

Example:
    >>> from avtorch.inference import integrate, sample
    >>> from avtorch.validation import agreement, synthetic_windows
    >>> density = synthetic_windows(2, seed=1).density
    >>> agreement(sample(density), integrate(density, nodes=25)).within(slack=0.02).tolist()
    [True, True]
"""

from avtorch.validation.agreement import Agreement, AgreementVerdict, agreement, between
from avtorch.validation.reference import NutsSettings
from avtorch.validation.stein import Stein, stein_discrepancy
from avtorch.validation.validate import Validation, validate
from avtorch.validation.windows import Windows, synthetic_windows, windows_of_log

__all__ = [
    "Agreement",
    "AgreementVerdict",
    "NutsSettings",
    "Stein",
    "Validation",
    "Windows",
    "agreement",
    "between",
    "stein_discrepancy",
    "synthetic_windows",
    "validate",
    "windows_of_log",
]
