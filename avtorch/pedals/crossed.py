"""Commands of a drive by maps that were fitted to the rest of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avtorch.io import Log, LogSource, as_logs
from avtorch.pedals.fit_map import fit_drive
from avtorch.pedals.pedal_drive import PedalDrive

FOLDS = 5


def crossed(logs: LogSource | Sequence[LogSource]) -> list[Log]:
    """The same drives with `accel_cmd` (row,), in each block of some ten seconds by the map of the other folds' blocks.

    What is scored on these commands, such as a budget of the gap, is then scored on a map that was held out. Raises
    `InputError` as `fit_pedals` does.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> from avtorch.pedals import crossed, fit_pedals
        >>> time = np.arange(0.0, 60.0, 0.05)
        >>> throttle = 0.3 + 0.2 * np.sin(0.5 * time)
        >>> speed = 15.0 + 1.2 * np.sin(0.5 * time - np.pi / 2)
        >>> log = Log.from_arrays(time=time, throttle=throttle, speed=speed)
        >>> bool(np.corrcoef(crossed(log)[0].accel_cmd, fit_pedals(log).map.commanded(log).accel_cmd)[0, 1] > 0.95)
        True
    """
    each = as_logs(logs)
    drive = PedalDrive.of(each)
    whole = fit_drive(drive, errors=False).map
    commands = [whole.commanded(log).accel_cmd for log in each]
    for fold in range(FOLDS):
        out = np.arange(drive.blocks) % FOLDS == fold
        if not out.any():
            continue
        made = fit_drive(drive, ~out, errors=False).map
        others = [made.commanded(log).accel_cmd for log in each]
        for piece in drive.pieces:
            time = each[piece.log].elapsed[piece.rows]
            cell = np.clip(((time - time[0]) / piece.dt).astype(int), 0, piece.cells - 1)
            block = piece.block[cell]
            rows = np.arange(piece.rows.start, piece.rows.stop)[(block >= 0) & out[block]]
            target, source = commands[piece.log], others[piece.log]
            assert target is not None
            assert source is not None
            target[rows] = source[rows]
    return [replace(log, accel_cmd=command) for log, command in zip(each, commands, strict=True)]
