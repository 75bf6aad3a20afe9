"""Every car of a folder of recordings, as followers: time gap, lag with delay, string stability, gap and cause.

``AVTORCH_DATA=DIR python -m benchmarks.real_cars [--cause] [--slope] [--json FILE]``

Reads the OpenACC platoons in ``openacc_astazero`` and ``openacc_zalazone`` and prints a line a car. ``--cause`` also
diagnoses the test half of each drive. ``--slope`` prints how strongly the surveyed slope (AstaZero) acts on each
follower's speed, as the slope's coefficient in the identified loop: 1 for a car that does not compensate it.
``--only TEXT``: files with that in their path.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.errors import InputError
from avtorch.follower import FollowerDiagnosis, diagnose_follower
from avtorch.io import Log, read_following
from avtorch.io.leaders import numbered
from avtorch.io.tables import read_table
from avtorch.io.units import GRAVITY

LAP_M = 5757.9


def cars(folder: Path) -> list[tuple[Path, int]]:
    """Every follower of every platoon."""
    found = []
    for path in sorted(folder.glob("openacc_*/*.csv")):
        if path.stem == "Slope":
            continue
        names = read_table(path).names
        stem = "SpeedDoppler" if any(n.startswith("SpeedDoppler") for n in names) else "Speed"
        numbers = numbered(stem, names)
        gap = "Spacing{}" if stem == "SpeedDoppler" else "IVS{}"
        found += [
            (path, n)
            for n in numbers
            if n - 1 in numbers and gap.format(n if stem == "SpeedDoppler" else n - 1) in names
        ]
    return found


def row_of(found: FollowerDiagnosis, log: Log) -> dict[str, Any]:
    """The figures of one car."""
    own = found.loops[found.law.name]
    gap = found.diagnosis
    return {
        "car": log.name,
        "seconds": log.seconds,
        "law": found.law.name,
        **{name: found.parameters[name].to_dict() for name in ("headway_s", "lag_with_delay_s")},
        "p_string_stable": found.usual.p_string_stable,
        "peak_gain": None if found.usual.peak_gain is None else found.usual.peak_gain.to_dict(),
        "loop": own._asdict(),
        "loop_without_delay": found.loops["without_delay"]._asdict(),
        "keeps_speed": found.keeps_speed,
        "verdict": None if gap is None else gap.verdict.name,
        "probability": None if gap is None else gap.winner.probability,
        "closed": None
        if gap is None or gap.shrinkage is None or gap.shrinkage.top.closed is None
        else gap.shrinkage.top.closed.to_dict(),
    }


def slope_coefficient(found: FollowerDiagnosis, log: Log, grade: np.ndarray) -> tuple[float, float]:
    """Share of the surveyed ``grade`` (row,) [-] that the car's controller does not compensate: mean and sd.

    By regression of what the loop leaves of the speed on the response to the slope, under the loop's noise, with law
    and plant fixed.
    """
    pull = -GRAVITY * grade
    one = found.identified
    data = one.candidate.data
    steps = np.diff(log.time)
    gained = np.concatenate([[0.0], np.cumsum(0.5 * steps * (pull[1:] + pull[:-1]))])
    response = data.transform([data.speed_difference(gained[data.source])])
    image, left = ((x / np.sqrt(one.noise)).ravel() for x in (response, one.candidate.residual(one.z[None])))
    square = float(image @ image)
    return float(image @ left) / square, square**-0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cause", action="store_true")
    parser.add_argument("--slope", action="store_true")
    parser.add_argument("--only", default="")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    folder = Path(os.environ["AVTORCH_DATA"])
    rows = []
    for path, number in cars(folder):
        if given.only not in str(path):
            continue
        try:
            log = read_following(path, vehicle=number)
            found = diagnose_follower(log, cause=given.cause)
        except InputError as error:
            print(f"{path.stem}, vehicle {number}: {error}", flush=True)
            continue
        row = row_of(found, log)
        if given.slope and "astazero" in str(path):
            table = read_table(path)
            keep = np.isin(table.numbers("Time"), log.time)
            survey = read_table(path.parent / "Slope.csv")
            positions = table.numbers(f"X{number}")[keep]
            grade = np.interp(np.mod(positions, LAP_M), survey.numbers("X"), survey.numbers("Y"))
            row["slope"] = slope_coefficient(found, log, grade)
        rows.append(row)
        print(json.dumps(row), flush=True)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
