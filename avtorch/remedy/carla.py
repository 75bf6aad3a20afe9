"""The map of a car's pedals in the terms of CARLA's `VehicleControl`: throttle and brake from 0 to 1.

CARLA's cars read no such table: what their pedals do comes from a torque curve, gears, mass, drag and tyres
(`VehiclePhysicsControl`), of which a log tells none by itself. So the table says what the real car does; a controller
that drives the model needs the same table of the model, as `avtorch` makes it from a drive in CARLA.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from avtorch.gap import GapPlant
from avtorch.pedals import MapTable, PedalMap, accel_table, brake_table
from avtorch.remedy.exported import Exported, delay_of, delays_of, gain_lost, not_exported

_NO_LAG = "VehicleControl has neither; what the model has comes from its physics"
_PHYSICS = "mass, drag_coefficient and torque_curve of VehiclePhysicsControl: a log of pedals does not tell them apart"


@dataclass(frozen=True)
class CarlaPedals(Exported):
    """`tables` by the name of a pedal in `VehicleControl`.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable
        >>> from avtorch.remedy import to_carla
        >>> brake = PedalTable(np.array([0.0, 1.0]), np.array([[0, 0], [-6.0, -7.0]]))
        >>> told = to_carla(PedalMap(np.array([0.0, 30.0]), np.array([0.0, -0.6]), {"brake": brake}))
        >>> print("".join(told.to_text().splitlines(keepends=True)[-4:]), end="")
        brake:
          speed: [0, 30]
          0: [0, -0.6]
          1: [-6, -7.6]
    """

    tables: Mapping[str, MapTable]

    def to_text(self) -> str:
        """YAML: for each pedal the acceleration [m/s²] by pedal (a line each) and speed [m/s], coasting included."""
        lines = []
        for name, table in self.tables.items():
            lines += [f"{name}:", f"  speed: {_numbers(table.speed.tolist())}"]
            rows = zip(table.pedal.tolist(), table.accel.tolist(), strict=True)
            lines += [f"  {pedal:.6g}: {_numbers(accels)}" for pedal, accels in rows]
        return super().to_text() + "\n".join(lines) + "\n"


def to_carla(pedals: PedalMap, plant: GapPlant | None = None) -> CarlaPedals:
    """The map `pedals` for throttle and brake; of the `plant`, which a diagnosis found behind them, only what is lost.

    Example:
        >>> import numpy as np
        >>> from avtorch.gap import plant
        >>> from avtorch.pedals import PedalMap, PedalTable
        >>> from avtorch.remedy import to_carla
        >>> throttle = PedalTable(np.array([0.0, 1.0]), np.array([[0, 0], [4.0, 2.0]]))
        >>> made = PedalMap(np.array([0.0, 30.0]), np.array([0.0, -0.6]), {"throttle": throttle})
        >>> told = to_carla(made, plant(baseline="dead_band=0.1"))
        >>> list(told.tables), [text.partition(":")[0] for text in told.lost]
        (['throttle'], ['lag 0.3 s and dead time 0 s', 'brake', 'physics', 'dead_band'])
    """
    given = {"throttle": accel_table(pedals), "brake": brake_table(pedals)}
    tables = {name: table for name, table in given.items() if table is not None}
    lag, late = (pedals.T_L, pedals.dead_time) if plant is None else (float(plant.T_L), delay_of(plant))
    lost = [f"lag {lag:.3g} s and dead time {late:.3g} s: {_NO_LAG}"]
    lost += [f"{name}: the log has none" for name, table in given.items() if table is None]
    lost += dict.fromkeys(text for table in tables.values() for text in table.lost[1:])  # the first is the lag again
    lost.append(f"physics: {_PHYSICS}")
    if plant is not None:
        lost += gain_lost(plant, "the tables hold K_L 1; multiply the accelerations")
        lost += not_exported(plant, delays_of(plant))
    return CarlaPedals("CARLA VehicleControl", {}, tuple(lost), tables)


def _numbers(values: list[float]) -> str:
    return "[" + ", ".join(f"{x:.4g}" for x in values) + "]"
