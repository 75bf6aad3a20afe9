"""One thread for the library's own work: its arrays are small, and threads that wait for each other take several times
as long as one that does the work.

The command line sets this before the libraries are loaded (`avtorch.cli.app`); in a notebook or a script they
are loaded already, so it is set around the work and restored behind it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


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
    torch = sys.modules.get("torch")
    count = None if torch is None else torch.get_num_threads()
    try:
        if torch is not None:
            torch.set_num_threads(1)
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        if torch is not None:
            torch.set_num_threads(count)
