"""How long `avtorch estimate` and `avtorch diagnose` take for a log, on one core of a server of 2026.

Both go with the rows that count. `estimate` without measured jerk took 2.2 s for 6,000 rows of one channel, 3.1 s of
two channels and 12.7 s for 15,000 uneven rows, and 2.5 s to start and draw. `diagnose` took 6 to 61 s for logs of
30,000 rows: the more effects act, the longer.
"""

from __future__ import annotations

from avtorch.io.log import Log

_START_S = 2.5
_ESTIMATE_S = {1: 0.36e-3, 2: 0.52e-3}  # a row, by channels
_UNEVEN = 1.7  # times as long for rows that are not even
_JITTER = 0.02  # of a step, from which they are not
_DIAGNOSE_S = (0.1e-3, 2.0e-3)  # a row, at least and at most


def duration_note(log: Log, jitter: float) -> str:
    """A sentence; `jitter` is the share of a step by which rows are uneven."""
    rows = int(log.usable.sum())
    channels = sum(signal is not None for signal in (log.accel, log.speed))
    each = _ESTIMATE_S[min(max(channels, 1), 2)] * (_UNEVEN if jitter > _JITTER else 1.0)
    least, most = (_START_S + rows * x for x in _DIAGNOSE_S)
    return (
        f"avtorch estimate takes about {_START_S + rows * each:.0f} s of one core, "
        f"avtorch diagnose {least:.0f} to {most:.0f} s"
    )
