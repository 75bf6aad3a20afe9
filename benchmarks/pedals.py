"""Maps of pedals on recordings whose command is no acceleration, beside the static factor that is usual.

``AVTORCH_DATA=DIR python -m benchmarks.pedals [--only TEXT] [--budget]``

Prints a line a recording: errors of speed in rollouts over blocks held out, by the log's own nominal command, by one
constant factor a pedal, and by the map; the map's gain in squared error over both with its standard error; lag with
dead time. With ``--budget`` a line a recording of what `gap_budget` says of the nominal command, of the map's, and of
the map's where each block's command is by a map fitted without it.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

from avtorch.errors import InputError
from avtorch.gap import gap_budget
from avtorch.io import Log
from avtorch.pedals import PedalFit, crossed, fit_pedals, held_out

_AV21 = {"map": ["throttle=throttle_pct", "brake=brake_kPa"], "unit": ["throttle=%", "brake=kPa"]}
_ROBORACER = {"map": ["current=current_A"]}
RECORDINGS: dict[str, tuple[str, dict[str, list[str]]]] = {
    "AV-21": ("indy_av21/Putnam_park2023_run4_2.csv", _AV21),
    "roboracer, one mass": ("roboracer/Normal_1weight.csv", _ROBORACER),
    "roboracer, other mass": ("roboracer/single_mass.csv", _ROBORACER),
    "roboracer, tyres": ("roboracer/tire_set_1.csv", _ROBORACER),
    "roboracer, training": ("roboracer/ftg_stanley_total_training.csv", _ROBORACER),
    "roboracer, validation": ("roboracer/ftg_stanley_total_validation.csv", _ROBORACER),
    "dart, 10:02": ("dart/09_16_2024_10_02_28_onboard10Hz.csv", {}),
    "dart, 10:27": ("dart/09_16_2024_10_27_02_onboard10Hz.csv", {}),
    "dart, 10:02, motion capture": ("dart/09_16_2024_10_02_28_vicon50Hz.csv", {}),
    "dart, 10:27, motion capture": ("dart/09_16_2024_10_27_02_vicon50Hz.csv", {}),
    "volvo_truck": ("volvo_truck/052311_grade.csv", {"map": ["torque=engine_torque_cmd_Nm"]}),
    "volvo_truck, its reference speed": ("volvo_truck/052311_grade.csv", {"map": ["speed_cmd=ref_v"]}),
}
"""Recordings by name: the file, and how its pedals are read."""


def read(name: str, folder: Path) -> Log:
    """A recording, with its nominal command."""
    file, options = RECORDINGS[name]
    return Log.read(folder / file, **options)


def rollouts(name: str, log: Log, fit: PedalFit) -> str:
    """The line of a recording: how well speed is foretold."""
    score = held_out(log)
    cells = [name, f"{len(score.squares['map'])} of {score.horizon_s:g} s"]
    cells += [f"{score.rmse(model):.2f}" for model in ("nominal", "factor", "map")]
    for over in ("nominal", "factor"):
        gain, error = score.gain(over)
        cells.append(f"{gain:.3g} ± {error:.2g}")
    cells.append(f"{fit.map.T_L + fit.map.dead_time:.2f} ± {fit.late_sd:.2f}")
    return f"| {' | '.join(cells)} |"


def budgets(name: str, log: Log, fit: PedalFit) -> str:
    """The line of a recording: the budget of the gap, by each command."""
    cells = [name]
    for commanded in (log, fit.map.commanded(log), crossed(log)[0]):
        try:
            found = gap_budget(commanded)
        except InputError as fault:
            cells.append(str(fault))
            continue
        parts = [f"{p.name} {p.share.mean:.0%}" for p in found.parts if p.name in found.names]
        parts += [f"{p.name}, {p.share_of_noise:.0%} of the noise" for p in found.chance if p.name in found.names]
        K_L = found.baseline["K_L"]
        cells.append(f"{found.before:.2f} to {found.left:.2f}: {', '.join(parts) or found.verdict[0]}; K_L {K_L:.2f}")
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default="")
    parser.add_argument("--budget", action="store_true")
    given = parser.parse_args(arguments)
    folder = Path(os.environ["AVTORCH_DATA"])
    for name in RECORDINGS:
        if given.only in name:
            began, log = time.process_time(), read(name, folder)
            fit = fit_pedals(log)
            line = budgets(name, log, fit) if given.budget else rollouts(name, log, fit)
            print(line, f"{time.process_time() - began:.0f} s |", flush=True)


if __name__ == "__main__":
    main()
