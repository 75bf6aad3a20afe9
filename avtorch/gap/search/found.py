"""A candidate once it is fitted, all of them after a search, and what a search begins from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.likelihood.candidate import Candidate
from avtorch.gap.likelihood.earlier import whitener
from avtorch.gap.likelihood.fit import Fit
from avtorch.gap.likelihood.noise_fit import NoiseFit
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitener import Whitener
from avtorch.gap.search.chance import Tails
from avtorch.gap.search.losses import Losses
from avtorch.io import Log

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Found:
    """A candidate fitted: `name`, `z` and parameter `values` at the mode, `log_evidence` [nats], `errors`.

    `onset`, `gust_onset`: counted rows from which its effects act and a gust blows, None: from the start. `tails`,
    `losses`: what random effects among its names found.
    """

    name: str
    candidate: Candidate
    z: Float = field(repr=False)
    covariance: Float = field(repr=False)
    values: Mapping[str, float]
    noise: NoiseFit = field(repr=False)
    log_evidence: float
    log_likelihood: float
    errors: Float = field(repr=False)
    onset: int | None = None
    grade_rms: float | None = None
    profile: Float | None = field(default=None, repr=False)
    tails: Tails | None = field(default=None, repr=False)
    losses: Losses | None = field(default=None, repr=False)
    gust: bool = False
    gust_onset: int | None = None

    @property
    def began(self) -> int | None:
        """Counted row from which anything of it acts; None: from the start."""
        return self.gust_onset if self.onset is None else self.onset

    @property
    def white(self) -> Whitener:
        """Of errors under its noise."""
        return whitener(self.candidate.record, self.noise.noise, onset=self.onset, gust_onset=self.gust_onset)

    @classmethod
    def of(
        cls,
        candidate: Candidate,
        fit: Fit,
        noise: NoiseFit,
        log_evidence: float,
        log_likelihood: float,
        onset: int | None = None,
    ) -> Self:
        """From a fit under this noise."""
        return cls(
            name=candidate.name,
            candidate=candidate,
            z=fit.z,
            covariance=fit.covariance,
            values={k: float(v) for k, v in candidate.values(fit.z[None]).items()},
            noise=noise,
            log_evidence=log_evidence,
            log_likelihood=log_likelihood,
            errors=fit.errors,
            onset=onset,
            grade_rms=fit.grade_rms,
            profile=fit.profile,
        )


@dataclass(frozen=True, eq=False)
class Race:
    """All candidates found, most evidence first, and what they were found on."""

    record: Record
    raw: Record
    logs: tuple[Log, ...]
    found: tuple[Found, ...]
    complete: bool

    @property
    def none(self) -> Found:
        return next(f for f in self.found if f.name == "none")

    @property
    def best(self) -> Found:
        return self.found[0]


def white_first(record: Record) -> NoiseModel:
    """Sensor noise from what rows beside each other differ by, as a first guess."""
    same = np.diff(np.repeat(record.stretch, record.group)) == 0
    sds = [1.4826 / np.sqrt(2) * float(np.median(np.abs(np.diff(x.ravel())[same]))) + 1e-4 for x in record.measured]
    return NoiseModel(**{f"{name}_sd": sd for name, sd in zip(record.witnesses, sds, strict=True)})


def merged(forms: Sequence[Found]) -> Found:
    """One cause in several forms (over the whole drive, from an onset on), equally likely a priori."""
    best = max(forms, key=lambda f: f.log_evidence)
    total = np.logaddexp.reduce([f.log_evidence for f in forms]) - np.log(2.0)
    return replace(best, log_evidence=float(total))


def cleaned(logs: Sequence[Log], raw: Record, glitches: Tails) -> list[Log]:
    """The logs with glitches of the accelerometer put to the middle of the rows beside them."""
    hit = raw.source[glitches.hit]
    out, offset = [], 0
    for log in logs:
        assert log.accel is not None
        accel = log.accel.copy()
        rows = []
        for part in log.segments():
            size = part.stop - part.start
            if size < 2 * 20:
                continue
            inside = hit[(hit >= offset) & (hit < offset + size)] - offset + part.start
            rows.extend(inside.tolist())
            offset += size
        bad = np.zeros(len(accel), bool)
        bad[rows] = True
        for r in rows:
            near = [k for k in range(max(r - 3, 0), min(r + 4, len(accel))) if not bad[k]]
            if near:
                accel[r] = np.median(log.accel[near])
        out.append(replace(log, accel=accel))
    return out
