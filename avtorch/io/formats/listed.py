"""What the recordings of all formats share: the listing, and the checks of what is asked of it."""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping

from avtorch.errors import InputError, listed, quoted
from avtorch.io.recording import Channel
from avtorch.io.size import MOST_CELLS, MOST_COLUMNS


class Listed(ABC):
    """A `Recording` whose names are known. A format adds `_read`."""

    def __init__(
        self,
        source: str,
        form: str,
        names: Collection[str],
        units: Mapping[str, str] | None = None,
        remarks: Collection[str] = (),
    ) -> None:
        self.source = source
        self.form = form
        self.names = tuple(names)
        self.units: Mapping[str, str] = dict(units or {})
        self.remarks = tuple(remarks)
        self._known = frozenset(self.names)
        if not self.names:
            raise InputError(f"{source}: is {form} without any numeric channel; at least one is needed")

    def read(self, names: Collection[str]) -> dict[str, Channel]:
        """Channels by name, those that are asked for and no others.

        Raises InputError naming file and channel for one that is not there or is damaged, and beyond 10,000 channels
        or 20 million samples.
        """
        asked = tuple(dict.fromkeys(names))
        if len(asked) > MOST_COLUMNS:
            raise InputError(f"{self.source}: {len(asked):,} channels are asked for; {MOST_COLUMNS:,} at most can be")
        for name in asked:
            if name not in self._known:
                raise InputError(f"{self.source}: channel {quoted(name, 80)} is missing; {self._nearest(name)}")
        return self._read(asked) if asked else {}

    @abstractmethod
    def _read(self, names: tuple[str, ...]) -> dict[str, Channel]:
        """The channels of `names`, which are known, each once, and at least one."""

    def _nearest(self, name: str) -> str:
        near = difflib.get_close_matches(name, self.names[:MOST_COLUMNS], n=3, cutoff=0.5)
        return f"the nearest: {', '.join(quoted(n, 80) for n in near)}" if near else f"channels: {listed(self.names)}"


def refuse_cells(source: str, count: int) -> None:
    """Raises InputError where `count` samples are more than a reader takes."""
    if count > MOST_CELLS:
        raise InputError(f"{source}: has {count:,} samples in the channels that are read; needs {MOST_CELLS:,} at most")
