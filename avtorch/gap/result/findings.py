"""What a diagnosis found, before it is put into words or files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from avtorch.gap.quantity import Quantity
from avtorch.gap.result.attribution import Location
from avtorch.gap.result.budget import Budget
from avtorch.gap.result.gap_size import GapSize, Shrinkage
from avtorch.gap.result.hypotheses import AnswerPart, Candidate, Scope, Verdict, candidate_name, listed_candidates
from avtorch.gap.result.log_facts import LogFacts
from avtorch.gap.result.predictive_model import PredictiveModel
from avtorch.gap.result.simulator_under_test import SimulatorUnderTest
from avtorch.gap.result.traces import Alarm, Traces
from avtorch.gap.simulator.force_table import ForceTable, ResistanceCurve
from avtorch.gap.simulator.plant import GapPlant


@dataclass(frozen=True, eq=False, repr=False)
class Findings:
    """The fields of a `Diagnosis`."""

    log: LogFacts
    baseline: Mapping[str, Quantity]
    gap: GapSize
    candidates: tuple[Candidate, ...]
    verdict: Verdict
    onset_s: float | None = None
    plant: GapPlant | None = None
    draws: Mapping[str, NDArray] | None = None
    simulator: GapPlant | None = None
    belief: Mapping[str, NDArray] | None = None
    assumed: Mapping[str, NDArray] | None = None
    traces: Traces | None = None
    remaining: tuple[Candidate, ...] | None = None
    where: tuple[Location, ...] = ()
    shrinkage: Shrinkage | None = None
    contenders: tuple[PredictiveModel, ...] = ()
    next_experiment: Mapping[str, Any] | None = None
    setting: Mapping[str, Any] | None = None
    complete: bool = True
    scope: Scope = field(default_factory=Scope)
    notes: tuple[str, ...] = ()
    onset_log: int = 0
    budget: Budget | None = None
    tested: SimulatorUnderTest | None = None
    alarms: tuple[Alarm, ...] = ()
    parts: tuple[AnswerPart, ...] = ()
    free_form: tuple[ForceTable | ResistanceCurve, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", listed_candidates(self.candidates))

    @property
    def onset_from_start_s(self) -> float | None:
        """`onset_s` from the first row of its log [s]."""
        return None if self.onset_s is None else self.onset_s - self.log.epochs_s[self.onset_log]

    @property
    def winner(self) -> Candidate:
        """The verdict's entry among the hypotheses; where it is too improbable to be listed, one without numbers."""
        name = self.verdict.name
        return next((c for c in self.candidates if c.name == name), Candidate(name, 0.0))

    def probability(self, names: str | Iterable[str]) -> float:
        """Probability of a hypothesis, by name or names; 0 where it is not listed."""
        name = candidate_name(names)
        return next((c.probability for c in self.candidates if c.name == name), 0.0)
