"""One SHA-256 over values of any kind: equal fingerprints mean equal values, to the bit."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def fingerprint(*parts: Any) -> str:
    """64 hex digits over `parts`: arrays and tensors by dtype, shape and bytes, dataclasses by class and fields.

    Takes None, booleans, numbers, strings, bytes, classes, slices, arrays, and mappings, sequences and dataclasses of
    these. Raises TypeError for anything else: omitting a value would give two different objects the same fingerprint.
    """
    state = hashlib.sha256()
    _feed(state, parts)
    return state.hexdigest()


def _feed(state: Any, x: Any) -> None:
    # every value is preceded by its kind and length, so that no two sequences of values share their bytes
    if x is None or isinstance(x, (bool, int, str)):
        _tagged(state, type(x).__name__, repr(x).encode("utf-8", "backslashreplace"))
    elif isinstance(x, float):
        _tagged(state, "float", struct.pack("<d", x))
    elif isinstance(x, bytes):
        _tagged(state, "bytes", x)
    elif isinstance(x, type):
        # files made under an earlier name of a class stay good
        _tagged(state, "type", vars(x).get("fingerprint_name", f"{x.__module__}.{x.__qualname__}").encode())
    elif is_dataclass(x):
        _feed(state, type(x))
        for field in fields(x):
            _feed(state, field.name)
            _feed(state, getattr(x, field.name))
    elif isinstance(x, Mapping):
        _tagged(state, "mapping", str(len(x)).encode())
        for key in sorted(x):
            _feed(state, key)
            _feed(state, x[key])
    elif isinstance(x, slice):
        _tagged(state, "slice", repr((x.start, x.stop, x.step)).encode())
    elif isinstance(x, (list, tuple)):
        _tagged(state, "sequence", str(len(x)).encode())
        for value in x:
            _feed(state, value)
    elif hasattr(x, "__array__"):
        array = np.asarray(x)
        if array.dtype.hasobject:
            raise TypeError("an array of objects has no bytes of its own")
        _tagged(state, f"array {array.dtype.str} {array.shape}", array.tobytes())
    else:
        raise TypeError(f"a {type(x).__name__} has no fingerprint")


def _tagged(state: Any, kind: str, content: bytes) -> None:
    state.update(f"{kind}:{len(content)}:".encode())
    state.update(content)
