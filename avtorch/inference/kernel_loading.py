"""Modules of compiled loops (numba), or why they cannot be had."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Literal


@dataclass(frozen=True)
class Unavailable:
    """Why something is not compiled."""

    why: str


@cache
def load_kernels(module: Literal["kernels", "latent_kernels"]) -> ModuleType | Unavailable:
    """A module of compiled code, from numba's cache on disk; a machine's first call compiles it and fills the cache."""
    try:
        import numba
    except ImportError:
        return Unavailable("numba is not installed: pip install numba")
    if numba.config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        return Unavailable("numba does not compile here: NUMBA_DISABLE_JIT is set")
    try:
        return import_module(f"avtorch.inference.{module}")
    except RuntimeError as fault:  # numba found no folder to write to; without one every process would compile anew
        return Unavailable(
            f"compiled code cannot be kept: {fault}; set NUMBA_CACHE_DIR to a folder that can be written"
        )
