"""What bags and cyber records share: topics of messages, each message with fields, a stamp and a time of recording."""

from __future__ import annotations

from abc import abstractmethod
from array import array
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io.formats.listed import Listed, refuse_cells
from avtorch.io.recording import Channel


class Topic(Protocol):
    """A topic of a recording: at least how many messages it has."""

    @property
    def count(self) -> int: ...


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


class TopicRecording(Listed):
    """Channels are fields of topics, all of one topic on one clock. A format adds `_collect`.

    `fields`: the topic and the path within its messages, by channel.
    """

    def __init__(
        self,
        source: str,
        form: str,
        topics: Mapping[str, Topic],
        fields: Mapping[str, tuple[str, Any]],
        remarks: Collection[str],
    ) -> None:
        super().__init__(source, form, fields, {}, remarks)
        self._topics, self._fields = topics, fields

    def _read(self, names: tuple[str, ...]) -> dict[str, Channel]:
        asked: dict[str, list[str]] = {}
        for name in names:
            asked.setdefault(self._fields[name][0], []).append(name)
        refuse_cells(self.source, sum(self._topics[topic].count * len(own) for topic, own in asked.items()))
        paths = {topic: [self._fields[name][1] for name in own] for topic, own in asked.items()}
        found: dict[str, Channel] = {}
        for topic, piece in self._collect(paths).items():
            time = piece.time()
            for name, column in zip(asked[topic], piece.columns, strict=True):
                found[name] = Channel(name, time, np.array(column, dtype=np.float64))
        return {name: found[name] for name in names}

    @abstractmethod
    def _collect(self, paths: Mapping[str, Sequence[Any]]) -> Mapping[str, Piece]:
        """The fields at `paths` by topic, in one pass over the messages."""
