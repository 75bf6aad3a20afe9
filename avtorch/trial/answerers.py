"""Those who can be asked, by name."""

from __future__ import annotations

from typing import Any

from avtorch.io import Log
from avtorch.trial.rivals import random_guess
from avtorch.trial.work import Answerer


def avtorch(log: Log) -> dict[str, Any]:
    """avtorch's own diagnosis, by Laplace's approximation."""
    from avtorch.gap.diagnose import diagnose

    return diagnose(log, posterior="laplace").to_dict()


RIVALS: dict[str, Answerer] = {"random_guess": random_guess}
"""The competitors."""
