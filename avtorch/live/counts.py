"""What became of the messages of a live source, counted by kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from avtorch.errors import InputError

REFUSED = {
    "corrupt": "no JSON object, no row of the CSV header's length, or a line that is too long",
    "incomplete": "without a time or a signal that the car's first row had",
    "implausible": "a number that is not finite, or that no car reaches",
    "doubled": "of a time that the car has sent already",
    "late": "older than the rows that have been given to the estimate",
    "jumped": "more than a minute from the rows before and after it",
    "crowded": "beyond the greatest number of rows in a window",
    "too many cars": "of a car beyond the greatest number of cars",
    "contradictory": "of columns that contradict each other in unit or sign",
    "failed": "of a window that could not be computed",
}
"""Why a message or a row was left out, by kind.

Example:
    >>> from avtorch.live import REFUSED
    >>> REFUSED["late"]
    'older than the rows that have been given to the estimate'
"""


class Counts:
    """Numbers since the first start: `rows` taken in, `refused` by kind, `reordered` rows that were put in their place,
    `windows`, `alerts` by detector, `repeated` lines that an earlier run had written.

    Example:
        >>> from avtorch.live import Counts
        >>> counts = Counts()
        >>> counts.refuse("late")
        >>> counts.to_dict()["refused"]
        {'late': 1}
    """

    def __init__(self) -> None:
        self.rows = self.reordered = self.windows = self.repeated = 0
        self.refused: Counter[str] = Counter()
        self.alerts: Counter[str] = Counter()

    def refuse(self, kind: str, many: int = 1) -> None:
        """Count `many` rows or messages left out for this reason, a key of `REFUSED`."""
        self.refused[kind] += many

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain objects."""
        own = {name: getattr(self, name) for name in ("rows", "reordered", "windows", "repeated")}
        return {**own, "refused": dict(self.refused), "alerts": dict(self.alerts)}

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from `to_dict`. Raises `InputError` for anything else."""
        try:
            numbers = {name: int(state[name]) for name in ("rows", "reordered", "windows", "repeated")}
            tables = [Counter({str(k): int(v) for k, v in state[name].items()}) for name in ("refused", "alerts")]
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError("state: counts: are not those of a watch") from None
        vars(self).update(numbers)
        self.refused, self.alerts = tables
