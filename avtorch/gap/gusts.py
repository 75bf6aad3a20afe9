"""Gusts: a slowly coloured force on top of whatever a candidate's rollout leaves over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avtorch.gap.fit import finish, modes
from avtorch.gap.found import Found, merged
from avtorch.gap.innovations import NoiseModel, Whitener
from avtorch.gap.noise_fit import CALM, GUST, fit_noise, row_likelihoods
from avtorch.gap.onset import allowed, profile


def gust(base: Found) -> Found:
    """A coloured force on top of `base`, over the whole drive and from an onset on."""
    record = base.candidate.record
    forms = []
    lag = base.values["T_L"]
    start = base.noise.noise.replaced(force_sd=0.08, force_time=2.0)
    whole = _blown(base, start, lag, None)
    forms.append(whole)
    rows = row_likelihoods(record, whole.errors, whole.noise.noise)
    # against the same noise without the gust; the base's own noise has made room for it
    calm = row_likelihoods(record, whole.errors, whole.noise.noise.replaced(force_sd=CALM))
    along = profile(calm, rows)
    within = allowed(record.rows, record.dt)
    onset = within.start + int(np.argmax(along[within]))
    if along[onset] - along[0] > 3:
        late = _blown(base, whole.noise.noise, lag, onset)
        strong = row_likelihoods(record, late.errors, late.noise.noise)
        quiet = row_likelihoods(record, late.errors, late.noise.noise.replaced(force_sd=CALM))
        along = profile(quiet, strong)
        moved = within.start + int(np.argmax(along[within]))
        if abs(moved - onset) * record.dt > 1:
            late = _blown(base, late.noise.noise, lag, moved)
        mass = float(np.log(np.exp(along[within] - along[moved]).sum() / record.rows))
        forms.append(replace(late, log_evidence=late.log_evidence + mass))
    return merged(forms)


def _blown(base: Found, start: NoiseModel, lag: float, onset: int | None) -> Found:
    record, candidate = base.candidate.record, base.candidate
    z, errors, fitted = base.z, base.errors, None
    evidence = 0.0
    for _ in range(2):
        fitted = fit_noise(record, errors, start, T_L=lag, priors=GUST, onset=onset, iterations=6)
        start = fitted.noise
        white = Whitener(record, start)
        if onset is None or base.onset is not None:
            z = modes(candidate, white, z[None], onset=base.onset, iterations=3)[0][0]
        fit = finish(candidate, white, z, base.onset)
        errors = fit.errors
        evidence = fit.log_evidence - fit.log_joint + float(fitted.rows.sum()) - 0.5 * float(z @ z)
    assert fitted is not None
    rows = row_likelihoods(record, errors, fitted.noise, onset)
    prior = evidence - float(fitted.rows.sum())
    name = "+".join(sorted([*([] if base.name == "none" else base.name.split("+")), "gust"]))
    return replace(
        base,
        name=name,
        z=z,
        values={k: float(v) for k, v in candidate.values(z[None]).items()},
        noise=fitted,
        errors=errors,
        log_evidence=prior + float(rows.sum()) + fitted.log_prior,
        log_likelihood=float(rows.sum()),
        onset=onset if base.onset is None else base.onset,
        gust=True,
    )
