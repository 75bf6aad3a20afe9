"""A find fitted anew to part of a record, to be judged by the rest.

When its effects set in is taken from all of the drive: that is a fact of this drive, and no parameter of a simulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.likelihood.candidate import Candidate
from avtorch.gap.likelihood.earlier import whitener
from avtorch.gap.likelihood.fit import Fit, acting, finish, left_over, modes, slope_of
from avtorch.gap.likelihood.noise_fit import GUST, PRIORS, fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitener import Whitener, sensed
from avtorch.gap.search.found import Found

Float = NDArray[np.float64]

_TURNS = 3  # of parameters and noise
_ENOUGH = 0.1  # nats


@dataclass(frozen=True, eq=False)
class Refit:
    """`z` (coordinate,) and `noise` of a find as part of its record has them; `log_evidence` [nats] on that part.

    `onset`, `gust_onset`: counted rows of the whole record.
    """

    found: Found = field(repr=False)
    fits: Record = field(repr=False)
    z: Float
    covariance: Float = field(repr=False)
    noise: NoiseModel
    log_evidence: float
    onset: int | None
    gust_onset: int | None
    profile: Float | None = field(default=None, repr=False)

    @classmethod
    def of(cls, found: Found, fits: Record) -> Refit:
        """To those rows that count in `fits`, from where the whole record's fit has come to rest."""
        whole = found.candidate
        candidate = Candidate(fits, whole.effects, whole.baseline)
        onset, gust_onset = (_row(r, whole.record, fits) for r in (found.onset, found.gust_onset))
        z, noise = found.z, found.noise.noise
        value = -np.inf
        for _ in range(_TURNS):
            noise = noise.seen_through({k: float(x[0]) for k, x in candidate.values(z[None]).items()})
            white = whitener(fits, noise, onset=onset, gust_onset=gust_onset)
            z = modes(candidate, white, z[None], onset=onset, iterations=4, enough=_ENOUGH)[0][0]
            errors = left_over(candidate, white, z, onset, coarse=False)
            fitted = fit_noise(
                fits,
                errors,
                noise,
                T_L=float(candidate.values(z[None])["T_L"][0]),
                priors=GUST if found.gust else PRIORS,
                onset=onset,
                gust_onset=gust_onset,
                iterations=3,
            )
            noise = fitted.noise
            new = float(fitted.rows.sum()) + fitted.log_prior - 0.5 * float(z @ z)
            if new < value + 1.0:
                break
            value = new
        white = whitener(fits, noise, onset=onset, gust_onset=gust_onset)
        fit: Fit = finish(candidate, white, z, onset)
        return cls(
            found=found,
            fits=fits,
            z=z,
            covariance=fit.covariance,
            noise=noise,
            log_evidence=fit.log_evidence + fitted.log_prior,
            onset=found.onset,
            gust_onset=found.gust_onset,
            profile=fit.profile,
        )

    @classmethod
    def whole(cls, found: Found) -> Refit:
        """As it was found, on all of its record."""
        return cls(
            found=found,
            fits=found.candidate.record,
            z=np.asarray(found.z),
            covariance=found.covariance,
            noise=found.noise.noise,
            log_evidence=found.log_evidence,
            onset=found.onset,
            gust_onset=found.gust_onset,
            profile=found.profile,
        )

    @property
    def name(self) -> str:
        return self.found.name

    @cached_property
    def values(self) -> Mapping[str, float]:
        """Parameters by the plant's keys."""
        return {k: float(v[0]) for k, v in self.found.candidate.values(self.z[None]).items()}

    @cached_property
    def errors(self) -> Float:
        """Measured less rolled out over the whole record, (witness, counted, group)."""
        candidate = self.found.candidate
        return candidate.record.measured - self._rolled(candidate, self.z)

    @cached_property
    def effect(self) -> Float:
        """What its effects do over the whole record, (witness, counted, group): its rollout less one without them."""
        candidate = self.found.candidate
        return self._rolled(candidate, self.z) - candidate.baseline_rollouts(self.z[None])[0]

    @cached_property
    def felt(self) -> Float:
        """What of that is the accelerometer's alone, (witness, counted, group)."""
        candidate = self.found.candidate
        others = tuple(e for e in candidate.effects if e.place != "sensor")
        if len(others) == len(candidate.effects):
            return np.zeros_like(self.errors)
        car = Candidate(candidate.record, others, candidate.baseline)
        return self._rolled(candidate, self.z) - self._rolled(car, car.z_of(self.values))

    def _rolled(self, candidate: Candidate, z: Float) -> Float:
        """Rollout (witness, counted, group) with the slope that was found, where the candidate has one."""
        record, onset = candidate.record, self.onset if candidate.effects else None
        rolled = candidate.rollouts(z[None], onset)[0]
        if self.profile is None:
            return rolled
        part = candidate.grade_response(self.profile)
        noise = self.noise.seen_through({k: float(x[0]) for k, x in candidate.values(z[None]).items()})
        return rolled + sensed(record, noise, acting(whitener(record, noise, onset=onset), part, onset))

    def around(self, steps: Float) -> Float:
        """Rollouts over the whole record at `z` plus `steps` (step, coordinate): (step, witness, counted, group)."""
        return self.found.candidate.rollouts(self.z + steps, self.onset)

    def slope_spread(self, white: Whitener) -> Float:
        """Standard deviations (axis, witness, counted, group) along the axes of the slope's posterior.

        As errors made `white` on the rows that fit tell it.
        """
        whole = self.found.candidate
        candidate = Candidate(self.fits, whole.effects, whole.baseline)
        onset = _row(self.onset, whole.record, self.fits)
        slope = slope_of(white, candidate, onset, coarse=False)
        errors = candidate.errors(self.z[None], onset)
        taken = slope.weighed(white(errors)[0].reshape(1, -1) @ slope.image.T)[1][0]
        columns = whole.grade_columns
        assert columns is not None
        columns = acting(self.white(whole.record), columns, self.onset)
        axes = (slope.axes * np.sqrt(taken)).T
        return sensed(whole.record, self.noise, np.einsum("ak,kwrg->awrg", axes, columns))

    def white(self, record: Record) -> Whitener:
        """Of errors on the rows that count in `record`."""
        whole = self.found.candidate.record
        onset, gust_onset = (_row(r, whole, record) for r in (self.onset, self.gust_onset))
        return whitener(record, self.noise, onset=onset, gust_onset=gust_onset)


def _row(row: int | None, of: Record, other: Record) -> int | None:
    """A counted row of one record among those of another of the same drives; None for none, or for the very first."""
    if row is None:
        return None
    place = int(np.searchsorted(other.source, of.source[min(row, of.rows - 1)]))
    return min(place, other.rows - 1) or None
