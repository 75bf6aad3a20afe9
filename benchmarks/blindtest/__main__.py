"""Does the diagnosis name causes that it cannot have seen?

``OMP_NUM_THREADS=1 python -m benchmarks.blindtest --n 20 --seed 7 --out out/blindtest``

Draws cases from a reference vehicle that shares no code with the effects, lets the diagnosis and its rivals answer
them, and scores the answers. They are kept as they come: the same command goes on after an interruption, or with a
larger --n. With --background known effects are put in front of recorded cars instead, and each answer is held against
the one to the untouched log. What is drawn and how it is scored: README.md beside this file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from avtorch.errors import InputError, quoted
from avtorch.io import Log
from avtorch.numeral import numeral
from avtorch.plots import save
from benchmarks.blindtest.answerers import avtorch, rivals
from benchmarks.blindtest.background import SIZES, run_background
from benchmarks.blindtest.confusion import confusion_figure
from benchmarks.blindtest.deck import KINDS
from benchmarks.blindtest.tables import background_notes, background_table, blindtest_notes, blindtest_table
from benchmarks.blindtest.trial import run_trial

_OF_CASES, _OF_RECORDINGS = ("n", "rivals", "recorder", "mix"), ("sizes", "effects", "draws")


def options(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blindtest", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--n", type=int, help="number of cases; 20 hold the mix")
    parser.add_argument("--seed", type=int, required=True, help="of everything random")
    parser.add_argument("--out", type=Path, default=Path("out/blindtest"))
    parser.add_argument("--signals", choices=("both", "accel", "speed"), default="both", help="channels of the logs")
    parser.add_argument("--recorder", choices=("ideal", "ordinary"), help="ordinary: as real logs are; default: ideal")
    parser.add_argument("--mix", type=_shares, help="kinds and their shares, none=0.5,several=0.5, or one kind")
    parser.add_argument("--rivals", help="all that are installed (default), none but the random guess, or names")
    parser.add_argument("--background", type=Path, nargs="+", help="recorded logs, in place of drawn cases")
    parser.add_argument("--sizes", type=_numbers, help="of the effects in front; default: 0.5,0.8,1.25")
    parser.add_argument("--effects", help="only these effects, NAME,NAME,...; default: all that can be")
    parser.add_argument("--draws", type=int, help="how often effects of chance are put in front; default: once")
    parser.add_argument("--workers", type=int, default=1, help="processes, one thread each")
    chosen = parser.parse_args(arguments)
    foreign = _OF_RECORDINGS if chosen.background is None else _OF_CASES
    if given := [name for name in foreign if getattr(chosen, name) is not None]:
        parser.error(f"--{given[0]} does not go {'without' if chosen.background is None else 'with'} --background")
    if chosen.background is None and chosen.n is None:
        parser.error("needs --n, or --background")
    return chosen


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = options(arguments)
    (_cases if chosen.background is None else _recorded)(chosen, Console(highlight=False))


def _cases(chosen: argparse.Namespace, console: Console) -> None:
    answer = run_trial(
        chosen.n,
        chosen.seed,
        chosen.out,
        answerers={"avtorch": avtorch, **rivals(chosen.rivals or "all")},
        workers=chosen.workers,
        signals=("accel", "speed") if chosen.signals == "both" else (chosen.signals,),
        recorder=chosen.recorder or "ideal",
        mix=chosen.mix,
        progress=_step("cases"),
    )
    save(confusion_figure(answer), chosen.out / "confusion.png")
    console.print(blindtest_table(answer))
    for note in blindtest_notes(answer):
        console.print(note, style="dim", markup=False)


def _recorded(chosen: argparse.Namespace, console: Console) -> None:
    logs = [Log.read(path) for path in chosen.background]
    if chosen.signals != "both":
        for log in logs:
            if getattr(log, chosen.signals) is None:
                raise InputError(f"{log.name}: has no {chosen.signals}, which --signals asks for")
        logs = [replace(log, **{"speed" if chosen.signals == "accel" else "accel": None}) for log in logs]
    answer = run_background(
        logs,
        chosen.seed,
        chosen.out,
        answerer=avtorch,
        sizes=chosen.sizes or SIZES,
        effects=chosen.effects and [name.strip() for name in chosen.effects.split(",")],
        draws=1 if chosen.draws is None else chosen.draws,
        workers=chosen.workers,
        progress=_step("logs"),
    )
    console.print(background_table(answer))
    for note in background_notes(answer):
        console.print(note, style="dim", markup=False)


def _step(what: str) -> Callable[[int, int], None]:
    return lambda done, of: print(f"{done} of {of} {what}", file=sys.stderr)


def _numbers(text: str) -> list[float]:
    try:
        return [numeral(part.strip()) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {quoted(text)}, needs numbers such as 0.5,0.8,1.25") from None


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
