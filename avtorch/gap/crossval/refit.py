"""A fitted model refitted to part of a record, to be scored on the rest.

Onsets are taken from the whole drive: they are facts of this drive, not parameters of a simulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import GaussNewtonFit, finish, grade_marginal, modes, residuals
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_fit import GUST, PRIORS, fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import whitening_filter
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter, acting, sensed
from avtorch.gap.search.fitted_model import FittedModel

_TURNS = 3  # alternations of parameters and noise
_ENOUGH = 0.1  # nats


@dataclass(frozen=True, eq=False)
class Refit:
    """`z` (coordinate,) and `noise` of a model fitted to part of its record; `log_evidence` [nats] on that part.

    `onset`, `gust_onset`: counted rows of the whole record.
    """

    found: FittedModel = field(repr=False)
    fits: Record = field(repr=False)
    z: FloatArray
    covariance: FloatArray = field(repr=False)
    noise: NoiseModel
    log_evidence: float
    onset: int | None
    gust_onset: int | None
    profile: FloatArray | None = field(default=None, repr=False)

    @classmethod
    def of(cls, found: FittedModel, fits: Record) -> Refit:
        """Refit to the rows that count in `fits`, starting from the fit of the whole record."""
        whole = found.hypothesis
        hypothesis = Hypothesis(fits, whole.effects, whole.baseline)
        onset, gust_onset = (_row(r, whole.record, fits) for r in (found.onset, found.gust_onset))
        z, noise = found.z, found.noise.noise
        value = -np.inf
        for _ in range(_TURNS):
            noise = noise.seen_through(
                hypothesis.effects, {k: float(x[0]) for k, x in hypothesis.values(z[None]).items()}
            )
            white = whitening_filter(fits, noise, onset=onset, gust_onset=gust_onset)
            z = modes(hypothesis, white, z[None], onset=onset, iterations=4, enough=_ENOUGH)[0][0]
            errors = residuals(hypothesis, white, z, onset, coarse=False)
            fitted = fit_noise(
                fits,
                errors,
                noise,
                T_L=float(hypothesis.values(z[None])["T_L"][0]),
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
        white = whitening_filter(fits, noise, onset=onset, gust_onset=gust_onset)
        fit: GaussNewtonFit = finish(hypothesis, white, z, onset)
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
    def whole(cls, found: FittedModel) -> Refit:
        """The model as fitted to its whole record."""
        return cls(
            found=found,
            fits=found.hypothesis.record,
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
        return {k: float(v[0]) for k, v in self.found.hypothesis.values(self.z[None]).items()}

    @cached_property
    def errors(self) -> FloatArray:
        """Measurement minus rollout over the whole record, (channel, counted, group)."""
        hypothesis = self.found.hypothesis
        return hypothesis.record.measured - self._rolled(hypothesis, self.z)

    @cached_property
    def effect(self) -> FloatArray:
        """Rollout with its effects minus rollout without them over the whole record, (channel, counted, group)."""
        hypothesis = self.found.hypothesis
        return self._rolled(hypothesis, self.z) - hypothesis.baseline_rollouts(self.z[None])[0]

    @cached_property
    def felt(self) -> FloatArray:
        """The part of `effect` that is due to the accelerometer alone, (channel, counted, group)."""
        hypothesis = self.found.hypothesis
        others = tuple(e for e in hypothesis.effects if e.place != "sensor")
        if len(others) == len(hypothesis.effects):
            return np.zeros_like(self.errors)
        car = Hypothesis(hypothesis.record, others, hypothesis.baseline)
        return self._rolled(hypothesis, self.z) - self._rolled(car, car.z_of(self.values))

    def _rolled(self, hypothesis: Hypothesis, z: FloatArray) -> FloatArray:
        """Rollout (channel, counted, group), with the estimated road grade where the hypothesis has one."""
        record, onset = hypothesis.record, self.onset if hypothesis.effects else None
        rolled = hypothesis.rollouts(z[None], onset)[0]
        if self.profile is None:
            return rolled
        part = hypothesis.grade_response(self.profile)
        noise = self.noise.seen_through(
            hypothesis.effects, {k: float(x[0]) for k, x in hypothesis.values(z[None]).items()}
        )
        return rolled + sensed(record, noise, acting(record, part, onset))

    def around(self, steps: FloatArray) -> FloatArray:
        """Rollouts over the whole record at `z` plus `steps` (step, coordinate): (step, channel, counted, group)."""
        return self.found.hypothesis.rollouts(self.z + steps, self.onset)

    def slope_spread(self, white: WhiteningFilter) -> FloatArray:
        """Standard deviations (axis, channel, counted, group) along the axes of the road grade's posterior.

        The posterior is that of the fitted rows, with errors whitened by `white`.
        """
        whole = self.found.hypothesis
        hypothesis = Hypothesis(self.fits, whole.effects, whole.baseline)
        onset = _row(self.onset, whole.record, self.fits)
        slope = grade_marginal(white, hypothesis, onset, coarse=False)
        errors = hypothesis.errors(self.z[None], onset)
        taken = slope.weighed(white(errors)[0].reshape(1, -1) @ slope.image.T)[1][0]
        columns = whole.grade_columns
        assert columns is not None
        columns = acting(whole.record, columns, self.onset)
        axes = (slope.axes * np.sqrt(taken)).T
        spread = (axes @ columns.reshape(len(columns), -1)).reshape(-1, *columns.shape[1:])
        return sensed(whole.record, self.noise, spread)

    def white(self, record: Record) -> WhiteningFilter:
        """The whitening filter on the rows that count in `record`."""
        whole = self.found.hypothesis.record
        onset, gust_onset = (_row(r, whole, record) for r in (self.onset, self.gust_onset))
        return whitening_filter(record, self.noise, onset=onset, gust_onset=gust_onset)


def _row(row: int | None, of: Record, other: Record) -> int | None:
    """A counted row of one record as a row of another of the same drives; None for None, and for the very first row."""
    if row is None:
        return None
    place = int(np.searchsorted(other.source, of.source[min(row, of.rows - 1)]))
    return min(place, other.rows - 1) or None
