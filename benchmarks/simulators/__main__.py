"""What does a simulator lack that is not made of effects? Sealed cases of the reference vehicle.

``python -m benchmarks.simulators --n 100 --seed 1 [--by output object fmu] [--recorder ordinary] [--out FILE]``

Each case (`cases.py`) is answered by the simulator's output, by the simulator as an object that is stepped, and by an
FMU of it, as `--by` says; the answers to one case are compared. Behind an ordinary recorder the car's readings are
filtered, held, rounded and shaken, with clocks of their own; it loses no rows and nobody takes over, so that car and
simulator have the same commands. With --out, answers already there are kept.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.blindtest.intervals import wilson
from benchmarks.simulators.cases import WAYS, answered, behind_a_recorder, draw

KINDS = ("none", "parameter", "effect")


def table(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Lines of the summary: how many are right, by way and kind, and how many verdicts two ways share."""
    ways = [way for way in WAYS if any(row["by"] == way for row in rows)]
    for way in ways:
        of_way = [row for row in rows if row["by"] == way]
        for kinds in (*((kind,) for kind in KINDS), KINDS):
            own = [row for row in of_way if row["kind"] in kinds]
            for key in ("right", "nothing_else", "in_alias_set", "right_kind"):
                yield f"{way}, {' '.join(kinds)}: {key} {_share(sum(row[key] for row in own), len(own))}"
        yield f"{way}: median {np.median([row['seconds'] for row in of_way]):.1f} processor s"
    for one, other in combinations(ways, 2):
        verdicts = [{row["number"]: _verdict(row) for row in rows if row["by"] == way} for way in (one, other)]
        both = verdicts[0].keys() & verdicts[1].keys()
        same = sum(verdicts[0][number] == verdicts[1][number] for number in both)
        yield f"{one} and {other}: same verdict {_share(same, len(both))}"


def _verdict(row: dict[str, Any]) -> tuple[str, frozenset[str]]:
    """What is missing, or what is wrong."""
    kind = row["answered_kind"]
    return kind, frozenset(row["wrong"] if kind == "parameter" else row["missing"])


def _share(hits: int, of: int) -> str:
    low, high = wilson(hits, of) or (0.0, 1.0)
    return f"{hits} of {of} ({low:.2f} to {high:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=int, default=1, help="only each so manieth case, for several processes")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--by", choices=WAYS, nargs="+", default=["output"])
    parser.add_argument("--recorder", choices=["ideal", "ordinary"], default="ideal")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    out: Path | None = given.out
    rows = [json.loads(x) for x in out.read_text().splitlines()] if out and out.exists() else []
    known = {(row["number"], row["by"]) for row in rows}
    for number in range(given.first, given.n, given.every):
        ways = [way for way in given.by if (number, way) not in known]
        if not ways:
            continue
        case = draw(given.seed, number)
        case = behind_a_recorder(case, given.seed) if given.recorder == "ordinary" else case
        for way in ways:
            row = answered(case, way)
            rows.append(row)
            print(json.dumps(row), flush=True)
            if out:
                with out.open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
