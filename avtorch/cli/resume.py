"""Going on with an interrupted diagnosis, or beginning anew: the fits that were finished."""

from __future__ import annotations

from pathlib import Path

from avtorch.errors import InputError

FITS = "fits.json"
"""Finished fits, kept by the diagnosis, which also holds them against the logs and settings they are of."""

_EARLIER = "fits_of.json"  # beside them until 0.1.0: what they are of


def begin_anew(out: Path) -> None:
    """Remove the fits kept in `out`. Raises `InputError` where something else has their name."""
    for name in (FITS, _EARLIER):
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as fault:
            raise InputError(
                f"--no-resume: {out / name} cannot be removed ({fault.strerror}); needs another folder"
            ) from None
