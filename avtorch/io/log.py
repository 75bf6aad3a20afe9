"""The drive log: one row per sample, SI units, checked when it is made; and what a user may give for one."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError, quoted
from avtorch.io.answers import atomic
from avtorch.io.assemble import Arrivals, assemble, merged
from avtorch.io.clock import median_step, since_start, stretches
from avtorch.io.engagement import settled_rows
from avtorch.io.formats import is_recording, open_recording
from avtorch.io.mapping import PEDALS, SIGNALS, Pairs, SignalMap, given_mapping, pairs, read_mapping
from avtorch.io.opening import place
from avtorch.io.tables import DataFrame, Table, frame_table, is_dataframe, read_table
from avtorch.io.units import SI
from avtorch.io.validity import check_units

if TYPE_CHECKING:
    import pandas

STANDSTILL_SHARE = 0.1
"""Of its own top speed [-], below which what never goes fast stands (`Log.standstill_mps`)."""
STANDSTILL_MPS = 0.3
"""Below this speed [m/s] GLVD does not hold; such rows are masked. What never goes ten times as fast, a small robot,
stands below a tenth of its own top speed (`Log.standstill_mps`).
"""

AccelKind = Literal["kinematic", "specific-force"]


@dataclass(frozen=True, eq=False, repr=False)
class Log(Displayed):
    """A drive. Every signal is ``(time,)``, float64, in SI units, or None where the log does not have it.

    ``time`` [s], on the recorder's own clock (``elapsed``: from the log's start); ``accel_cmd`` [m/s^2], the command
    sent, held until the next row (None in a car-following log, and in one whose command is no acceleration);
    ``accel`` [m/s^2] and ``speed`` [m/s], at least one of them; ``jerk`` [m/s^3]; ``engaged`` (bool, all true where the
    log has no such column); ``spacing`` [m, bumper to bumper]; ``lead_speed`` [m/s]; ``lead_accel`` [m/s^2]; ``grade``
    [-]; commands that are no accelerations: ``throttle`` [-, share of the pedal's way], ``brake`` [-, or Pa],
    ``torque`` [Nm], ``current`` [A] (`avtorch.pedals` makes ``accel_cmd`` of them), ``speed_cmd`` [m/s]; ``segment``
    (int from 0; rises at each gap and each new value of the log's own column, where time may start anew). ``name`` of
    the source; ``ignored``: its further columns; ``remarks``: what merging left out. ``accel_kind``
    is not in a file: ``accel`` is dv/dt, as on a vehicle bus, or what an accelerometer fixed to the car reads along it,
    dv/dt plus gravity's share on a slope; ``dataclasses.replace`` sets it.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> time = np.arange(0.0, 20.0, 0.05)
        >>> log = Log.from_arrays(time=time, accel_cmd=np.sin(time), speed=72 - 3.6 * np.cos(time), unit="speed=km/h")
        >>> log.rows, round(log.rate_hz, 3), round(float(log.speed.mean()), 1)  # in m/s
        (400, 20.0, 20.0)
    """

    time: FloatArray
    accel_cmd: FloatArray | None
    accel: FloatArray | None
    speed: FloatArray | None
    jerk: FloatArray | None
    engaged: BoolArray
    spacing: FloatArray | None
    lead_speed: FloatArray | None
    lead_accel: FloatArray | None
    grade: FloatArray | None
    segment: IntArray
    name: str = "log"
    ignored: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    accel_kind: AccelKind = "kinematic"
    throttle: FloatArray | None = None
    brake: FloatArray | None = None
    torque: FloatArray | None = None
    current: FloatArray | None = None
    speed_cmd: FloatArray | None = None

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        map: Pairs = None,
        unit: Pairs = None,
        stamp: Pairs = None,
        state: Pairs = None,
        following: bool = False,
    ) -> Log:
        """Read a log: a table of text in any usual layout, gzipped or not, Parquet, or a recording.

        Recordings are MDF, ROS bags and MCAP, Apollo records, CAN logs with a DBC, MAT and Excel, each by an extra
        (`avtorch.io.formats`); their channels are held on the clock of the fastest of command, acceleration and speed.
        ``map`` names the columns (``{"accel": "CAN.ACC_X"}`` or ``["accel=CAN.ACC_X"]``), ``unit`` their units
        (``speed=km/h``), ``stamp`` the signals' own time columns (``speed=GPS_TIME``); the TOML file beside the log may
        give the same, and more (`avtorch.io.mapping.read_mapping`). A stamped signal is held, not interpolated; naming
        the log's own time column as its stamp declares that it is written only in the rows where it arrived.
        ``state`` lists the numbers of ``engaged`` that mean yes (``engaged=1,3``). A row with a bad cell is left out
        and told in ``remarks``, unless more than a twentieth of the rows have one.
        ``following`` lets a car-following log (``spacing`` and ``lead_speed``) come without ``accel_cmd``.

        Raises InputError, one line that names file, row (of data, from 1) and line (of the file) and column.
        """
        mapping = read_mapping(path, map=map, unit=unit, stamp=stamp, state=state)
        if is_recording(path):
            if mapping.column_of("time") != "time":
                named = quoted(mapping.column["time"])
                raise InputError(
                    f"{place(path)}: time is mapped to {named}; channels of a recording have clocks of their own"
                )
            columns = {signal: mapping.column_of(signal) for signal in SIGNALS if signal != "time"}
            recorded, arrived = merged(open_recording(path, columns.values()), columns)
            return cls._of(recorded, mapping, following=following, arrived=arrived)
        wanted = {mapping.column_of(signal) for signal in SIGNALS} | set(mapping.stamp.values())
        table = read_table(path, wanted=wanted)
        return cls._of(table, mapping, following=following)

    @classmethod
    def from_arrays(cls, *, name: str = "arrays", unit: Pairs = None, following: bool = False, **columns: Any) -> Log:
        """A log from arrays ``(time,)`` by signal name, checked as a file is; None: a signal that is not there."""
        given = {}
        for key, values in columns.items():
            if key not in SIGNALS:
                raise InputError(f"{name}: {key!r} is no signal; signals: {', '.join(SIGNALS)}")
            if values is None:
                continue
            try:
                array = np.asarray(values.filled(np.nan) if isinstance(values, np.ma.MaskedArray) else values)
            except (TypeError, ValueError, RuntimeError):
                raise InputError(
                    f"{name}: {key} is no array of numbers; one value per row, (time,), is needed"
                ) from None
            if array.ndim != 1:
                raise InputError(f"{name}: {key} has shape {array.shape}; one value per row, (time,), is needed")
            given[key] = array if array.dtype.kind in "fiu" else array.tolist()
        lengths = {key: len(values) for key, values in given.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"{name}: signals differ in length: {', '.join(f'{k} {n}' for k, n in lengths.items())}")
        table = Table(name, tuple(given), tuple(given.values()))
        return cls._of(table, SignalMap(unit=pairs("unit", unit)), following=following)

    @classmethod
    def from_dataframe(
        cls,
        frame: DataFrame,
        *,
        name: str = "DataFrame",
        map: Pairs = None,
        unit: Pairs = None,
        stamp: Pairs = None,
        state: Pairs = None,
        following: bool = False,
    ) -> Log:
        """A log from a data frame of pandas, Polars, pyarrow or DuckDB, checked as a file is; options as in `read`.

        A named index is a column; an index of times without a name is ``time`` (`avtorch.io.tables`).
        """
        mapping = given_mapping(SignalMap(), map=map, unit=unit, stamp=stamp, state=state)
        return cls._of(frame_table(frame, name), mapping, following=following)

    @classmethod
    def _of(cls, table: Table, mapping: SignalMap, *, following: bool, arrived: Arrivals | None = None) -> Log:
        log = cls(**assemble(table, mapping, following=following, arrived=arrived))
        motion = {name: getattr(log, name) for name in ("accel_cmd", "accel", "speed", "lead_speed")}
        check_units(log.name, log.elapsed, stretches(log.usable, log.segment), **motion)
        return log

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the log as Parquet (``.parquet``, ``.pq``) or CSV; reading it gives the same log bit for bit."""
        columns: dict[str, NDArray] = {}
        for name in SIGNALS:
            values = getattr(self, name)
            # values that reading restores by default are left out
            if values is None or (name == "engaged" and values.all()) or (name == "segment" and not values.any()):
                continue
            columns[name] = values.astype(np.int64) if name == "engaged" else values
        if Path(path).suffix.lower() in (".parquet", ".pq"):
            import pyarrow as pa
            import pyarrow.parquet as pq

            buffer = io.BytesIO()
            pq.write_table(pa.table(columns), buffer)
            with atomic(path, binary=True) as stream:
                stream.write(buffer.getvalue())
            return
        cells = [map(repr, values.tolist()) for values in columns.values()]
        with atomic(path) as stream:
            stream.write(",".join(columns) + "\n")
            stream.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))

    def overview(self) -> Card:
        """Rows, seconds, rate, usable share, and the range of every signal."""
        parts = len(self.segments())
        title = f"Log {self.name}: {self.rows} rows, {self.seconds:.4g} s at {self.rate_hz:.4g} Hz"
        lines = [f"{100 * float(self.usable.mean()):.0f} % of the rows usable", *self.remarks[:2]]
        if self.ignored:
            lines.append(f"Columns not used: {', '.join(self.ignored[:6])}{' and more' if self.ignored[6:] else ''}")
        signals = {name: getattr(self, name) for name in SI if name != "time" and getattr(self, name) is not None}
        table = Frame(
            {
                "signal": list(signals),
                "unit": [SI[name] for name in signals],
                **{how: [float(getattr(x, how)()) for x in signals.values()] for how in ("min", "mean", "max")},
            }
        )
        return Card(f"{title}, {parts} segment{'' if parts == 1 else 's'}", tuple(lines), table, most=len(SI))

    def to_dataframe(self) -> pandas.DataFrame:
        """A row a sample, a column a signal, in SI units. Needs ``pip install 'avtorch[pandas]'``."""
        columns = {name: getattr(self, name) for name in SIGNALS if getattr(self, name) is not None}
        return Frame(columns).to_dataframe()

    @property
    def rows(self) -> int:
        return len(self.time)

    @property
    def epoch_s(self) -> float:
        """The first row's ``time`` [s]: what ``elapsed`` is counted from."""
        return float(self.time[0])

    @cached_property
    def elapsed(self) -> FloatArray:
        """Seconds from the log's start, ``(time,)``: what every computation uses, free of what rounding does to stamps
        as large as Unix time (`avtorch.io.clock`)."""
        return since_start(self.time, self.segment)

    @property
    def pedals(self) -> tuple[str, ...]:
        """Those of ``throttle``, ``brake``, ``torque`` and ``current`` that the log has."""
        return tuple(name for name in PEDALS if getattr(self, name) is not None)

    @property
    def seconds(self) -> float:
        """Time recorded, gaps left out [s]."""
        return float(sum(self.elapsed[part][-1] - self.elapsed[part][0] for part in self.segments()))

    @property
    def rate_hz(self) -> float:
        """Rows per second, by the median step inside segments."""
        return 1 / median_step(self.elapsed, np.diff(self.segment) == 0)

    @cached_property
    def standstill_mps(self) -> float:
        """The speed [m/s] below which it stands: `STANDSTILL_MPS`, and at most a tenth of its top speed."""
        if self.speed is None:
            return STANDSTILL_MPS
        return min(STANDSTILL_MPS, STANDSTILL_SHARE * float(np.quantile(np.abs(self.speed), 0.99)))

    @cached_property
    def moving(self) -> BoolArray:
        """Rows not at standstill, ``(time,)``; without speed, detected from the response to the brake
        (``standing``)."""
        if self.speed is not None:
            return (self.speed >= self.standstill_mps) & (self.speed > 0)
        moving = np.ones(self.rows, bool)
        if self.accel is None or self.accel_cmd is None:  # pedals alone do not tell a car at rest from one at speed
            return moving
        # imported here: most logs have speed, and scipy.ndimage takes a quarter of a second
        from avtorch.io.standstill import standing

        for part in self.engaged_segments():
            if part.stop - part.start > 1:
                step = float(np.median(np.diff(self.elapsed[part])))
                moving[part] = ~standing(self.accel_cmd[part], self.accel[part], step, STANDSTILL_MPS)
        return moving

    @property
    def usable(self) -> BoolArray:
        """Rows that estimation may use, ``(time,)``: engaged, settled since the driver let go, and not at
        standstill."""
        return self.engaged & self.settled & self.moving

    @cached_property
    def settled(self) -> BoolArray:
        """Rows ``(time,)`` late enough after a return to ``engaged`` for the car's state to be known."""
        out = np.ones(self.rows, bool)
        if self.engaged.all():
            return out
        for part in self.segments():
            # a drive after one that ended under the driver begins with a return
            driven = part.start > 0 and not self.engaged[part.start - 1]
            since = self.elapsed[part.start] if driven else -np.inf
            out[part] = settled_rows(self.elapsed[part], self.engaged[part], since)[0]
        return out

    def segments(self) -> list[slice]:
        """Segments recorded without a break, as slices of rows; between two lies a gap or a new value of
        ``segment``."""
        cuts = np.flatnonzero(np.diff(self.segment)) + 1
        edges = [0, *cuts.tolist(), self.rows]
        return [slice(a, b) for a, b in pairwise(edges)]

    def engaged_segments(self) -> list[slice]:
        """The parts of segments in which the command was obeyed, as slices of rows; each return to ``engaged`` begins
        one. Nothing may be rolled out, filtered or differenced from one into the next.
        """
        return stretches(self.engaged, self.segment)

    def __getitem__(self, part: slice) -> Log:
        """The rows of a slice, as a log that keeps its segment numbers."""
        cut = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{k: v[part] for k, v in cut.items() if isinstance(v, np.ndarray)})


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
    raise InputError(f"{argument}: found a {type(given).__name__}, needs a Log, a path or a DataFrame")


def as_logs(
    given: LogSource | Sequence[LogSource], *, map: Pairs = None, unit: Pairs = None, argument: str = "logs"
) -> list[Log]:
    """One log or several, each as `as_log` takes it, all with the same `map` and `unit`."""
    one = isinstance(given, (Log, str, os.PathLike, dict)) or is_dataframe(given) or not hasattr(given, "__iter__")
    if one:
        return [as_log(given, map=map, unit=unit, argument=argument)]  # pyright: ignore[reportArgumentType]
    # a log that has been read has its names and units; the others take those given
    return [
        as_log(log, argument=argument) if isinstance(log, Log) else as_log(log, map=map, unit=unit, argument=argument)
        for log in given  # pyright: ignore[reportGeneralTypeIssues]
    ]


def no_command(log: Log, need: str) -> InputError:
    """The error; `need`: what needs the command, such as ``which the diagnosis needs``."""
    words = f"{log.name}: has no accel_cmd{need}"
    others = log.pedals or (("speed_cmd",) if log.speed_cmd is not None else ())
    if others:
        words += f"; avtorch.pedals.fit_pedals makes one of its {' and '.join(others)}"
    return InputError(words)
