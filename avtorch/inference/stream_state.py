"""The state of a stream between two rows: its checksum, its open window, and the file it is kept in."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.state import tensor_as
from avtorch.io import Damaged, fingerprint, read_sealed_bytes, write_sealed
from avtorch.io.clock import ROUNDING_S

SCHEMA = "avtorch.belief_stream/1"
MOST = 2**30
"""Maximum size of a state [bytes]."""

_REMEDY = "needs a state as it was saved; begin with a new stream, or load another"


def with_checksum(state: Mapping[str, Any]) -> dict[str, Any]:
    """The state with the fingerprint of its content, under `sha256`."""
    return {**state, "sha256": fingerprint(state)}


def without_checksum(state: Any) -> dict[str, Any]:
    """The state, once its fingerprint is found right.

    Raises:
        InputError: for a state that was changed since it was made, or that carries no fingerprint.
    """
    if not isinstance(state, dict) or not isinstance(state.get("sha256"), str):
        raise InputError("state: carries no checksum, as one damaged, or saved by an earlier avtorch; " + _REMEDY)
    rest = {key: value for key, value in state.items() if key != "sha256"}
    try:
        found = fingerprint(rest)
    except (TypeError, ValueError, RuntimeError, RecursionError):
        found = None
    if found != state["sha256"]:
        raise InputError("state: is damaged or was changed: its checksum is not that of its content; " + _REMEDY)
    return rest


def check_clock(state: Mapping[str, Any], *, columns: Mapping[str, Tensor], vehicles: int) -> None:
    """Check the open window's rows and the clock against each other and against the stream's own empty `columns`.

    Raises:
        InputError: for shapes, types, numbers that are not finite, or times that do not increase within the window.
    """
    rows, window = state["rows"], state["window"]
    if not isinstance(rows, dict) or set(rows) != set(columns):
        found = sorted(map(str, rows)) if isinstance(rows, dict) else type(rows).__name__
        raise InputError(f"state: saved with the columns {found}, not {sorted(columns)}")
    time = rows["time"]
    if type(time) is not Tensor or time.ndim != 1:
        raise InputError("state: rows.time: needs a tensor of shape (time,)")
    count = len(time)
    tensor_as(time, torch.float64, (count,), "state: rows.time")
    tensor_as(rows["usable"], torch.bool, (vehicles, count), "state: rows.usable")
    for name in set(columns) - {"time", "usable"}:
        tensor_as(rows[name], torch.float64, (vehicles, count), f"state: rows.{name}", finite=False)
        # a masked row may hold any number
        if not bool((rows[name].isfinite() | ~rows["usable"]).all()):
            raise InputError(f"state: rows.{name}: not finite in a row that is not masked")
    origin, index, last = state["origin"], state["index"], state["last"]
    for name, value in (("epoch", state["epoch"]), ("origin", origin), ("last", last)):
        if value is not None and (type(value) is not float or not math.isfinite(value)):
            raise InputError(f"state: {name}: found {str(value)[:40]}, needs a time [s] or None")
    driven = state["driven"]
    if type(driven) is not list or len(driven) != vehicles:
        raise InputError(f"state: driven: found {str(driven)[:40]}, needs a list of {vehicles}, one a vehicle")
    for value in driven:
        if value is not None and (type(value) is not float or last is None or not value <= last):
            raise InputError(f"state: driven: found {str(value)[:40]}, needs a time [s] up to the last row's or None")
    if type(index) is not int or not 0 <= index < 2**53:
        raise InputError(f"state: index: found {str(index)[:40]}, needs a whole number from 0")
    if last is not None and state["epoch"] is None:
        raise InputError("state: epoch: missing, though rows came in")
    if origin is None:
        if count or index:
            raise InputError("state: origin: missing, though a window is open")
        return
    start, end = origin + index * window, origin + (index + 1) * window
    if last is None or last >= end or (count and last != float(time[-1])):
        raise InputError("state: last: is not the time of the last row")
    # as in the stream itself, where round-off must not push a row over a window's end
    inside = (time >= start - 2 * ROUNDING_S) & (time < end)
    if not bool(inside.all()) or not bool((time.diff() > 0).all()):
        raise InputError(f"state: rows.time: does not increase from {start:g} to {end:g} s")


def write_state(path: str | PathLike[str], state: Mapping[str, Any]) -> None:
    """Write a state so that the file is complete or unchanged.

    Raises:
        InputError: where the place cannot be written, or is a symlink, a folder or a device.
    """
    of = {key: state[key] for key in ("estimator", "form", "window", "vehicles")}
    write_sealed(Path(path), packed(state), schema=SCHEMA, of=of)


def read_state(path: str | PathLike[str]) -> dict[str, Any]:
    """Read what :func:`write_state` wrote; only tensors and plain values are read, no code is run.

    Raises:
        InputError: for any file that is not exactly as written.
    """
    content = read_sealed_bytes(Path(path), schema=SCHEMA, most=MOST, remedy=_REMEDY).content
    return unpacked(content, Path(path), _REMEDY)


def packed(state: Mapping[str, Any]) -> bytes:
    """Tensors and plain values as bytes."""
    content = io.BytesIO()
    torch.save(dict(state), content)
    return content.getvalue()


def unpacked(content: bytes, path: Path, remedy: str) -> dict[str, Any]:
    """The inverse of :func:`packed`, for the content of the file at ``path``.

    Raises:
        Damaged: for anything else; the message ends with ``remedy``.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            # as torch writes it, so that a small file cannot unfold into a large one
            if any(x.compress_type != zipfile.ZIP_STORED or x.file_size > len(content) for x in archive.infolist()):
                raise ValueError("compressed")
        return torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
    # torch.load has no documented list of errors
    except Exception as fault:
        reason = (str(fault).splitlines() or [type(fault).__name__])[0][:100]
        raise Damaged(f"{path}: holds no tensors and plain values ({reason}); {remedy}") from None
