"""Gusts: a slowly coloured force on top of whatever a candidate's rollout leaves over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.likelihood.earlier import CALM, whitener
from avtorch.gap.likelihood.fit import finish, modes
from avtorch.gap.likelihood.noise_fit import GUST, fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.search.found import Found, merged
from avtorch.gap.search.onset import allowed, profile

Float = NDArray[np.float64]


def gust(base: Found) -> Found:
    """A coloured force on top of `base`, over the whole drive and from an onset on."""
    record = base.candidate.record
    forms = []
    lag = base.values["T_L"]
    start = base.noise.noise.replaced(force_sd=0.08, force_time=2.0)
    whole = _blown(base, start, lag, None)
    forms.append(whole)
    within = allowed(record.rows, record.dt)
    along = _along(whole)
    onset = within.start + int(np.argmax(along[within]))
    if along[onset] - along[0] > 3:
        late = _blown(base, whole.noise.noise, lag, onset)
        along = _along(late)
        moved = within.start + int(np.argmax(along[within]))
        if abs(moved - onset) * record.dt > 1:
            late = _blown(base, late.noise.noise, lag, moved)
        mass = float(np.log(np.exp(along[within] - along[moved]).sum() / record.rows))
        forms.append(replace(late, log_evidence=late.log_evidence + mass))
    return merged(forms)


def _along(blown: Found) -> Float:
    """Log likelihood (counted,) if the gust sets in at each row.

    Against the same noise without the gust; the base's own noise has made room for it.
    """
    record, noise = blown.candidate.record, blown.noise.noise
    calm, strong = (
        whitener(record, n, onset=blown.onset).row_likelihoods(blown.errors)
        for n in (noise.replaced(force_sd=CALM), noise)
    )
    return profile(calm, strong)


def _blown(base: Found, start: NoiseModel, lag: float, onset: int | None) -> Found:
    record, candidate = base.candidate.record, base.candidate
    z, errors, fitted = base.z, base.errors, None
    evidence = 0.0
    for _ in range(2):
        onsets = {"onset": base.onset, "gust_onset": onset}
        fitted = fit_noise(
            record, errors, start, T_L=lag, priors=GUST, onset=base.onset, gust_onset=onset, iterations=6
        )
        start = fitted.noise
        white = whitener(record, start, **onsets)
        z = modes(candidate, white, z[None], onset=base.onset, iterations=3)[0][0]
        fit = finish(candidate, white, z, base.onset)
        errors = fit.errors
        evidence = fit.log_evidence + fitted.log_prior
        rows = white.row_likelihoods(errors)
    assert fitted is not None
    name = "+".join(sorted([*([] if base.name == "none" else base.name.split("+")), "gust"]))
    return replace(
        base,
        name=name,
        z=z,
        values={k: float(v) for k, v in candidate.values(z[None]).items()},
        noise=fitted,
        errors=errors,
        log_evidence=evidence,
        log_likelihood=float(rows.sum()),
        gust=True,
        gust_onset=onset,
    )
