"""DBC databases: which ones decode a log, and the signals of their messages."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avtorch.errors import InputError, listed
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import guarded, library
from avtorch.io.opening import place, read_regular

_MOST = 2**24  # bytes of a DBC
_NEED = "a DBC database"


@dataclass(frozen=True)
class Decoded:
    """One message of a database, with the channels of its signals by the signals' names."""

    message: Any
    channels: dict[str, str]


def databases_of(log: Path, named: Sequence[str | os.PathLike[str]] | None, source: str) -> list[Path]:
    """The databases that decode `log`: those `named`; else the one beside it of its name; else the folder's only one.

    Raises InputError where there is none, or more than one and none of the log's name.
    """
    if named is not None:
        if isinstance(named, (str, os.PathLike)):
            raise InputError(f"dbc: found {place(named)}; a list of paths is needed")
        if not named:
            raise InputError(f"{source}: dbc names no database; one is needed")
        return [Path(path) for path in named]
    found = sorted(path for path in log.parent.iterdir() if path.suffix.lower() == ".dbc" and path.is_file())
    own = [path for path in found if path.stem == log.stem]
    if own:
        return own[:1]
    if len(found) == 1:
        return found
    what = f"its folder holds {len(found)}: {listed(path.name for path in found)}" if found else "found none beside it"
    raise InputError(
        f"{source}: is a CAN log, which a DBC database decodes; {what}; "
        f"name one by dbc, or {log.stem}.dbc beside the log"
    )


def messages_of(
    databases: Sequence[Path], source: str, kind: Kind
) -> tuple[dict[tuple[int, bool], list[Decoded]], dict[str, str]]:
    """Messages by identifier and whether that is an extended one, and the units of their channels.

    A channel is ``Message.Signal``; where another message has that name already, the database's name comes first.
    Raises InputError.
    """
    cantools = library("cantools.database", source, kind)
    messages: dict[tuple[int, bool], list[Decoded]] = {}
    units: dict[str, str] = {}
    taken: set[str] = set()
    for path in databases:
        text = read_regular(path, most=_MOST, need=_NEED).decode("cp1252", errors="replace")
        with guarded(place(path), _NEED):
            database = cantools.load_string(text, database_format="dbc", strict=False)
            for message in database.messages:
                if message.is_container:
                    continue
                prefix = f"{message.name}."
                if any(prefix + signal.name in taken for signal in message.signals):
                    prefix = f"{path.stem}.{message.name}."
                if any(prefix + signal.name in taken for signal in message.signals):
                    prefix = f"{path.stem}.{message.name}.{message.frame_id:X}."
                channels = {signal.name: prefix + signal.name for signal in message.signals}
                taken |= set(channels.values())
                units |= {channels[signal.name]: signal.unit for signal in message.signals if signal.unit}
                key = (message.frame_id, bool(message.is_extended_frame))
                messages.setdefault(key, []).append(Decoded(message, channels))
    if not messages:
        raise InputError(f"{listed(place(path) for path in databases)}: defines no message; {_NEED} is needed")
    return messages, units
