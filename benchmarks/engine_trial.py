"""An engine of diagnosis held to the blind test, tier by tier behind both recorders, and compared case by case.

``OMP_NUM_THREADS=1 python -m benchmarks.engine_trial MODULE:FUNCTION --out out/engine_trial --cell dev --cases 30``

Draws the cases of a cell, lets the function answer those that it has not answered, and prints a table and its misses.
A cell is a name; it and the tier give the seed. Each tier is a set of its own, drawn by `blindtest.draw_case`
in the blind test's mix (25 % none, 40 % single, 20 % pair, 15 % outside, exact in every 20 cases) with its single and
outside causes of that tier; none and pair have no tier. 40 cases of a set are 10 none, 16 single, 8 pair and 6
outside. Behind either recorder the drives are the same (but for stops), so that every case has its
twin.

`FUNCTION` takes an `avtorch.Log`, or with `--csv` the path of the log, and returns an `avtorch.Diagnosis` or a dict of
`avtorch.diagnosis/1` or `/2`. Without one the cases are drawn and nothing is answered. The folder holds
``RECORDER/TIER/logs/case_00000.csv`` and ``RECORDER/TIER/truth/case_00000.json`` (not for a diagnosis to read), and
under ``answers/NAME`` one file an answer, and ``score.json``: all measures of `blindtest.score`. A second call
goes on where the first ended; several calls may share a folder. After a change of an engine give `--again`, or another
`--name`, so that `--against` compares both.

Causes outside the table are those that may serve to calibrate `unknown`. The sealed ones (`--outside sealed`) are for
the last figures, on a cell that nobody has looked at.

The columns: `top-1`, share of all cases whose verdict is exactly the truth (90 % interval by Wilson), also by kind;
`AUROC` of the probability of `unknown`; `blamed`: outside causes for which a name has probability 0.5 or more;
`accused`: cars without a cause whose verdict is not `none`; `ECE`, and what it would be by chance were all
probabilities right; wall and processor seconds an answer; `onset`: median error [s] where the verdict is right. A
method that fails has answered wrongly.

``--picture FILE`` draws how often the most probable hypothesis is right, in fifths of the cases by its probability.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from matplotlib.figure import Figure

from avtorch.errors import InputError
from avtorch.io import Log, write_json
from avtorch.plots.style import BLUE, GREY, VERMILLION, styled
from benchmarks.blindtest import MIX, TIERS, draw_case, score
from benchmarks.blindtest.answers import Answered, read_answer
from benchmarks.blindtest.cases import SIGNALS, Recording
from benchmarks.blindtest.intervals import wilson
from benchmarks.blindtest.pool import worked
from benchmarks.blindtest.trial import ask

RECORDERS: tuple[Recording, ...] = get_args(Recording)
TIERS_TRIED = ("easy", "medium", "hard")
_RESAMPLES = 200
_FIFTHS = 5
_PROBABLE = 4  # hypotheses that are shown of a wrong answer


@dataclass(frozen=True)
class Cell:
    """A named collection of cases in the folder `out`; `outside`: the group of causes outside the table."""

    out: Path
    name: str
    outside: Literal["calibration", "sealed"] = "calibration"
    signals: tuple[str, ...] = SIGNALS

    def seed(self, tier: str) -> int:
        """The seed of the set of a tier: the same on every machine."""
        return int.from_bytes(hashlib.sha256(f"{self.name}/{tier}".encode()).digest()[:4], "big")

    def settle(self) -> None:
        """Keep the cell's settings in its folder. Raises `InputError` where the folder is another cell's."""
        settings = {"cell": self.name, "outside": self.outside, "signals": list(self.signals), "mix": MIX}
        path = self.out / "cell.json"
        if not path.exists():
            write_json(path, settings)
        elif (found := json.loads(path.read_text())) != settings:
            raise InputError(f"{path}: found {found}, needs {settings}, or another --out")


@dataclass(frozen=True)
class Place:
    """Case number `index` of a tier of a cell, behind a recorder; its log and truth are drawn when they are missing."""

    cell: Cell
    recorder: Recording
    tier: str
    index: int

    @property
    def label(self) -> str:
        return f"{self.recorder}/{self.tier}/case_{self.index:05d}"

    @property
    def log_path(self) -> Path:
        return self.cell.out / self.recorder / self.tier / "logs" / f"case_{self.index:05d}.csv"

    def answer_path(self, name: str) -> Path:
        return self.cell.out / "answers" / name / f"{self.label}.json"

    def truth(self) -> dict[str, Any]:
        """The hidden truth, drawn with its log where they are missing."""
        path = self.log_path.parent.parent / "truth" / f"{self.log_path.stem}.json"
        if not (path.exists() and self.log_path.exists()):
            signals, outside = self.cell.signals, self.cell.outside
            drawn = {"tiers": (self.tier,), "outside": outside, "signals": signals, "recorder": self.recorder}
            case = draw_case(self.index, self.cell.seed(self.tier), **drawn)
            write_json(path, case.truth())
            case.log(signals=signals).write(self.log_path)
        return json.loads(path.read_text())


@dataclass(frozen=True)
class Method:
    """Who answers: `function` is MODULE:FUNCTION (empty: nobody), `by_csv`: it takes the path of a log; `name`: its
    answers are kept under that."""

    function: str
    name: str
    by_csv: bool = False

    def answer(self, place: Place, truth: Mapping[str, Any]) -> dict[str, Any]:
        """One answer with what it cost; a failure is an answer too, and its traceback is kept."""
        given = str(place.log_path) if self.by_csv else Log.read(place.log_path)
        return ask(loaded(self.function), given, truth)


@cache
def loaded(function: str) -> Callable[[Any], Any]:
    """The function MODULE:FUNCTION; `InputError` where there is none."""
    module, _, name = function.partition(":")
    found = getattr(import_module(module), name, None) if module and name else None
    if not callable(found):
        raise InputError(f"function: found {function!r}, needs MODULE:FUNCTION")
    return found


def work(task: tuple[Place, Method]) -> int:
    """Draw a case if need be, and keep the answer to it; returns its index."""
    place, method = task
    truth = place.truth()
    said = "drawn"
    if method.function:
        kept = method.answer(place, truth)
        write_json(place.answer_path(method.name), kept)
        row = read_answer(truth, kept["answer"])
        said = f"{'right' if row.right else 'WRONG'}: {row.truth} answered {row.verdict}, {kept['seconds']:.1f} s"
    print(f"{place.label} {said}", flush=True)
    return place.index


@dataclass(frozen=True)
class Scored:
    """A case whose answer is stored: what was `kept`, and both read by the blind test as `row`."""

    place: Place
    truth: Mapping[str, Any]
    kept: Mapping[str, Any]
    row: Answered

    @property
    def cause(self) -> str:
        """The true cause, with what makes it hard to see."""
        names = "+".join(self.truth["names"]) or "none"
        onset = "" if self.truth["onset_s"] is None else f" from {self.truth['onset_s']:.0f} s"
        drive = self.truth["drive"]
        seen = f"visibility {self.truth['visibility']:.2f}, " if self.truth["names"] else ""
        where = f"{drive['manoeuvre']} {drive['seconds']:.0f} s at {drive['rate_hz']:.0f} Hz"
        return f"{self.row.kind} {names}{onset} ({seen}{where})"

    @property
    def said(self) -> str:
        """The verdict, the highest probabilities and that of the truth."""
        if self.kept["error"]:
            return f"failed: {self.kept['error'].strip().splitlines()[-1]}"
        ranked = sorted(self.row.probabilities.items(), key=lambda one: -one[1])
        shown = ranked[:_PROBABLE]
        shown += [one for one in ranked[_PROBABLE:] if one[0] == self.row.truth]
        return f"{self.row.verdict}: {', '.join(f'{name} {p:.3f}' for name, p in shown)}"


def stored(places: Sequence[Place], name: str) -> list[Scored]:
    """The cases of `places` to which the method `name` has an answer."""
    found: list[Scored] = []
    for place in (place for place in places if place.answer_path(name).exists()):
        kept, truth = json.loads(place.answer_path(name).read_text()), place.truth()
        found.append(Scored(place, truth, kept, read_answer(truth, kept["answer"])))
    return found


def groups(scored: Sequence[Scored]) -> Iterator[tuple[str, str, list[Scored]]]:
    """Recorder, tier and cases of each row of the table; tier `all` closes a recorder of several tiers."""
    for recorder in RECORDERS:
        behind = [one for one in scored if one.place.recorder == recorder]
        tiers = [tier for tier in TIERS if any(one.place.tier == tier for one in behind)]
        for tier in tiers:
            yield recorder, tier, [one for one in behind if one.place.tier == tier]
        if len(tiers) > 1:
            yield recorder, "all", behind


TITLES = (
    "recorder", "tier", "cases", "top-1 (90 %)", "none", "single", "pair", "outside", "AUROC", "blamed", "accused",
    "ECE (by chance)", "s median / p95", "cpu s median / p95", "onset [s]", "failed",
)  # fmt: skip


def table_row(recorder: str, tier: str, some: Sequence[Scored], found: Mapping[str, Any]) -> str:
    """A row of the table (module docstring) for `some` cases and what the scorer `found`."""
    right = sum(one.row.right for one in some)
    low, high = wilson(right, len(some)) or (0.0, 1.0)
    kinds = {kind: [one.row.right for one in some if one.row.kind == kind] for kind in MIX}

    def counted(key: str) -> str:
        count = found["counts"][key]
        return f"{round((found[key] or 0.0) * count)}/{count}"

    def number(key: str, digits: int = 2) -> str:
        return "" if found[key] is None else f"{found[key]:.{digits}f}"

    def times(key: str) -> str:
        median, slow = np.percentile([one.kept[key] for one in some], (50, 95))
        return f"{median:.1f} / {slow:.1f}"

    cells = (
        recorder,
        tier,
        str(len(some)),
        f"{right / len(some):.3f} ({low:.2f} to {high:.2f})",
        *(f"{sum(rights)}/{len(rights)}" for rights in kinds.values()),
        number("unknown_auroc"),
        counted("unknown_confidently_blamed"),
        counted("false_alarm"),
        f"{number('ece')} ({number('ece_by_chance')})",
        times("seconds"),
        times("cpu_seconds"),
        f"{number('onset_error_s', 1)} ({found['counts']['onset_error_s']})",
        str(sum(bool(one.kept["error"]) for one in some)),
    )
    return f"| {' | '.join(cells)} |"


def print_table(scored: Sequence[Scored]) -> dict[str, Any]:
    """Print the table; returns the scorer's measures by row."""
    print(f"| {' | '.join(TITLES)} |\n|{'---|' * len(TITLES)}")
    measures: dict[str, Any] = {}
    for recorder, tier, some in groups(scored):
        found = score([one.truth for one in some], [one.kept["answer"] for one in some], resamples=_RESAMPLES)
        measures[f"{recorder}/{tier}"] = found
        print(table_row(recorder, tier, some, found), flush=True)
    return measures


def print_misses(scored: Sequence[Scored], others: Mapping[str, Scored]) -> None:
    """Every wrong answer: true cause, verdict, probabilities; and what the other method says there, if any."""
    print(f"\nMisses ({sum(not one.row.right for one in scored)} of {len(scored)}):")
    for one in scored:
        if not one.row.right:
            other = others.get(one.place.label)
            beside = "" if other is None else f"  [other: {'right' if other.row.right else other.said}]"
            print(f"- {one.place.label} {one.cause}\n    {one.said}{beside}")


def print_comparison(scored: Sequence[Scored], others: Mapping[str, Scored], name: str) -> None:
    """How often either is right where both have answered, and the cases that only one of them has right."""
    both = [(one, others[one.place.label]) for one in scored if one.place.label in others]
    counts = {pair: sum((a.row.right, b.row.right) == pair for a, b in both) for pair in np.ndindex(2, 2)}
    print(
        f"\nAgainst {name}, {len(both)} cases: both right {counts[1, 1]}, only this one {counts[1, 0]}, "
        f"only {name} {counts[0, 1]}, neither {counts[0, 0]}."
    )
    for one, other in both:
        if one.row.right != other.row.right:
            print(
                f"- {'won' if one.row.right else 'lost'} {one.place.label} {one.cause}: {other.row.verdict} by {name}"
            )


@styled
def draw_reliability(scored: Sequence[Scored]) -> Figure:
    """Share of cases whose most probable hypothesis is right against its probability, in fifths of the cases of each
    recorder; 90 % intervals by Wilson."""
    figure = Figure(figsize=(4.2, 3.8), layout="constrained")
    ax = figure.add_subplot()
    ax.plot([0, 1], [0, 1], color=GREY, lw=0.8, label="as stated")
    for recorder, colour, marker in zip(RECORDERS, (BLUE, VERMILLION), "os", strict=True):
        rows = [one.row for one in scored if one.place.recorder == recorder]
        best = [(max(row.probabilities, key=lambda name: row.probabilities[name]), row) for row in rows]
        some = sorted(
            (row.probabilities[name], set(name.split("+")) == set(row.truth.split("+"))) for name, row in best
        )
        for number, fifth in enumerate(np.array_split(np.array(some, float).reshape(-1, 2), _FIFTHS)):
            if len(fifth):
                low, high = wilson(round(fifth[:, 1].sum()), len(fifth)) or (0.0, 1.0)
                stated, right = fifth.mean(0)
                label = f"{recorder} recorder" if not number else None
                ax.plot([stated, stated], [low, high], color=colour, lw=1.0)
                ax.plot(stated, right, marker, color=colour, label=label)
    ax.set(
        xlabel="probability of the most probable hypothesis",
        ylabel="share that is right",
        xlim=(0, 1.02),
        ylim=(0, 1.02),
    )
    ax.legend(frameon=False, loc="upper left")
    return figure


def options(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("function", nargs="?", default="", help="MODULE:FUNCTION that answers (none: draw only)")
    parser.add_argument("--csv", action="store_true", help="the function takes the path of a log, not a Log")
    parser.add_argument("--name", default="", help="name of the answers (default: MODULE.FUNCTION)")
    parser.add_argument("--out", type=Path, default=Path("out/engine_trial"))
    parser.add_argument("--cell", default="dev")
    parser.add_argument("--cases", type=int, default=30, help="of each tier behind each recorder")
    parser.add_argument("--tiers", nargs="+", choices=tuple(TIERS), default=TIERS_TRIED)
    parser.add_argument("--recorders", nargs="+", choices=RECORDERS, default=RECORDERS)
    parser.add_argument("--signals", nargs="+", choices=SIGNALS, default=SIGNALS, help="of the logs (another --out)")
    parser.add_argument("--outside", choices=("calibration", "sealed"), default="calibration")
    parser.add_argument("--only", default="", help="only cases whose label, as hard/case_00003, contains this")
    parser.add_argument("--jobs", type=int, choices=(1, 2), default=1)
    parser.add_argument("--again", action="store_true", help="answer again what was answered")
    parser.add_argument("--stored", action="store_true", help="answer nothing, score what is stored")
    parser.add_argument("--picture", type=Path, help="draw how far probabilities hold")
    parser.add_argument("--against", default="", help="name of stored answers to compare with, case by case")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = options(arguments)
    cell = Cell(chosen.out, chosen.cell, chosen.outside, tuple(name for name in SIGNALS if name in chosen.signals))
    cell.settle()
    # in this order what is stored is balanced at any time
    places = [Place(cell, r, tier, i) for i in range(chosen.cases) for r in chosen.recorders for tier in chosen.tiers]
    places = [place for place in places if chosen.only in place.label]
    method = Method(chosen.function, chosen.name or chosen.function.replace(":", "."), chosen.csv)
    if not chosen.stored:
        if method.function:
            loaded(method.function)  # a wrong name shows at once
        again = chosen.again or not method.function
        todo = [(place, method) for place in places if again or not place.answer_path(method.name).exists()]
        list(worked(work, todo, chosen.jobs))
    if not method.name or not (scored := stored(places, method.name)):
        return
    seeds = ", ".join(f"{tier} {cell.seed(tier)}" for tier in chosen.tiers)
    print(f"\n{method.name} on cell {cell.name} (seeds: {seeds}; outside causes: {cell.outside})\n")
    measures = print_table(scored)
    if not chosen.only:
        write_json(cell.out / "answers" / method.name / "score.json", measures)
    if chosen.picture:
        draw_reliability(scored).savefig(chosen.picture)
    others = {one.place.label: one for one in stored(places, chosen.against)} if chosen.against else {}
    print_misses(scored, others)
    if others:
        print_comparison(scored, others, chosen.against)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(str(error))
