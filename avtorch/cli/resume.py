"""Going on with an interrupted diagnosis, or beginning anew: the fits that were finished."""

from __future__ import annotations

from pathlib import Path

from avtorch.errors import InputError

FITS = "fits.json"
"""Finished fits. The diagnosis keeps them and compares their fingerprint with that of its logs and settings."""

_EARLIER = "fits_of.json"  # written beside the fits until 0.1.0: the fingerprint of their logs and settings


def begin_anew(out: Path) -> None:
    """Remove the fits kept in `out`. Raises `InputError` where something else has their name."""
    for name in (FITS, _EARLIER):
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as fault:
            raise InputError(
                f"--no-resume: {out / name} cannot be removed ({fault.strerror}); needs another folder"
            ) from None
