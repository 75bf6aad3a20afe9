"""Fitted models made by hand from short drives, for tests that need a fit and not a search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from avtorch.gap import Effect, GapPlant, plant
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish, modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_fit import GUST, PRIORS, fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.search.lost_messages import LostMessages
from avtorch.gap.search.outliers import HeavyTails
from tests.gap.records import QUIET, log_of

SEED = 5


def found_of(
    effects: list[Effect],
    *,
    seconds: float = 30.0,
    rate_hz: int = 20,
    onset: int | None = None,
    gust_onset: int | None = None,
    rng: np.random.Generator | None = None,
    noise: NoiseModel | None = None,
    baseline: GapPlant | None = None,
    rounds: int = 2,
) -> FittedModel:
    """The hypothesis of these effects fitted to a drive of a car that has them, begun at their true values.

    With a `noise`, errors are drawn from it and it is held. Random effects get the attributes that a search would set.
    """
    sure = [e for e in effects if not e.random]
    car = plant(sure, T_L=0.35, K_L=0.95, baseline=baseline)
    drawn = plant([e.drawn(torch.Generator().manual_seed(1)) for e in car.effects], T_L=0.35, K_L=0.95)
    rng = np.random.default_rng(SEED) if rng is None else rng
    log = log_of(drawn, seconds=seconds, rate_hz=rate_hz, speed0=6.0, rng=rng, noise=QUIET if noise is None else noise)
    record = Record.of(log)
    hypothesis = Hypothesis(record, tuple(type(e) for e in sure), plant() if baseline is None else baseline)
    z = hypothesis.z_of({k: float(v) for k, v in car.values().items() if v.dim() == 0})
    gust = any(e.name == "gust" for e in effects)
    model = NoiseModel() if noise is None else noise
    for _ in range(rounds):
        z = modes(hypothesis, WhiteningFilter(record, model), z[None], onset=onset, iterations=6)[0][0]
        fit = finish(hypothesis, WhiteningFilter(record, model), z, onset)
        fitted = fit_noise(record, fit.errors, model, T_L=0.35, priors=GUST if gust else PRIORS, iterations=3)
        model = fitted.noise if noise is None else noise
    white = WhiteningFilter(record, model)
    z = modes(hypothesis, white, z[None], onset=onset, iterations=6)[0][0]
    fit = finish(hypothesis, white, z, onset)
    names = {e.name for e in effects}
    none = np.zeros(record.rows)
    tails = HeavyTails(9.0, 0.02, 7.0, (0.2, 0.1), none.astype(bool), none) if "outliers" in names else None
    return FittedModel(
        name="+".join(sorted(names)) or "none",
        hypothesis=hypothesis,
        z=z,
        covariance=fit.covariance,
        values={k: float(v) for k, v in hypothesis.values(z[None]).items()},
        noise=fitted if noise is None else replace(fitted, noise=noise),
        log_evidence=fit.log_evidence,
        log_likelihood=fit.log_joint,
        errors=fit.errors,
        onset=onset,
        gust_onset=gust_onset,
        grade_rms=fit.grade_rms,
        profile=fit.profile,
        tails=tails,
        losses=LostMessages(9.0, 0.1, 0.3, None) if "command_hold" in names else None,
        gust=gust,
        searched=tuple(type(e) for e in effects if e.own_search()),
    )
