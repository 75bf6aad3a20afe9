"""Logs and their checks, recorded leaders, answers for machines.

Example:
    >>> import numpy as np
    >>> from avtorch.io import Log, check
    >>> time = np.arange(0.0, 20.0, 0.05)
    >>> log = Log.from_arrays(time=time, accel_cmd=np.sin(time), speed=20 - 0.9 * np.cos(time))
    >>> log.write("drive.csv")
    >>> quality = check(Log.read("drive.csv"))
    >>> quality.rows, round(quality.rate_hz, 3), quality.segments
    (400, 20.0, 1)
"""

from avtorch.io.answers import answer_set, atomic, read_answer, write_json
from avtorch.io.folder_lock import sole_use
from avtorch.io.leaders import read_following, read_leader
from avtorch.io.log import STANDSTILL_MPS, Log, LogSource, as_log, as_logs
from avtorch.io.quality import check
from avtorch.io.sealed import Damaged, fingerprint, read_sealed_bytes, write_sealed

__all__ = [
    "STANDSTILL_MPS",
    "Damaged",
    "Log",
    "LogSource",
    "answer_set",
    "as_log",
    "as_logs",
    "atomic",
    "check",
    "fingerprint",
    "read_answer",
    "read_following",
    "read_leader",
    "read_sealed_bytes",
    "sole_use",
    "write_json",
    "write_sealed",
]
