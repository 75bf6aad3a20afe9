"""One thread for the library's own work: its arrays are small, and threads that wait for each other take several times
as long as one that does the work.

The command line sets this before the libraries are loaded (`avtorch.cli.one_thread`); in a notebook or a script they
are loaded already, so it is set around the work and restored behind it.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

Pool = tuple[Callable[[], int], Callable[[int], object]]
"""How many threads there are, and what sets their number."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch and the linear algebra of NumPy and SciPy with one thread each, where the user has set no number of them by
    `OMP_NUM_THREADS`; afterwards as before.

    Example:
        >>> import torch
        >>> from avtorch.threads import one_thread
        >>> before = torch.get_num_threads()
        >>> with one_thread():
        ...     within = torch.get_num_threads()
        >>> torch.get_num_threads() == before
        True
    """
    if "OMP_NUM_THREADS" in os.environ:
        yield
        return
    before = [(put, count()) for count, put in pools()]
    try:
        for put, _ in before:
            put(1)
        yield
    finally:
        for put, count in before:
            put(count)


def pools() -> list[Pool]:
    """The pools of threads that are loaded: torch's, which its linear algebra shares, and OpenBLAS's."""
    torch = sys.modules.get("torch")
    return [*([] if torch is None else [(torch.get_num_threads, torch.set_num_threads)]), *_blas()]


@lru_cache(maxsize=1)
def _blas() -> tuple[Pool, ...]:
    """OpenBLAS in the wheels of NumPy and SciPy, each with a pool of its own; another build's is not found."""
    found = []
    for package in ("numpy", "scipy"):
        home = Path(getattr(sys.modules.get(package), "__file__", None) or "nowhere/nothing").parent
        for file in (*home.with_name(f"{package}.libs").glob("*openblas*"), *(home / ".dylibs").glob("*openblas*")):
            library = ctypes.CDLL(str(file))  # which is loaded already
            for form in ("scipy_openblas_{}_num_threads64_", "scipy_openblas_{}_num_threads"):
                if hasattr(library, form.format("set")):
                    found.append((getattr(library, form.format("get")), getattr(library, form.format("set"))))
                    break
    return tuple(found)
