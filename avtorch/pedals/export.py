"""A map of pedals as files: whole, and as the tables of acceleration that vehicle interfaces take.

- `pedal_map.csv`: everything, a row a knot.
- `accel_map.csv` and `brake_map.csv`, in the layout of Autoware's `raw_vehicle_cmd_converter`: speeds [m/s] in the
  first row behind `default`, pedals from 0 to 1 in the first column, accelerations [m/s²].

CARLA's cars are an engine's torque curve, gears and tyres, and read no table; in the terms of their pedals
`avtorch.remedy.to_carla` has both of these in one file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io import atomic
from avtorch.pedals.pedal_map import PedalMap, PedalTable, unit_of

MAP_FILE, ACCEL_FILE, BRAKE_FILE = "pedal_map.csv", "accel_map.csv", "brake_map.csv"
_LAST_DIGIT = 0.001  # of an acceleration in a table, m/s²
_DRIVING = ("throttle", "torque", "current")


@dataclass(frozen=True, eq=False)
class MapTable:
    """A table for another tool: `accel` (pedal, speed) [m/s²] at pedals (pedal,) from 0 to 1 and speeds (speed,) [m/s];
    what of the map it does not hold, a few words each (`lost`).

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable, brake_table
        >>> brake = PedalTable(np.array([0.0, 4e6]), np.array([[0, 0], [-6.0, -7.0]]))
        >>> for words in brake_table(PedalMap(np.array([0.0, 30.0]), np.zeros(2), {"brake": brake})).lost:
        ...     print(words)
        lag 0.3 s and dead time 0 s
        the unit of brake: a pedal of 1 is 4e+06 Pa
    """

    pedal: FloatArray
    speed: FloatArray
    accel: FloatArray
    lost: tuple[str, ...]

    @property
    def text(self) -> str:
        """The table in Autoware's layout."""
        lines = ["default," + ",".join(f"{v:.2f}" for v in self.speed)]
        lines += [
            f"{x:.6g}," + ",".join(f"{a:.3f}" for a in row) for x, row in zip(self.pedal, self.accel, strict=True)
        ]
        return "\n".join(lines) + "\n"


def accel_table(made: PedalMap) -> MapTable | None:
    """The table of the pedal that drives, in Autoware's layout; None where none does.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable, accel_table
        >>> throttle = PedalTable(np.array([0.0, 0.1, 1.0]), np.array([[0, 0], [0, 0], [4.0, 2.0]]))
        >>> table = accel_table(PedalMap(np.array([0.0, 30.0]), np.array([0.0, -0.6]), {"throttle": throttle}))
        >>> print(table.text, end="")
        default,0.00,30.00
        0,0.000,-0.600
        0.1,0.001,-0.599
        1,4.000,1.400
    """
    return _table(made, [name for name in _DRIVING if name in made.pedals], 1.0)


def brake_table(made: PedalMap) -> MapTable | None:
    """The table of the brake in Autoware's layout, or of torque or current below zero; None where there is neither.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable, brake_table
        >>> current = PedalTable(np.array([-2.0, 0.0, 8.0]), np.array([[-1.0, -1.5], [0, 0], [4.0, 3.0]]))
        >>> print(brake_table(PedalMap(np.array([0.0, 3.0]), np.zeros(2), {"current": current})).text, end="")
        default,0.00,3.00
        0,0.000,0.000
        1,-1.000,-1.500
    """
    return _table(made, [name for name in ("brake", "torque", "current") if name in made.pedals], -1.0)


def _table(made: PedalMap, names: Sequence[str], side: float) -> MapTable | None:
    for name in names:
        table = made.pedals[name]
        sign = 1.0 if name == "brake" else side
        rows = np.flatnonzero(sign * table.pedal >= 0)[:: int(sign)]
        if len(rows) < 2:
            continue
        values = np.abs(table.pedal[rows])
        is_share = unit_of(name, values[-1]) == "-"
        share = values if is_share else values / values[-1]
        lost = [f"lag {made.T_L:.3g} s and dead time {made.dead_time:.3g} s"]
        if made.driven is not None and not (made.driven[0] <= made.speed[0] and made.speed[-1] <= made.driven[1]):
            slowest, fastest = made.driven
            lost.append(f"that only {slowest:.3g} to {fastest:.3g} m/s were driven; beyond, it goes on along a line")
        if not is_share:
            unit = unit_of(name, values[-1])
            lost.append(f"the unit of {name}: a pedal of 1 is {values[-1]:.6g} {unit}")
        lost += [f"{other}, which adds to {name}" for other in names if other != name and side > 0]
        accel, flat = _strict(table.accel[rows] + made.coasting, side)
        if flat:
            lost.append(
                f"{flat} steps of {name} that change nothing: {_LAST_DIGIT} m/s² each, so that it can be inverted"
            )
        return MapTable(share, made.speed, accel, tuple(lost))
    return None


def _strict(accel: FloatArray, side: float) -> tuple[FloatArray, int]:
    """A table (pedal, speed) that rises (`side` 1) or falls (-1) from row to row by its last digit at least, and how
    many of its steps did not.

    Readers of such tables look up the pedal of an acceleration, and refuse one that two pedals give.
    """
    rise: FloatArray = np.round(side * accel / _LAST_DIGIT).astype(np.float64)
    steps = np.arange(len(rise))[:, None]
    # the least table above it whose rows are a digit apart
    strict = np.asarray(np.maximum.accumulate(rise - steps, axis=0) + steps, dtype=np.float64)
    flat = int((np.diff(rise, axis=0) < 1).sum())
    return (side * strict * _LAST_DIGIT if flat else accel), flat


def write_map(made: PedalMap, folder: str | PathLike[str]) -> list[Path]:
    """Write `pedal_map.csv`, and the tables for other tools that the map can fill; returns the files.

    Raises `InputError` where the folder cannot be written.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable, write_map
        >>> brake = PedalTable(np.array([0.0, 1.0]), np.array([[0, 0], [-6.0, -7.0]]))
        >>> made = PedalMap(np.array([0.0, 30.0]), np.array([0.0, -0.6]), {"brake": brake}, T_L=0.2)
        >>> [path.name for path in write_map(made, "out")]
        ['pedal_map.csv', 'brake_map.csv']
    """
    texts = {MAP_FILE: _text(made)}
    for name, table in ((ACCEL_FILE, accel_table(made)), (BRAKE_FILE, brake_table(made))):
        if table is not None:
            texts[name] = table.text
    out = Path(folder)
    for name, text in texts.items():
        with atomic(out / name) as stream:
            stream.write(text)
    return [out / name for name in texts]


def _text(made: PedalMap) -> str:
    units = ", ".join(f"{unit_of(name, np.abs(table.pedal).max())} ({name})" for name, table in made.pedals.items())
    words = "lag and delay [s] as value; speeds driven [m/s], lowest as value, highest as speed"
    lines = [
        f"# pedal by name, its value in {units}; speed [m/s]; accel and sd [m/s2]; {words}",
        "pedal,value,speed,accel,sd",
    ]
    sd = None if made.coasting_sd is None else made.coasting_sd[None]
    tables = {"coasting": PedalTable(np.zeros(1), made.coasting[None], sd), **made.pedals}
    for name, table in tables.items():
        sd = np.zeros_like(table.accel) if table.sd is None else table.sd
        for x, accels, errors in zip(table.pedal.tolist(), table.accel.tolist(), sd.tolist(), strict=True):
            for v, a, e in zip(made.speed.tolist(), accels, errors, strict=True):
                lines.append(f"{name},{x!r},{v!r},{a!r},{e!r}")
    more = {"lag": (made.T_L, 0.0), "delay": (made.dead_time, 0.0)}
    if made.driven is not None:
        more["driven"] = made.driven
    lines += [f"{name},{float(value):.9g},{speed:.9g},0,0" for name, (value, speed) in more.items()]
    return "\n".join(lines) + "\n"
