"""Going on with an interrupted estimate, or beginning anew: the windows that were finished."""

from __future__ import annotations

from pathlib import Path

from avtorch.errors import InputError

WINDOWS = "windows.state"
"""Finished windows, and the belief behind them. The estimate keeps them and compares what they belong to with its
settings."""


def begin_anew(out: Path, *names: str) -> None:
    """Remove what is kept in `out` under `names`. Raises `InputError` where something else has such a name."""
    for name in names:
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as fault:
            raise InputError(
                f"--no-resume: {out / name} cannot be removed ({fault.strerror}); needs another folder"
            ) from None
