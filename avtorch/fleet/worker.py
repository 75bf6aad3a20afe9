"""What Dask loads in each worker of a local cluster before its first task (`dask_setup` is the name it looks for)."""

from __future__ import annotations

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C to the process that began the work, and it ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
