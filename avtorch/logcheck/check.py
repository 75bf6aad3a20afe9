"""`avtorch.check`: what a log is, how to read it, what was seen in it, and what can be learnt from it."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.io.formats import is_recording, open_recording
from avtorch.io.leaders import read_following
from avtorch.io.log import Log, LogSource, as_log
from avtorch.io.mapping import Pairs, mapping_beside
from avtorch.io.opening import place
from avtorch.io.quality import Quality, require_usable
from avtorch.io.quality import check as check_quality
from avtorch.io.tables import DataFrame, frame_table, is_dataframe, read_table
from avtorch.logcheck.assignment import table_of
from avtorch.logcheck.proposal import Proposal, propose
from avtorch.logcheck.recorder import excitation_notes, recorder_notes


@dataclass(frozen=True, repr=False)
class LogCheck(Displayed):
    """A log's `source` and `form`; the `proposal` of how to read it (None: it was read as its mapping says, or was no
    file); the `log` and its `quality`, None where it cannot be read; the `fault` where it cannot be used; notes on the
    `recorder` and on the `excitation`. `follows`: the log is of cars that follow, without commands.

    Example:
        >>> import numpy as np
        >>> import avtorch
        >>> time = np.arange(0.0, 30.0, 0.05)
        >>> rows = zip(time, np.sin(time) / 9.80665, 72 - 3.6 * np.cos(time - 0.3))
        >>> lines = ["Zeit [s];AccReq;VehSpd_kph", *(";".join(f"{x:.5f}" for x in row) for row in rows)]
        >>> with open("drive.csv", "w") as file:
        ...     _ = file.write("\\n".join(lines).replace(".", ","))
        >>> found = avtorch.check("drive.csv")
        >>> found.proposal.map["accel_cmd"], found.proposal.unit
        ('AccReq', {'accel_cmd': 'g', 'speed': 'km/h'})
        >>> with open("drive.toml", "w") as file:
        ...     _ = file.write(found.proposal.toml("drive.csv"))
        >>> avtorch.Log.read("drive.csv").rows
        600
    """

    source: str
    form: str
    proposal: Proposal | None
    log: Log | None
    quality: Quality | None
    fault: str | None
    recorder: tuple[str, ...]
    excitation: tuple[str, ...]
    follows: bool = False

    def overview(self) -> Card:
        """Whether it can be read, the first notes, and the columns proposed."""
        what = "can be read" if self.fault is None else "cannot be read"
        notes = [self.fault] if self.fault is not None else []
        proposal = self.proposal
        rows = [
            {"signal": name, "column": one.column, "unit": one.unit, "reason": one.reason}
            for name, one in (proposal.signals if proposal is not None else {}).items()
        ]
        if proposal is not None:
            notes += proposal.doubts[:2]
        notes += self.notes[:4]
        rest = len(self.notes) - 4
        if rest > 0:
            notes.append(f"And {rest} more note{'' if rest == 1 else 's'} in .notes.")
        table = Frame.of_rows(rows) if rows else None
        return Card(f"Check of {self.source} ({self.form}): it {what}", tuple(notes), table, most=9)

    @property
    def notes(self) -> tuple[str, ...]:
        """All that was seen, in sentences."""
        return (*(self.quality.notes if self.quality is not None else ()), *self.recorder, *self.excitation)

    def to_dict(self) -> dict[str, Any]:
        """For a JSON answer, `avtorch.check/1`."""
        proposal = self.proposal
        return {
            "schema": "avtorch.check/1",
            "source": self.source,
            "form": self.form,
            "fault": self.fault,
            "follows": self.follows,
            "signals": {} if proposal is None else {name: asdict(one) for name, one in proposal.signals.items()},
            "doubts": [] if proposal is None else list(proposal.doubts),
            "mapping_needed": proposal is not None and proposal.needed,
            "quality": None if self.quality is None else self.quality.to_dict(),
            "recorder": list(self.recorder),
            "excitation": list(self.excitation),
        }


def check(log: LogSource, *, map: Pairs = None, unit: Pairs = None) -> LogCheck:
    """Check a log before anything is estimated from it.

    Of a file without a mapping beside it, and of a data frame, names and units of the columns are proposed, and it is
    read as proposed. A file with one is read as that says. `map` and `unit` name some of the columns; the others are
    proposed. Raises `InputError` for what is no table of text, no Parquet file and no recording of a known format.

    Example:
        >>> import avtorch
        >>> drive = avtorch.simulate(avtorch.Leader.default(start=30.0, duration=60.0, dt=0.05)).log()
        >>> found = avtorch.check(drive)
        >>> found.quality.rows == drive.rows, found.proposal
        (True, None)
    """
    if isinstance(log, Log):
        return _seen(log.name, "a log in memory", None, as_log(log, map=map, unit=unit))
    if is_dataframe(log):
        frame = frame_table(log)  # pyright: ignore[reportArgumentType]
        return _read(log, frame.form, propose(frame, map=map, unit=unit))
    if not isinstance(log, (str, os.PathLike)):
        return _seen("", "", None, as_log(log))
    table = table_of(open_recording(log)) if is_recording(log) else read_table(log)
    if mapping_beside(log) is not None:
        return _read(log, table.form, None, map, unit)
    return _read(log, table.form, propose(table, map=map, unit=unit))


def _read(
    given: str | os.PathLike[str] | DataFrame,
    form: str,
    proposal: Proposal | None,
    map: Pairs = None,
    unit: Pairs = None,
) -> LogCheck:
    path = given if isinstance(given, (str, os.PathLike)) else None
    source = "DataFrame" if path is None else place(Path(path))
    try:
        if proposal is None:
            read = as_log(given, map=map, unit=unit)
        else:
            leader = "accel_cmd" not in proposal.signals and {"spacing", "lead_speed"} <= set(proposal.signals)
            reader = Log.from_dataframe if path is None else Log.read
            read = reader(given, **proposal.options, following=leader)  # pyright: ignore[reportArgumentType]
    except InputError as fault:
        if path is not None and proposal is not None and "accel_cmd" not in proposal.signals:
            with suppress(InputError):  # a recording of cars that follow: the first of them
                return replace(_seen(source, form, None, read_following(path)), follows=True)
        clock = None if proposal is None or proposal.signals else f"{source}: {proposal.doubts[0]}"
        return LogCheck(source, form, proposal, None, None, clock or str(fault), (), ())
    return _seen(source, form, proposal, read)


def _seen(source: str, form: str, proposal: Proposal | None, log: Log) -> LogCheck:
    quality, fault = check_quality(log), None
    try:
        require_usable(log)
    except InputError as too_little:
        fault = str(too_little)
    return LogCheck(
        source, form, proposal, log, quality, fault, tuple(recorder_notes(log)), tuple(excitation_notes(log))
    )
