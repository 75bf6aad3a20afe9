"""The instrumented car on I-24 (DOI 10.5281/zenodo.6366761): speed in km/h, no leader where the gap is 252 m."""

from __future__ import annotations

import numpy as np

from avtorch.io.consistency import scale_between
from avtorch.io.raw_leader import RawLeader, checked_leader
from avtorch.io.tables import Table

NO_LEADER_M = 252.0


def read(table: Table) -> RawLeader:
    """The instrumented car itself, as a leader for others.

    Its ``Acceleration`` is passed on as recorded; where its scale differs from the derivative of the speed, the note
    gives the ratio.
    """
    columns = {"time": "Time", "speed": "Velocity"}
    time, speed = table.numbers("Time"), table.numbers("Velocity", empty_is_nan=True) / 3.6
    accel = spacing = None
    note = ""
    if "Acceleration" in table.names:
        columns["accel"] = "Acceleration"
        accel = table.numbers("Acceleration", empty_is_nan=True)
        whole = ~np.isnan(speed) & ~np.isnan(accel)
        found = scale_between(time, [slice(None)], speed, accel) if whole.all() else None
        if found is not None and found.correlation > 0.9 and not 0.8 < found.slope < 1.25:
            note = f"recorded acceleration is {1 / found.slope:.2f} times the derivative of the speed"
    if "SpaceGap" in table.names:
        gap = table.numbers("SpaceGap", empty_is_nan=True)
        spacing = np.where(gap >= NO_LEADER_M, np.nan, gap)
    return checked_leader(table, time, speed, accel, spacing, columns=columns, note=note)
