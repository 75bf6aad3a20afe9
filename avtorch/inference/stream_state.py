"""The state of a stream between two rows: its checksum, and the file it is kept in."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch

from avtorch.errors import InputError
from avtorch.io import Damaged, fingerprint, read_sealed_bytes, write_sealed

SCHEMA = "avtorch.belief_stream/1"
MOST = 2**30
"""Maximum size of a state [bytes]."""

_REMEDY = "needs a state as it was saved; begin with a new stream, or load another"


def with_checksum(state: Mapping[str, Any]) -> dict[str, Any]:
    """The state with the fingerprint of its content, under `sha256`."""
    return {**state, "sha256": fingerprint(state)}


def without_checksum(state: Any) -> dict[str, Any]:
    """The state, once its fingerprint is found right.

    Raises `InputError` for a state that was changed since it was made, or that carries no fingerprint.
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


def write_state(path: str | PathLike[str], state: Mapping[str, Any]) -> None:
    """Write a state so that the file is complete or unchanged.

    Raises `InputError` where the place cannot be written, or is a symlink, a folder or a device.
    """
    of = {key: state[key] for key in ("estimator", "form", "window", "vehicles")}
    write_sealed(Path(path), packed(state), schema=SCHEMA, of=of)


def read_state(path: str | PathLike[str]) -> dict[str, Any]:
    """Read what :func:`write_state` wrote; only tensors and plain values are read, no code is run.

    Raises `InputError` for any file that is not exactly as written.
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

    Raises `Damaged` for anything else; the message ends with ``remedy``.
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
