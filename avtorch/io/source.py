"""What a user may give for a log: a `Log`, a path, or a data frame. It is decided here, for every function alike."""

from __future__ import annotations

import os
from collections.abc import Sequence

from avtorch.errors import InputError
from avtorch.io.dataframe import DataFrame, is_dataframe
from avtorch.io.log import Log
from avtorch.io.mapping import Pairs

LogSource = Log | str | os.PathLike[str] | DataFrame
"""A log, a path to one, or a data frame with its columns."""


def as_log(
    given: LogSource, *, map: Pairs = None, unit: Pairs = None, following: bool = False, argument: str = "log"
) -> Log:
    """The log that `given` is, or that is read from it; `map` and `unit` as in `Log.read`, for what is read here.

    `argument`: its name in messages. Raises `InputError` for anything else, and for what `Log.read` and
    `Log.from_dataframe` refuse.
    """
    if isinstance(given, Log):
        for name, pairs in (("map", map), ("unit", unit)):
            if pairs:
                raise InputError(f"{name}: found beside a Log, which has been read; give it to Log.read or from_arrays")
        return given
    if isinstance(given, (str, os.PathLike)):
        return Log.read(given, map=map, unit=unit, following=following)
    if is_dataframe(given):
        return Log.from_dataframe(given, map=map, unit=unit, following=following)
    kind = type(given).__name__
    hint = "; columns by name make one with Log.from_arrays(**columns)" if isinstance(given, dict) else ""
    if isinstance(given, (list, tuple)):
        hint = "; one log at a time"
    raise InputError(f"{argument}: found a {kind}, needs a Log, a path or a DataFrame{hint}")


def as_logs(
    given: LogSource | Sequence[LogSource], *, map: Pairs = None, unit: Pairs = None, argument: str = "logs"
) -> list[Log]:
    """One log or several, each as `as_log` takes it, all with the same `map` and `unit`."""
    if isinstance(given, (Log, str, os.PathLike)) or is_dataframe(given):
        return [as_log(given, map=map, unit=unit, argument=argument)]  # pyright: ignore[reportArgumentType]
    if isinstance(given, dict) or not hasattr(given, "__iter__"):
        return [as_log(given, map=map, unit=unit, argument=argument)]  # pyright: ignore[reportArgumentType]
    # a log that has been read has its names and units; the others take those given
    return [
        as_log(one, argument=argument) if isinstance(one, Log) else as_log(one, map=map, unit=unit, argument=argument)
        for one in given  # pyright: ignore[reportGeneralTypeIssues]
    ]
