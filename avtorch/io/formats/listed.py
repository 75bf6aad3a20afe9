"""A recording of many signals, each on a clock of its own: what the readers of all formats answer and share.

A signal is listed before it is read, so that a file of thousands of signals costs no more than the few that are used.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Mapping, Sequence
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


class Piece:
    """What is read of one topic: a column for each field, the times of recording, and the stamps [s]."""

    def __init__(self, columns: int) -> None:
        self.columns = [array("d") for _ in range(columns)]
        self.logged, self.stamped = array("d"), array("d")

    def take(self, row: Sequence[float], logged: float, stamp: float | None) -> None:
        """One message: its fields, when it was recorded, and the stamp where its type has one."""
        for column, value in zip(self.columns, row, strict=True):
            column.append(value)
        self.logged.append(logged)
        if stamp is not None:
            self.stamped.append(stamp)

    def time(self) -> FloatArray:
        """The stamps, or the times of recording where a message has none or does not set it."""
        stamped = np.array(self.stamped, dtype=np.float64)
        return stamped if len(stamped) and (stamped > 0).all() else np.array(self.logged, dtype=np.float64)


def topic_recording(
    source: str,
    form: str,
    fields: Mapping[str, tuple[str, Any]],
    remarks: Sequence[str],
    collect: Callable[[Mapping[str, Sequence[Any]], Mapping[str, Piece]], None],
) -> Recording:
    """A recording of topics of messages, all fields of one topic on one clock.

    `fields`: the topic and the path within its messages, by channel. `collect` puts the messages of topics into their
    pieces, given the paths that are asked for by topic.
    """
    if len(fields) > MOST_COLUMNS:
        remarks = [*remarks, f"only the first {MOST_COLUMNS:,} fields are listed"]
        fields = dict(list(fields.items())[:MOST_COLUMNS])

    def load(names: tuple[str, ...]) -> dict[str, Channel]:
        asked: dict[str, list[str]] = {}
        for name in names:
            asked.setdefault(fields[name][0], []).append(name)
        pieces = {topic: Piece(len(own)) for topic, own in asked.items()}
        collect({topic: [fields[name][1] for name in own] for topic, own in asked.items()}, pieces)
        found = {}
        for topic, piece in pieces.items():
            time = piece.time()
            for name, column in zip(asked[topic], piece.columns, strict=True):
                found[name] = Channel(name, time, np.array(column, dtype=np.float64))
        return found

    return Recording(source, form, fields, {}, remarks, load)
