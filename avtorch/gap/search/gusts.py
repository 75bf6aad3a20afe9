"""Gusts: a slowly coloured force added to a hypothesis and fitted to its residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.gauss_newton import finish, modes
from avtorch.gap.likelihood.noise_fit import GUST, fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import CALM, whitening_filter
from avtorch.gap.search.fitted_model import FittedModel, with_or_without_onset
from avtorch.gap.search.onset import allowed, onset_profile
from avtorch.gap.simulator.effect import Effect


def gust(base: FittedModel, kind: type[Effect]) -> FittedModel:
    """`base` with the coloured force of an effect of this `kind`, over the whole drive or from an onset on."""
    record = base.hypothesis.record
    forms = []
    lag = base.values["T_L"]
    start = base.noise.noise.replaced(force_sd=0.08, force_time=2.0)
    whole = _blown(base, kind, start, lag, None)
    forms.append(whole)
    within = allowed(record.rows, record.dt)
    along = _along(whole)
    onset = within.start + int(np.argmax(along[within]))
    if along[onset] - along[0] > 3:
        late = _blown(base, kind, whole.noise.noise, lag, onset)
        along = _along(late)
        moved = within.start + int(np.argmax(along[within]))
        if abs(moved - onset) * record.dt > 1:
            late = _blown(base, kind, late.noise.noise, lag, moved)
        mass = float(np.log(np.exp(along[within] - along[moved]).sum() / record.rows))
        forms.append(replace(late, log_evidence=late.log_evidence + mass))
    return with_or_without_onset(forms)


def _along(blown: FittedModel) -> FloatArray:
    """Log likelihood (counted,) of an onset of the gust at each row.

    The alternative is the same noise without the gust, because the base's own noise has absorbed part of the gust.
    """
    record, noise = blown.hypothesis.record, blown.noise.noise
    calm, strong = (
        whitening_filter(record, n, onset=blown.onset).row_likelihoods(blown.errors)
        for n in (noise.replaced(force_sd=CALM), noise)
    )
    return onset_profile(calm, strong)


def _blown(base: FittedModel, kind: type[Effect], start: NoiseModel, lag: float, onset: int | None) -> FittedModel:
    record, candidate = base.hypothesis.record, base.hypothesis
    z, errors, fitted = base.z, base.errors, None
    evidence = 0.0
    for _ in range(2):
        onsets = {"onset": base.onset, "gust_onset": onset}
        fitted = fit_noise(
            record, errors, start, T_L=lag, priors=GUST, onset=base.onset, gust_onset=onset, iterations=6
        )
        start = fitted.noise
        white = whitening_filter(record, start, **onsets)
        z = modes(candidate, white, z[None], onset=base.onset, iterations=3)[0][0]
        fit = finish(candidate, white, z, base.onset)
        errors = fit.errors
        evidence = fit.log_evidence + fitted.log_prior
        rows = white.row_likelihoods(errors)
    assert fitted is not None
    return replace(
        base,
        name=base.name_with(kind.name),
        z=z,
        values={k: float(v) for k, v in candidate.values(z[None]).items()},
        noise=fitted,
        errors=errors,
        log_evidence=evidence,
        log_likelihood=float(rows.sum()),
        gust=True,
        searched=(*base.searched, kind),
        gust_onset=onset,
    )
