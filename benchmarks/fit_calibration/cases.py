"""Cases drawn, searched once, and stored in one file: for each the data that the fit needs, some 2 kB.

Searching takes hours, fitting seconds. So the file grows case by case, an interrupted run continues from it, and the
fit can be repeated in other ways.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avtorch.blindtest import CALIBRATION as FAMILIES
from avtorch.blindtest import MIX, Case, draw_case
from avtorch.errors import InputError
from avtorch.gap import plant
from avtorch.gap.diagnose import left_over
from avtorch.gap.search.search import Search
from avtorch.gap.selection import model_probabilities as odds
from avtorch.gap.selection.adequacy import Adequacy
from avtorch.gap.selection.model_probabilities import Weighed
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.io import read_sealed, write_sealed
from benchmarks.fit_calibration.fingerprint import Numbers, differences

SCHEMA = "avtorch.calibration.cases/1"
CASE_MIX = {"none": 0.20, "single": 0.40, "pair": 0.15, "outside": 0.25}
"""More causes outside the table than in the blind test, as five constants are fitted to these alone. The deck has whole
numbers in every 20 cases; in 170 cases the shares are 20, 40, 14 and 26 %."""

_REMEDY = "needs another --kept, or all cases searched anew"


@dataclass(frozen=True)
class KeptCandidate:
    """A candidate as `odds` weights it; `log_evidence` over none [nats]."""

    name: str
    log_evidence: float
    by_chance: None = None


@dataclass(frozen=True)
class KeptCase:
    """`truth`: the right answer. `left`: by name, of each of `possible_favourites`."""

    index: int
    kind: str
    truth: str
    found: tuple[KeptCandidate, ...]
    left: Mapping[str, Adequacy]

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> KeptCase:
        """The inverse of `asdict`."""
        found = tuple(KeptCandidate(**c) for c in entry["found"])
        left = {name: Adequacy(**nats) for name, nats in entry["left"].items()}
        return cls(entry["index"], entry["kind"], entry["truth"], found, left)

    @property
    def none(self) -> KeptCandidate:
        return next(c for c in self.found if c.name == "none")


def possible_favourites(found: Sequence[Weighed]) -> set[str]:
    """Names of the candidates that some non-negative prices make the favourite.

    All single effects pay the same price, so only the best of them can be. A pair cannot where another one of its group
    gains as much and pays no more.
    """
    gained = odds.evidence_gains(found)
    names = {"none"}
    single = [f for f in found if f.name != "none" and "+" not in f.name]
    if single:
        names.add(max(single, key=lambda f: f.log_evidence).name)
    for chance in (False, True):
        front, least = [], float("inf")
        pairs = [f for f in found if "+" in f.name and odds.by_chance(f) == chance]
        for f in sorted(pairs, key=lambda f: (-gained[f.name], odds.partner(f.name, gained))):
            partner = odds.partner(f.name, gained)
            if partner < least:
                front.append(f.name)
                least = partner
        names.update(front)
    return names


def searched(case: Case, *, effects: Sequence[type] | None = None) -> KeptCase:
    """Search the log of `case` as a diagnosis does, among all effects unless some are given."""
    race = Search([with_sensor_noise(case.log())[0]], plant(), effects=effects).run()
    flat = race.none.log_evidence
    named = possible_favourites(race.found)
    return KeptCase(
        case.index,
        case.kind,
        case.truth_name,
        tuple(KeptCandidate(f.name, float(f.log_evidence - flat)) for f in race.found),
        {f.name: left_over(f, race.record) for f in race.found if f.name in named},
    )


def collect(
    path: Path,
    *,
    seed: int,
    count: int,
    numbers: Mapping[str, Numbers],
    resume: bool = False,
    search: Callable[[Case], KeptCase] = searched,
    progress: Callable[[int, int], None] = lambda done, of: None,
    **draw_options: Any,
) -> list[KeptCase]:
    """Cases 0 to `count - 1` of the set `seed`; those in `path` are taken from there, the others drawn and kept in it.

    `numbers`: the likelihood's fingerprint. `draw_options`: as `avtorch.blindtest.draw_case`. Raises `InputError`
    where `path` is there without `resume`, or holds cases of another seed, mix, option or likelihood.
    """
    of = {"seed": seed, "mix": CASE_MIX, "draw": draw_options, "fingerprint": numbers}
    kept: dict[int, KeptCase] = {}
    if path.exists():
        if not resume:
            raise InputError(f"{path}: holds cases already; add --resume to go on with them, or name another --kept")
        kept = _kept(path, of)
    for index in range(count):
        if index not in kept:
            case = draw_case(index, seed, mix=CASE_MIX, outside="calibration", **draw_options)
            kept[index] = search(case)
            write_sealed(path, [asdict(kept[i]) for i in sorted(kept)], schema=SCHEMA, of=of)
        progress(index + 1, count)
    return [kept[i] for i in range(count)]


def _kept(path: Path, of: Mapping[str, Any]) -> dict[int, KeptCase]:
    found = read_sealed(path, schema=SCHEMA, remedy=_REMEDY)
    for key in ("seed", "mix", "draw"):
        if found.of.get(key) != of[key]:
            raise InputError(f"{path}: holds cases with {key} {found.of.get(key)!r}, found {of[key]!r}; {_REMEDY}")
    for part, numbers in of["fingerprint"].items():
        changed = differences(part, found.of["fingerprint"].get(part, {}), numbers)
        if changed:
            raise InputError(f"{path}: the likelihood has changed since ({changed[0]}); {_REMEDY}")
    return {entry["index"]: KeptCase.of(entry) for entry in found.content}


def weights(cases: Sequence[KeptCase]) -> dict[str, float]:
    """By kind: its share in the blind test over its share among `cases`."""
    counts = Counter(case.kind for case in cases)
    return {kind: MIX[kind] * len(cases) / count for kind, count in counts.items()}


def families() -> list[str]:
    """Names of the calibration causes outside the table."""
    return sorted(FAMILIES)
