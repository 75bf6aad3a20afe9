"""Going on with an interrupted diagnosis or estimate, or beginning anew: the fits or windows that were finished."""

from __future__ import annotations

from pathlib import Path

from avtorch.errors import InputError

FITS = "fits.json"
"""Finished fits. The diagnosis keeps them and compares their fingerprint with that of its logs and settings."""

WINDOWS = "windows.state"
"""Finished windows, and the belief behind them. The estimate keeps them and compares what they belong to likewise."""

EARLIER_FITS = "fits_of.json"
"""Written beside the fits until 0.1.0: the fingerprint of their logs and settings."""


def begin_anew(out: Path, *names: str) -> None:
    """Remove what is kept in `out` under `names`. Raises `InputError` where something else has such a name."""
    for name in names:
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as fault:
            raise InputError(
                f"--no-resume: {out / name} cannot be removed ({fault.strerror}); needs another folder"
            ) from None
