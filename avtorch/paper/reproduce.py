"""All of the paper, or a part of it, in one call: results by name, and the rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.paper.estimation import estimation
from avtorch.paper.gains import gains
from avtorch.paper.leaders import Leaders
from avtorch.paper.monitoring import monitoring
from avtorch.paper.platoon import platoon
from avtorch.paper.regions import regions
from avtorch.paper.rows import ClaimRow
from avtorch.paper.strategies import strategies

SEEDS = 20
"""Noises of every setting, as the sweep asks for (SPEC section 5)."""


class ExperimentResult(Protocol):
    """The result of an experiment: its rows, and the data for its picture."""

    @property
    def rows(self) -> list[ClaimRow]: ...


EXPERIMENTS: Mapping[str, Callable[..., ExperimentResult]] = {
    "regions": regions,
    "estimation": estimation,
    "monitoring": monitoring,
    "strategies": strategies,
    "gains": gains,
    "platoon": platoon,
}
"""Experiments in the order of the paper: `(leaders, seeds=, seed=, progress=)` to a result."""

_COST = {"regions": 8.0, "estimation": 50.0, "monitoring": 15.0, "strategies": 60.0, "gains": 5.0, "platoon": 20.0}


@dataclass(frozen=True)
class Reproduction:
    """`found` by name of the experiment, in the order of the paper."""

    found: dict[str, ExperimentResult]
    leaders: Leaders
    seeds: int
    seed: int

    @property
    def rows(self) -> list[ClaimRow]:
        return [row for one in self.found.values() for row in one.rows]

    def answer(self) -> dict[str, Any]:
        """`paper.json`."""
        return {
            "schema": "avtorch.paper/1",
            "seed": self.seed,
            "seeds": self.seeds,
            "leaders": self.leaders.descriptions,
            "rows": [row.as_dict() for row in self.rows],
        }


@shows_progress
def reproduce(
    names: Sequence[str] | None = None,
    *,
    leaders: Leaders | None = None,
    seeds: int = SEEDS,
    seed: int = 0,
    progress: Callable[[float, float], None] | bool | None = None,
) -> Reproduction:
    """Run the experiments `names` (default: all), each with `seeds` noises; results are equal bit for bit for equal
    `seed`.

    `leaders`: default the embedded US06. `progress(done, of)`, or True, False, None, as in `avtorch.diagnose`. Raises
    `InputError` for an unknown name, or fewer than two seeds, which an interval needs.

    Example:
        >>> from avtorch.paper import reproduce
        >>> found = reproduce(["gains"], seeds=2)
        >>> {row.verdict for row in found.rows} <= {"same", "better", "not reproduced"}
        True
    """
    step = called(progress)
    chosen = list(EXPERIMENTS) if names is None else [n for n in EXPERIMENTS if n in names]
    for name in names or ():
        if name not in EXPERIMENTS:
            raise InputError(f"names: found {name!r}, needs some of {', '.join(EXPERIMENTS)}")
    if seeds < 2:
        raise InputError(f"seeds: found {seeds}, needs 2 or more")
    ahead = Leaders.read() if leaders is None else leaders
    whole, done, found = sum(_COST[name] for name in chosen), 0.0, {}
    for name in chosen:

        def report_share(share: float, begun: float = done, cost: float = _COST[name]) -> None:
            if step is not None:
                step(begun + share * cost, whole)

        found[name] = EXPERIMENTS[name](ahead, seeds=seeds, seed=seed, progress=report_share)
        done += _COST[name]
        report_share(1.0)
    return Reproduction(found, ahead, seeds, seed)
