"""The process in which a reader runs apart: it opens one recording, and answers what it has and what is asked for.

Arguments are the name of the format and the path; the standard input is JSON: names, what they match, or null for all.
The answer is a line of JSON, then the numbers: the clocks, then the values of the channels; of a Parquet file its
columns as an Arrow stream.
"""

from __future__ import annotations

import importlib
import json
import re
import sys
from typing import Any

import numpy as np

from avtorch.child_process import answer, answers_to, limit_memory
from avtorch.errors import InputError
from avtorch.io.formats import kinds

MOST_MEMORY = 4 * 2**30
"""Bytes of address space, where the system can limit it: 20 million cells of a workbook take about half."""


def main() -> None:
    """Answer one request."""
    limit_memory(MOST_MEMORY)
    out = answers_to()
    kind = kinds.named(sys.argv[1])
    try:
        reader = importlib.import_module(f"avtorch.io.formats.{kind.reader}")
        told, content = answered(reader.open_file(sys.argv[2], kind), json.load(sys.stdin))
    except InputError as fault:
        told, content = {"error": str(fault)}, b""
    answer(out, told | {"bytes": len(content)}, content)


def answered(opened: Any, wanted: list[str] | str | None) -> tuple[dict[str, Any], bytes]:
    """What an opened file has, and the bytes of what is `wanted` of it: of names, of what these match, or of all."""
    if isinstance(wanted, str):
        wanted = [name for name in opened.names if re.fullmatch(wanted, name)]
    there = list(opened.names if wanted is None else [name for name in wanted if name in opened.names])
    if hasattr(opened, "stream"):
        return {"names": opened.names}, opened.stream(there)
    channels = list(opened.read(there).values())
    clocks = {id(channel.time): channel.time for channel in channels}
    place = {key: k for k, key in enumerate(clocks)}
    told = {"form": opened.form, "names": opened.names, "units": dict(opened.units), "remarks": opened.remarks}
    told |= {"clocks": [len(clock) for clock in clocks.values()]}
    told |= {"channels": [(channel.name, place[id(channel.time)]) for channel in channels]}
    arrays = [*clocks.values(), *(channel.values for channel in channels)]
    return told, b"".join(np.ascontiguousarray(array, dtype=np.float64).tobytes() for array in arrays)


if __name__ == "__main__":
    main()
