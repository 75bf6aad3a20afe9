"""The process in which a reader runs apart: opens one recording, then answers requests for its channels.

Arguments are the name of the format and the path. Each request is a line of JSON, the names; each answer is a line of
JSON, then the numbers: the clocks, then the values of the channels; of a Parquet file its columns as an Arrow stream.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterable
from typing import Any, BinaryIO

from avtorch.child_process import answer, answers_to, limit_memory
from avtorch.errors import InputError
from avtorch.io.formats import kinds
from avtorch.io.formats.listed import Recording

MOST_MEMORY = 4 * 2**30
"""Bytes of address space, where the system can limit it: 20 million cells of a workbook take about half."""


def main() -> None:
    """Serve one recording until the standard input ends."""
    limit_memory(MOST_MEMORY)
    out = answers_to()
    kind = kinds.named(sys.argv[1])
    try:
        reader = importlib.import_module(f"avtorch.io.formats.{kind.reader}")
        opened: Any = reader.open_file(sys.argv[2], kind)
    except InputError as fault:
        answer(out, {"error": str(fault)})
        return
    if kind is kinds.PARQUET:
        answer(out, {"names": opened.names})
    else:
        told = {"form": opened.form, "names": opened.names, "units": dict(opened.units), "remarks": opened.remarks}
        answer(out, told)
    serve(opened, sys.stdin.buffer, out)


def serve(opened: Any, requests: Iterable[bytes], out: BinaryIO) -> None:
    """Answer each of the requests."""
    for line in requests:
        try:
            if hasattr(opened, "stream"):
                raw = opened.stream(json.loads(line))
                answer(out, {"bytes": len(raw)})
                out.write(raw)
                out.flush()
            else:
                _channels(opened, json.loads(line), out)
        except InputError as fault:
            answer(out, {"error": str(fault)})


def _channels(recording: Recording, names: list[str], out: BinaryIO) -> None:
    channels = list(recording.read(names).values())
    clocks = {id(channel.time): channel.time for channel in channels}
    place = {key: k for k, key in enumerate(clocks)}
    told = {
        "clocks": [len(clock) for clock in clocks.values()],
        "channels": [(channel.name, place[id(channel.time)]) for channel in channels],
    }
    answer(out, told, [*clocks.values(), *(channel.values for channel in channels)])


if __name__ == "__main__":
    main()
