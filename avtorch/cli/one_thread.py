"""One thread for a command: its tensors are small, and threads that wait for each other take several times as long."""

from __future__ import annotations

import os
import sys

_POOLS = ("MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def use_one_thread() -> None:
    """Give torch and the linear algebra behind it one thread each, where the user has set no other number.

    `OMP_NUM_THREADS` sets all of them, another variable its own library. The libraries read these variables when they
    are loaded: in a program that has loaded them before, nothing changes.
    """
    if "OMP_NUM_THREADS" in os.environ or not {"numpy", "torch"}.isdisjoint(sys.modules):
        return
    for name in ("OMP_NUM_THREADS", *_POOLS):
        os.environ.setdefault(name, "1")
