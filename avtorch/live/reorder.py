"""Rows of one car in the order of their times: kept back for a while, so that a late one still finds its place."""

from __future__ import annotations

from bisect import bisect_left

from avtorch.io.clock import ROUNDING_S

TimedRow = tuple[float, ...]
"""Time [s], then the values of the car's columns."""


def _time(row: TimedRow) -> float:
    return row[0]


class ReorderBuffer:
    """Rows that may still be overtaken; memory is bounded by `lateness` and `most`.

    Args:
        lateness: how far behind the newest row a row may come and still count [s].
        most: rows kept back at most; beyond it the oldest are released early.
    """

    def __init__(self, lateness: float, most: int) -> None:
        self.lateness, self.most = lateness, most
        self.waiting: list[TimedRow] = []
        self.newest = self.released = float("-inf")

    def put(self, row: TimedRow) -> str | None:
        """Take a row in. Returns `"reordered"` where it was not the newest, and `"doubled"` or `"late"` where it was
        left out."""
        time, waiting = row[0], self.waiting
        if time > self.newest + ROUNDING_S:
            waiting.append(row)
            self.newest = time
            return None
        if time <= self.released + ROUNDING_S:
            return "doubled" if time >= self.released - ROUNDING_S else "late"
        place = bisect_left(waiting, time, key=_time)
        near = [x[0] for x in waiting[max(place - 1, 0) : place + 1]]
        if any(abs(x - time) <= ROUNDING_S for x in near):
            return "doubled"
        waiting.insert(place, row)
        return "reordered"

    def ready(self) -> list[TimedRow]:
        """The rows that nothing can overtake any more, in order; they leave the buffer."""
        waiting = self.waiting
        edge = self.newest - self.lateness
        if not waiting or (waiting[0][0] > edge and len(waiting) <= self.most):
            return []
        count = max(bisect_left(waiting, edge, key=_time), len(waiting) - self.most)
        if count < len(waiting) and waiting[count][0] <= edge:
            count += 1
        return self._out(count)

    def drain(self) -> list[TimedRow]:
        """All rows, in order; they leave the buffer."""
        return self._out(len(self.waiting))

    def begin_anew(self) -> None:
        """Forget the clock, once drained: the next row may have any time."""
        self.newest = self.released = float("-inf")

    def _out(self, count: int) -> list[TimedRow]:
        out, self.waiting = self.waiting[:count], self.waiting[count:]
        if out:
            self.released = out[-1][0]
        return out
