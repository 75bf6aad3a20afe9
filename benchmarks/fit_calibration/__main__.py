"""Fit the constants behind probabilities to simulated cases, and write them with their provenance.

``python -m benchmarks.fit_calibration --seed 515151 --cases 170 --out FILE [--resume]``

Draws cases of the blind test's reference vehicle, with the calibration families of causes outside the table, searches
each once (hours: a minute or more of processor time per case) and keeps what the fit needs in `--kept`. Then it fits
the constants, holds out a quarter for the figures, and writes `--out`; constants that were chosen by hand are kept.
With `--resume` an interrupted run continues, and a finished one is only fitted again. `--compare` keeps the
constants: it adds to their provenance how they do on these cases beside those of a fit to other ones.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any

from avtorch.errors import InputError
from avtorch.gap.selection.calibration import PATH, SCHEMA, Calibration, document
from avtorch.io import write_json
from benchmarks.fit_calibration.cases import CASE_MIX, KeptCase, collect, families, weights
from benchmarks.fit_calibration.figures import compared, held_out
from benchmarks.fit_calibration.fingerprint import Numbers, fingerprint
from benchmarks.fit_calibration.fit import Fitted, fit

COMMAND = "python -m benchmarks.fit_calibration"
_DIGITS = 4  # larger than any standard error


def made(
    old: Mapping[str, Any], found: Fitted, provenance: Mapping[str, Any], numbers: Mapping[str, Numbers]
) -> dict[str, Any]:
    """The new file: `old` with the fitted constants, their provenance, and the likelihood's fingerprint."""
    groups = {"odds": asdict(found.odds), "unknown": asdict(found.unknown)}
    constants = {
        group: {
            name: entry | ({"value": float(f"{groups[group][name]:.{_DIGITS}g}")} if group in groups else {})
            for name, entry in entries.items()
        }
        for group, entries in old["constants"].items()
    }
    Calibration.of(constants)  # check that the written file can be read
    return {"schema": SCHEMA, "constants": constants, "provenance": dict(provenance), "fingerprint": dict(numbers)}


def origin(cases: Sequence[KeptCase], seed: int, *, commit: str, today: str) -> dict[str, Any]:
    """Provenance of the constants fitted to these cases, and their figures on the held-out quarter."""
    return {
        "made_by": f"{COMMAND} --seed {seed} --cases {len(cases)}",
        "note": "Final constants are fitted to all cases, the figures' to three quarters.",
        "seed": seed,
        "cases": len(cases),
        "mix": CASE_MIX,
        "kinds": dict(sorted(Counter(case.kind for case in cases).items())),
        "families": families(),
        "signals": ["accel", "speed"],
        "date": today,
        "commit": commit,
        "held_out": held_out(cases, seed),
    }


def checked(
    old: Mapping[str, Any], figures: Mapping[str, float], cases: int, seed: int, *, commit: str, today: str
) -> dict[str, Any]:
    """The file with `figures` (`compared`) of new cases in its provenance."""
    made_by = f"{COMMAND} --seed {seed} --cases {cases} --compare"
    own = {"made_by": made_by, "date": today, "commit": commit, **figures}
    return {**old, "provenance": {**old["provenance"], "checked": own}}


def commit_of(tree: Path) -> str:
    """The commit of the likelihood. Raises `InputError` where the running code differs from the committed one."""

    def git(*words: str) -> str:
        try:
            return subprocess.run(
                ["git", *words], cwd=tree, check=True, capture_output=True, text=True
            ).stdout.strip()  # fmt: skip
        except (OSError, subprocess.CalledProcessError):
            raise InputError(f"{tree}: is no git checkout, needs one, as the file names its commit") from None

    changed = [line for line in git("status", "--porcelain", "--", "avtorch").splitlines() if PATH.name not in line]
    if changed:
        raise InputError(f"{tree}: {changed[0].strip()} is not committed; commit first, as the file names its commit")
    return git("rev-parse", "HEAD")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True, help="of the cases; one that no test and no figure uses")
    parser.add_argument("--cases", type=int, default=170)
    parser.add_argument("--out", type=Path, default=PATH)
    parser.add_argument("--kept", type=Path, default=Path("out/calibration_cases.json"))
    parser.add_argument("--resume", action="store_true", help="go on with the cases in --kept")
    parser.add_argument("--compare", action="store_true", help="with the constants in use, instead of writing new ones")
    options = parser.parse_args(argv)
    try:
        commit, today = commit_of(Path(__file__).parent), date.today().isoformat()
        numbers = fingerprint()
        options.kept.parent.mkdir(parents=True, exist_ok=True)
        cases = collect(
            options.kept,
            seed=options.seed,
            count=options.cases,
            numbers=numbers,
            resume=options.resume,
            progress=lambda done, of: print(f"\rcase {done} of {of}", end="", file=sys.stderr, flush=True),
        )
        print(file=sys.stderr)
        if options.compare:
            figures = compared(cases, options.seed)
            for key, value in figures.items():
                print(f"{key:25s} {value:g}")
            write_json(options.out, checked(document(), figures, len(cases), options.seed, commit=commit, today=today))
            return
        found = fit(cases, weights(cases))
        provenance = origin(cases, options.seed, commit=commit, today=today)
        write_json(options.out, made(document(), found, provenance, numbers))
    except InputError as fault:
        sys.exit(f"fit_calibration: {fault}")
    figures = provenance["held_out"]
    print(f"calibration error {figures['calibration_error']}, area under ROC of unknown {figures['unknown_auroc']}")
    print(f"constants written to {options.out}")


if __name__ == "__main__":
    main()
