"""Methods that can answer, by name."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest.rivals import black_box, likelihood_bic, random_guess, sparse_regression
from benchmarks.blindtest.trial import Answerer


def avtorch(log: Log) -> dict[str, Any]:
    """avtorch's own diagnosis, by Laplace's approximation."""
    from avtorch.gap.diagnose import diagnose

    return diagnose(log, posterior="laplace", progress=False).to_dict()


RIVALS: dict[str, Answerer] = {
    "likelihood_bic": likelihood_bic,
    "sparse_regression": sparse_regression,
    "black_box": black_box,
    "random_guess": random_guess,
}
"""The rival methods, by name."""


def rivals(names: str | Sequence[str] = "all") -> dict[str, Answerer]:
    """Rivals by name: `"all"` that are installed, `"none"`, or those named; the random guess is always included.

    Raises `InputError` for an unknown name, and for one that is named and not installed.

    Example:
        >>> from benchmarks.blindtest.answerers import rivals
        >>> list(rivals(["black_box"]))
        ['black_box', 'random_guess']
    """
    if names == "all":
        wanted = [name for name in RIVALS if name != "sparse_regression" or find_spec("pysindy") is not None]
    elif names == "none":
        wanted = []
    else:
        wanted = names.split(",") if isinstance(names, str) else list(names)
    for name in wanted:
        if name not in RIVALS:
            raise InputError(f"rivals: found {name!r}, needs all, none, or some of {', '.join(RIVALS)}")
    if "sparse_regression" in wanted:
        from benchmarks.blindtest.rivals.sparse_regression import pysindy

        pysindy()
    return {name: answerer for name, answerer in RIVALS.items() if name in wanted or name == "random_guess"}
