"""A fitted hypothesis, the result of a search, and the first guess of the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.answer.scope import Scope
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import GaussNewtonFit
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_fit import NoiseFit
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import whitening_filter
from avtorch.gap.likelihood.random_law import RandomLaw
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.lost_messages import LostMessages
from avtorch.gap.search.outliers import HeavyTails
from avtorch.gap.simulator.effect import Effect
from avtorch.io import Log


@dataclass(frozen=True, eq=False)
class ByChance:
    """A user's random effect as fitted: `law` at `z` (coordinate,) with this `covariance`.

    `explained` [nats]: gain from errors that it explains but that remain in the residuals; `process_sd` [m/s²]: of the
    jerk noise, where it was refitted together with the effect.
    """

    law: RandomLaw
    z: FloatArray = field(repr=False)
    covariance: FloatArray = field(repr=False)
    explained: float = 0.0
    process_sd: float | None = None


@dataclass(frozen=True, eq=False)
class Delays:
    """Delays that fit equally well under a command that repeats after `period` [s], in ascending order.

    `lengths` (mode,) [s], their `shares` (mode,) of the posterior, `z` (mode, coordinate) and `covariances` at each.
    `row`: the interval of the log's rows [s]. `gain` [nats]: of log likelihood over the model named `without`, which
    has no delay.
    """

    period: float
    row: float
    lengths: FloatArray
    shares: FloatArray
    z: FloatArray = field(repr=False)
    covariances: FloatArray = field(repr=False)
    gain: float
    without: str

    @property
    def none(self) -> float:
        """Posterior share of the modes within one row of zero delay, if longer delays fit equally well."""
        return float(self.shares[self.lengths < self.row].sum()) if len(self.lengths) > 1 else 0.0

    @property
    def may_be_zero(self) -> bool:
        """Whether zero delay fits as well: as one of the modes, or by a likelihood within `ALIKE`."""
        return self.none > 0 or (self.gain < ALIKE and float(self.lengths.max()) > self.row)


ALIKE = 4.0
"""Nats of log likelihood within which two delays are not distinguished. Chosen, not fitted: likelihood odds of 55 to 1,
which a delay beside a lag that adapts to it does not reach by noise."""


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted hypothesis: `name`, `z` and parameter `values` at the mode, `log_evidence` [nats], `errors`.

    `onset`, `gust_onset`: counted rows from which its effects and its gust act; None: from the start. `tails`,
    `losses`: results of its random effects; `searched`: the classes of these and of a gust. `by_chance`: the random
    effect without a search of its own. `delays`: all delays that fit equally well under a periodic command.
    """

    name: str
    hypothesis: Hypothesis
    z: FloatArray = field(repr=False)
    covariance: FloatArray = field(repr=False)
    values: Mapping[str, float]
    noise: NoiseFit = field(repr=False)
    log_evidence: float
    log_likelihood: float
    errors: FloatArray = field(repr=False)
    onset: int | None = None
    grade_rms: float | None = None
    profile: FloatArray | None = field(default=None, repr=False)
    tails: HeavyTails | None = field(default=None, repr=False)
    losses: LostMessages | None = field(default=None, repr=False)
    gust: bool = False
    gust_onset: int | None = None
    delays: Delays | None = field(default=None, repr=False)
    by_chance: ByChance | None = field(default=None, repr=False)
    searched: tuple[type[Effect], ...] = ()

    def name_with(self, effect: str) -> str:
        """The name with the random effect of this name added."""
        return "+".join(sorted([*([] if self.name == "none" else self.name.split("+")), effect]))

    @property
    def blown(self) -> bool:
        """Whether a random force is among its causes; its large noise hides weaker causes."""
        return self.gust or (self.by_chance is not None and self.by_chance.law.form == "force")

    @property
    def began(self) -> int | None:
        """Counted row from which any of its causes acts; None: from the start."""
        return self.gust_onset if self.onset is None else self.onset

    @property
    def white(self) -> WhiteningFilter:
        """The whitening filter of its noise."""
        return whitening_filter(self.hypothesis.record, self.noise.noise, onset=self.onset, gust_onset=self.gust_onset)

    @classmethod
    def of(
        cls,
        hypothesis: Hypothesis,
        fit: GaussNewtonFit,
        noise: NoiseFit,
        log_evidence: float,
        log_likelihood: float,
        onset: int | None = None,
    ) -> Self:
        """The fitted model from a fit under this noise."""
        return cls(
            name=hypothesis.name,
            hypothesis=hypothesis,
            z=fit.z,
            covariance=fit.covariance,
            values={k: float(v) for k, v in hypothesis.values(fit.z[None]).items()},
            noise=noise,
            log_evidence=log_evidence,
            log_likelihood=log_likelihood,
            errors=fit.errors,
            onset=onset,
            grade_rms=fit.grade_rms,
            profile=fit.profile,
        )


@dataclass(frozen=True, eq=False)
class SearchResult:
    """All fitted hypotheses, most evidence first, and their data. `complete` False: the budget ended the search."""

    record: Record
    raw: Record
    logs: tuple[Log, ...]
    found: tuple[FittedModel, ...]
    complete: bool
    scope: Scope = field(default_factory=Scope)

    @property
    def none(self) -> FittedModel:
        return next(f for f in self.found if f.name == "none")

    @property
    def best(self) -> FittedModel:
        return self.found[0]


def first_noise(record: Record) -> NoiseModel:
    """A first guess of the noise, with sensor noise from differences of neighbouring rows."""
    same = np.diff(np.repeat(record.stretch, record.group)) == 0
    sds = [1.4826 / np.sqrt(2) * float(np.median(np.abs(np.diff(x.ravel())[same]))) + 1e-4 for x in record.measured]
    return NoiseModel(**{f"{name}_sd": sd for name, sd in zip(record.channels, sds, strict=True)})


def with_or_without_onset(forms: Sequence[FittedModel]) -> FittedModel:
    """The best form of one cause (whole drive or onset), its evidence averaged over equally likely forms."""
    best = max(forms, key=lambda f: f.log_evidence)
    total = np.logaddexp.reduce([f.log_evidence for f in forms]) - np.log(2.0)
    return replace(best, log_evidence=float(total))


def without_outliers(logs: Sequence[Log], raw: Record, glitches: HeavyTails) -> list[Log]:
    """The logs with outliers of the accelerometer replaced by the mean of the neighbouring rows."""
    hit, offset = raw.source[glitches.hit], 0
    read = [None if log.accel is None else log.accel.copy() for log in logs]
    for cut in raw.cuts:
        accel, log = read[cut.log], logs[cut.log]
        assert accel is not None
        assert log.accel is not None
        first, last = cut.rows.start, cut.rows.stop
        rows = hit[(hit >= offset) & (hit < offset + last - first)] - offset + first
        offset += last - first
        bad = np.zeros(len(accel), bool)
        bad[rows] = True
        for r in rows.tolist():
            near = [k for k in range(max(r - 3, first), min(r + 4, last)) if not bad[k]]
            if near:
                accel[r] = np.median(log.accel[near])
    return [replace(log, accel=accel) for log, accel in zip(logs, read, strict=True)]
