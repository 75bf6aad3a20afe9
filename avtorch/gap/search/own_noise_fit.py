"""A hypothesis fitted with noise of its own: its parameters, its noise and its onset in turn until all of them rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import log_joint, modes, residuals
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_fit import fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import whitening_filter
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.checkpoint import Checkpoint, StoredFit
from avtorch.gap.search.fitted_model import FittedModel, first_noise, with_or_without_onset
from avtorch.gap.search.initial_values import lag_delay_starts, start_points
from avtorch.gap.search.onset import onset_evidence, refined_onset
from avtorch.gap.search.screening import ENOUGH, Screened
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant

_TURNS = 10  # of parameters and noise, at most
_TRADES = 3  # of a delay for lag that are followed, those that begin best


@dataclass(frozen=True, eq=False)
class OwnNoiseFits:
    """Fits over a `baseline`; those that the `checkpoint` has are not made again."""

    baseline: GapPlant
    checkpoint: Checkpoint

    def bare(self, record: Record) -> FittedModel:
        """The bare baseline, with its noise."""
        hypothesis = Hypothesis(record, (), self.baseline)
        noise = first_noise(record)
        white = WhiteningFilter(record, noise)
        z = np.stack([hypothesis.z_of({"T_L": t, "K_L": 1.0}) for t in (0.12, 0.3, 0.8)])
        found, values = modes(hypothesis, white, z, iterations=6)
        return self.settled(hypothesis, found[values.argmax()], noise, rounds=6)

    def with_effects(self, none: FittedModel, kinds: Sequence[type[Effect]]) -> FittedModel:
        """`none` with effects of these kinds on top from the drives' start, with noise of its own."""
        hypothesis = Hypothesis(none.hypothesis.record, tuple(kinds), self.baseline)
        white = WhiteningFilter(hypothesis.record, none.noise.noise)
        places, values = modes(hypothesis, white, start_points(hypothesis, none.values), iterations=6, coarse=True)
        return self.settled(hypothesis, places[values.argmax()], none.noise.noise)

    def settled(
        self, hypothesis: Hypothesis, z: FloatArray, noise: NoiseModel, *, onset: int | None = None, rounds: int = 2
    ) -> FittedModel:
        """Parameters and noise in turn until both rest."""
        record = hypothesis.record
        start = self.checkpoint.start(hypothesis, z, noise, onset, rounds)
        known = self.checkpoint.next(start)
        if known is not None:
            return known.fitted_model(hypothesis, onset)
        # on averaged commands first, which is several times as fast and ends close by
        for coarse in (True, False) if record.group > 1 else (False,):
            value, best = -np.inf, (z, noise)
            usual = 2 if record.group > 1 and not coarse else rounds + 1
            for turn in range(_TURNS):
                noise = noise.seen_through(hypothesis.effects, self._values(hypothesis, z))
                white = whitening_filter(record, noise, onset=onset)
                enough = ENOUGH if coarse else 0.05
                if turn < 2:  # once under the noise one came with, and once under its own
                    z = self._traded(hypothesis, z, white, onset, coarse)
                z = modes(hypothesis, white, z[None], onset=onset, iterations=4, coarse=coarse, enough=enough)[0][0]
                errors = residuals(hypothesis, white, z, onset, coarse=coarse)
                lag = self._values(hypothesis, z)["T_L"]
                fitted = fit_noise(record, errors, noise, T_L=lag, onset=onset, iterations=3)
                noise = fitted.noise
                new = float(fitted.rows.sum()) + fitted.log_prior - 0.5 * float(z @ z)
                if new > value:
                    best, log_prior = (z, noise), fitted.log_prior
                if new < value + (0.3 if turn < usual - 1 else 3.0):
                    break
                value = new
            z, noise = best
        self.checkpoint.keep(start, StoredFit(z, noise, log_prior))
        return StoredFit(z, noise, log_prior).fitted_model(hypothesis, onset)

    @staticmethod
    def _traded(
        hypothesis: Hypothesis, z: FloatArray, white: WhiteningFilter, onset: int | None, coarse: bool
    ) -> FloatArray:
        """`z`, or the best place from which the fit separates a dead time and the lag better."""
        places = lag_delay_starts(hypothesis, z)
        if not len(places):
            return z
        best = np.argsort(-log_joint(hypothesis, white, places, onset, coarse=coarse))[:_TRADES]
        places = np.concatenate([z[None], places[best]])
        moved, values = modes(hypothesis, white, places, onset=onset, iterations=3, coarse=coarse, enough=ENOUGH)
        return moved[values.argmax()]

    @staticmethod
    def _values(hypothesis: Hypothesis, z: FloatArray) -> dict[str, float]:
        return {key: float(x[0]) for key, x in hypothesis.values(z[None]).items()}

    def best_form(self, forms: Sequence[Screened], noise: NoiseModel) -> FittedModel:
        """One cause over the whole drive and from an onset on; both weigh the same a priori."""
        return with_or_without_onset([self._from_onset(f.hypothesis, f.z, noise, f.onset) for f in forms])

    def _from_onset(self, hypothesis: Hypothesis, z: FloatArray, noise: NoiseModel, onset: int | None) -> FittedModel:
        if onset is None:
            return self.settled(hypothesis, z, noise)
        record = hypothesis.record
        white = whitening_filter(record, noise, onset=onset)
        for _ in range(2):
            z = modes(hypothesis, white, z[None], onset=onset, iterations=4)[0][0]
            moved, _ = refined_onset(white, hypothesis, z, onset)
            if moved == onset:
                break
            onset = moved
        settled = self.settled(hypothesis, z, noise, onset=onset)
        moved, tried = refined_onset(settled.white, hypothesis, settled.z, onset)
        if abs(moved - onset) * record.dt > 0.5:
            settled = self.settled(hypothesis, settled.z, settled.noise.noise, onset=moved)
            _, tried = refined_onset(settled.white, hypothesis, settled.z, moved)
        return replace(settled, log_evidence=settled.log_evidence + onset_evidence(tried, record.dt))
