"""A recording of many signals, each on a clock of its own: what the readers of all formats answer and share.

A signal is listed before it is read, so that a file of thousands of signals costs no more than the few that are used.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.io.opening import MOST_CELLS, MOST_COLUMNS


@dataclass(frozen=True, eq=False)
class Channel:
    """One signal: `values` (sample,) at `time` (sample,) [s], as recorded; NaN where a value is not valid.

    `time` need not be even, nor rise throughout (a merged or damaged file); channels of one clock share the array.
    """

    name: str
    time: FloatArray
    values: FloatArray


@dataclass(eq=False)
class Recording:
    """An opened file: the file as messages name it (`source`), its `form` in words, such as ``MDF 4.10``, all numeric
    channels (`names`) in the file's order, their `units` as far as the file states them, and `remarks` on what was
    salvaged, left out or guessed.

    `load` reads channels that are asked for, each once, and at least one. Raises InputError for a file of no channel.
    """

    source: str
    form: str
    names: Collection[str]
    units: Mapping[str, str]
    remarks: Collection[str]
    load: Callable[[tuple[str, ...]], dict[str, Channel]]

    def __post_init__(self) -> None:
        self.names, self.remarks = tuple(self.names), tuple(self.remarks)
        if not self.names:
            raise InputError(f"{self.source}: is {self.form} without any numeric channel; at least one is needed")

    def read(self, names: Collection[str]) -> dict[str, Channel]:
        """Channels by name, those that are asked for and no others.

        Raises InputError naming file and channel for one that is not there or is damaged, and beyond 10,000 channels
        or 20 million samples.
        """
        asked = tuple(dict.fromkeys(names))
        if len(asked) > MOST_COLUMNS:
            raise InputError(f"{self.source}: {len(asked):,} channels are asked for; {MOST_COLUMNS:,} at most can be")
        if missing := set(asked).difference(self.names):
            name, there = quoted(min(missing, key=asked.index), 80), listed(self.names)
            raise InputError(f"{self.source}: channel {name} is missing; channels: {there}")
        found = self.load(asked) if asked else {}
        refuse_cells(self.source, sum(len(channel.values) for channel in found.values()))
        return {name: found[name] for name in asked}


def refuse_cells(source: str, count: int) -> None:
    """Raises InputError where `count` samples are more than a reader takes."""
    if count > MOST_CELLS:
        raise InputError(f"{source}: has {count:,} samples in the channels that are read; needs {MOST_CELLS:,} at most")


Row = tuple[str, Sequence[float], float, float]
"""A message: its topic, the numbers asked for, when it was recorded, and its own stamp [s], NaN where it has none."""


def topic_recording(
    source: str,
    form: str,
    fields: Mapping[str, tuple[str, Any]],
    remarks: Sequence[str],
    messages: Callable[[Mapping[str, Sequence[Any]]], Iterator[Row]],
) -> Recording:
    """A recording of topics of messages, all fields of one topic on one clock: the stamps of its messages, or the times
    of recording where one has no stamp or does not set it.

    `fields`: the topic and the path within its messages, by channel. `messages` reads, given by topic the paths that
    are asked for.
    """
    if len(fields) > MOST_COLUMNS:
        remarks = [*remarks, f"only the first {MOST_COLUMNS:,} fields are listed"]
        fields = dict(list(fields.items())[:MOST_COLUMNS])

    def load(names: tuple[str, ...]) -> dict[str, Channel]:
        asked: dict[str, list[str]] = {}
        for name in names:
            asked.setdefault(fields[name][0], []).append(name)
        columns = {topic: [array("d") for _ in range(len(own) + 2)] for topic, own in asked.items()}
        for topic, numbers, logged, stamp in messages(
            {t: [fields[name][1] for name in own] for t, own in asked.items()}
        ):
            for column, number in zip(columns[topic], (*numbers, logged, stamp), strict=True):
                column.append(number)
        found = {}
        for topic, own in asked.items():
            *values, logged, stamps = (np.array(column, dtype=np.float64) for column in columns[topic])
            time = stamps if len(stamps) and (stamps > 0).all() else logged
            found |= {name: Channel(name, time, x) for name, x in zip(own, values, strict=True)}
        return found

    return Recording(source, form, fields, {}, remarks, load)
