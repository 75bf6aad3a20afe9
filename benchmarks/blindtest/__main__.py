"""Does the diagnosis name causes that it cannot have seen?

``OMP_NUM_THREADS=1 python -m benchmarks.blindtest --n 20 --seed 7 --out out/blindtest``

Draws cases from a reference vehicle that shares no code with the effects, lets the diagnosis and its rivals answer
them, and scores the answers. They are kept as they come: the same command goes on after an interruption, or with a
larger --n. What is drawn and how it is scored: README.md beside this file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from avtorch.errors import InputError, quoted
from avtorch.numeral import numeral
from avtorch.plots import save
from benchmarks.blindtest.answerers import avtorch, rivals
from benchmarks.blindtest.confusion import confusion_figure
from benchmarks.blindtest.deck import KINDS
from benchmarks.blindtest.tables import blindtest_notes, blindtest_table
from benchmarks.blindtest.trial import run_trial


def options(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blindtest", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--n", type=int, required=True, help="number of cases; 20 hold the mix")
    parser.add_argument("--seed", type=int, required=True, help="of everything random")
    parser.add_argument("--out", type=Path, default=Path("out/blindtest"))
    parser.add_argument("--signals", choices=("both", "accel", "speed"), default="both", help="channels of the logs")
    parser.add_argument("--recorder", choices=("ideal", "ordinary"), default="ideal", help="ordinary: as real logs are")
    parser.add_argument("--mix", type=_shares, help="kinds and their shares, none=0.5,several=0.5, or one kind")
    parser.add_argument("--rivals", default="all", help="all that are installed, none but the random guess, or names")
    parser.add_argument("--workers", type=int, default=1, help="processes, one thread each")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = options(arguments)
    answer = run_trial(
        chosen.n,
        chosen.seed,
        chosen.out,
        answerers={"avtorch": avtorch, **rivals(chosen.rivals)},
        workers=chosen.workers,
        signals=("accel", "speed") if chosen.signals == "both" else (chosen.signals,),
        recorder=chosen.recorder,
        mix=chosen.mix,
        progress=lambda done, of: print(f"{done} of {of} cases", file=sys.stderr),
    )
    console = Console(highlight=False)
    save(confusion_figure(answer), chosen.out / "confusion.png")
    console.print(blindtest_table(answer))
    for note in blindtest_notes(answer):
        console.print(note, style="dim", markup=False)


def _shares(text: str) -> dict[str, float]:
    """Shares by kind: `none=0.5,several=0.5`, or one kind alone."""
    if text.strip() in KINDS:
        return {text.strip(): 1.0}
    shares: dict[str, float] = {}
    for part in text.split(","):
        kind, _, share = (x.strip() for x in part.partition("="))
        try:
            number = numeral(share)
        except ValueError:
            number = -1.0
        if kind not in KINDS or kind in shares or not 0 <= number <= 1:
            break
        shares[kind] = number
    else:
        if abs(sum(shares.values()) - 1) <= 1e-9:
            return shares
    raise argparse.ArgumentTypeError(f"found {quoted(text)}, needs one of {', '.join(KINDS)}, or shares that sum to 1")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(str(error))
