"""`avtorch diagnose --estimates`: the alarms in answers of `avtorch estimate`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from avtorch.errors import InputError, quoted
from avtorch.gap.result.traces import Alarm
from avtorch.io import Log
from avtorch.io.opening import place, read_regular

_MOST_BYTES = 1 << 28
_NEED = "estimates.json, the answer of `avtorch estimate`"


def read_alarms(paths: Sequence[Path], logs: Sequence[Log]) -> tuple[Alarm, ...]:
    """The alarms in answers of `avtorch estimate`, one for each of the `logs` in their order.

    An alarm that goes on over many windows is one. Raises `InputError` for another number of files, one that is no such
    answer, or one on another log.
    """
    if len(paths) != len(logs):
        raise InputError(f"--estimates: found {len(paths)} for {len(logs)} logs, needs one for each, in their order")
    return tuple(
        alarm
        for number, (path, log) in enumerate(zip(paths, logs, strict=True))
        for alarm in _alarms(_answer(path), path, log, number)
    )


def _answer(path: Path) -> Mapping[str, Any]:
    try:
        found = json.loads(read_regular(path, most=_MOST_BYTES, need=_NEED).decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as fault:
        raise InputError(f"{place(path)}: is no JSON, needs {_NEED}") from fault
    schema = found.get("schema") if isinstance(found, dict) else None
    if schema != "avtorch.estimates/1":
        raise InputError(f"{place(path)}: found {quoted(str(schema))} as its schema, needs {_NEED}")
    return found


def _alarms(answer: Mapping[str, Any], path: Path, log: Log, number: int) -> list[Alarm]:
    try:
        rows, epoch = int(answer["quality"]["rows"]), float(answer["epoch_s"])
        windows = [(float(w["end_s"]), frozenset(map(str, w["alerts"]))) for w in answer["windows"]]
    except (KeyError, TypeError, ValueError) as fault:
        raise InputError(f"{place(path)}: is damaged, needs {_NEED}") from fault
    if rows != log.rows or abs(epoch - log.epoch_s) > 1e-3:
        raise InputError(
            f"{place(path)}: is of a log of {rows} rows that begins at {epoch:.10g} s, needs the estimates of "
            f"{log.name}, {log.rows} rows from {log.epoch_s:.10g} s"
        )
    ended: tuple[float, frozenset[str]] = (0.0, frozenset())
    return [
        Alarm(end - epoch, detector, number)
        for (_, before), (end, now) in pairwise([ended, *windows])
        for detector in sorted(now - before)
    ]
