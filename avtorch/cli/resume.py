"""Going on with an interrupted diagnosis: the fits that were finished, and the check that they are of the same work."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.io import Log

FITS = "fits.json"
"""Finished fits, kept by the diagnosis."""

WORK = "fits_of.json"
"""What they are fits of: the logs and the settings."""


def same_work(out: Path, logs: Sequence[Log], settings: Mapping[str, Any], *, resume: bool) -> None:
    """Make sure that fits kept in `out` are of these `logs` and `settings`, and note for a later run what these are.

    With `resume` False the fits are removed first. Raises `InputError` that says what differs.
    """
    from avtorch.io import write_json

    work = {"logs": [_entry(log) for log in logs], "settings": dict(settings)}
    fits, note = out / FITS, out / WORK
    if not resume:
        fits.unlink(missing_ok=True)
        note.unlink(missing_ok=True)
    if fits.exists() and note.exists():
        try:
            before = json.loads(note.read_text(encoding="utf-8"))
            other = _difference(before, work)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            other = f"{note.name}, which cannot be read,"
        if other:
            raise InputError(
                f"--out: {fits} was begun with {other}; needs the same, another folder, or --no-resume to begin anew"
            )
    write_json(note, work)


def _entry(log: Log) -> dict[str, Any]:
    """A log by what is in it, however its columns were called."""
    content = hashlib.sha256()
    for name in ("time", "accel_cmd", "accel", "speed", "engaged", "grade", "segment"):
        values = getattr(log, name)
        content.update(name.encode() if values is None else name.encode() + values.tobytes())
    return {"name": log.name, "rows": log.rows, "sha256": content.hexdigest()}


def _difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """What was otherwise, in words; None if nothing was."""
    if [x["sha256"] for x in before["logs"]] != [x["sha256"] for x in now["logs"]]:
        return "other logs (" + ", ".join(f"{x['name']}, {x['rows']} rows" for x in before["logs"]) + ")"
    for name, value in now["settings"].items():
        old = before["settings"].get(name)
        if old != value:
            return _told(name, old)
    return None


def _told(option: str, value: Any) -> str:
    """An option as it would be typed."""
    if isinstance(value, bool):
        return option if value else option.replace("--", "--no-", 1)
    if value is None:
        return f"{option} at its default"
    return f"{option} {','.join(value) if isinstance(value, list) else ' '.join(str(value).split())}"
