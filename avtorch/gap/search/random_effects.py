"""Random effects as hypotheses: their `noise` is added to a fitted model and fitted to its residuals.

One effect of each kind may have a search of its own (`Effect.searched_as`), which also finds an onset. Any other is
fitted by the likelihood with its `noise`, over the whole drive: a force together with the lag, the gain and the other
noise; errors of the command together with the jerk noise, which they resemble; tails row by row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish, modes
from avtorch.gap.likelihood.noise_fit import PRIORS, fit_noise
from avtorch.gap.likelihood.noise_segments import whitening_filter
from avtorch.gap.likelihood.random_law import Form, RandomLaw
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.command_errors import command_error_gains
from avtorch.gap.search.fitted_model import ByChance, FittedModel
from avtorch.gap.search.full_rate import full_rate_errors, full_rate_filter
from avtorch.gap.search.gusts import gust
from avtorch.gap.search.outliers import HeavyTails, hessian_of
from avtorch.gap.simulator.effect import Effect, SearchedAs
from avtorch.gap.simulator.observability import is_observable
from avtorch.gap.simulator.plant import GapPlant

_TURNS = 4  # alternations of parameters and noise
_ENOUGH = 0.1  # nats
_SIMPLEX = -0.7  # initial step in prior standard deviations


@dataclass(frozen=True, eq=False)
class RandomEffects:
    """Those of a search: `own` with a search of their own, the first of each kind; `laws` of all others, by form."""

    own: Mapping[SearchedAs, type[Effect]]
    laws: Mapping[Form, Sequence[RandomLaw]]

    @classmethod
    def of(cls, effects: Sequence[type[Effect]], raw: Record, baseline: GapPlant) -> RandomEffects:
        own: dict[SearchedAs, type[Effect]] = {}
        for kind in effects:
            searched = kind.own_search()
            if searched is not None:
                own.setdefault(searched, kind)
        laws: dict[Form, list[RandomLaw]] = {"force": [], "tails": [], "command": []}
        for kind in effects:
            if kind.random and kind not in own.values() and is_observable(kind, raw.channels):
                law = RandomLaw.of(kind, raw, baseline)
                laws[law.form].append(law)
        return cls(own, laws)

    def has(self, form: Literal["force", "tails"]) -> bool:
        """Whether any of them is a force, or tails."""
        return form in self.own or bool(self.laws[form])

    def forced(self, on: FittedModel) -> list[FittedModel]:
        """Every random force on top of a find."""
        own = [gust(on, self.own["force"])] if "force" in self.own else []
        return [*own, *(forced(on, law) for law in self.laws["force"])]

    def forced_as(self, blown: FittedModel, on: FittedModel) -> FittedModel:
        """The random force of `blown` on top of another find."""
        return gust(on, self.own["force"]) if blown.by_chance is None else forced(on, blown.by_chance.law)


def forced(base: FittedModel, law: RandomLaw) -> FittedModel:
    """`base` with a random force, fitted jointly with the lag, the gain, the base's effects and all of the noise."""
    candidate, record = base.hypothesis, base.hypothesis.record
    best: FittedModel | None = None
    for begin in (0.0, -1.0):  # typical, and weaker
        z, noise, errors = base.z, base.noise.noise, base.errors
        law_z: FloatArray = np.full(law.size, begin)
        value = -np.inf
        for _ in range(_TURNS):
            lag = float(candidate.values(z[None])["T_L"][0])
            fitted = fit_noise(record, errors, noise, T_L=lag, onset=base.onset, law=law, law_z=law_z)
            assert fitted.law_z is not None
            noise, law_z = fitted.noise, fitted.law_z
            white = whitening_filter(record, noise, onset=base.onset)
            z = modes(candidate, white, z[None], onset=base.onset, iterations=3)[0][0]
            fit = finish(candidate, white, z, base.onset)
            errors = fit.errors
            evidence = fit.log_evidence + fitted.log_prior
            if evidence < value + _ENOUGH:
                break
            value = evidence
        assert fitted.law_covariance is not None
        found = replace(
            base,
            name=base.name_with(law.name),
            z=z,
            covariance=fit.covariance,
            values={k: float(v) for k, v in candidate.values(z[None]).items()},
            noise=fitted,
            errors=errors,
            grade_rms=fit.grade_rms,
            profile=fit.profile,
            log_evidence=evidence,
            log_likelihood=float(white.row_likelihoods(errors).sum()),
            by_chance=ByChance(law, law_z, fitted.law_covariance),
        )
        if best is None or found.log_evidence > best.log_evidence:
            best = found
    assert best is not None
    return best


def tailed(base: FittedModel, law: RandomLaw, tails: HeavyTails) -> FittedModel:
    """`base` with tails added."""
    assert tails.z is not None
    assert tails.covariance is not None
    by_chance = ByChance(law, tails.z, tails.covariance)
    evidence = base.log_evidence + tails.evidence
    return replace(base, name=base.name_with(law.name), log_evidence=evidence, tails=tails, by_chance=by_chance)


def glitched(
    found: Sequence[FittedModel], glitches: Sequence[tuple[RandomLaw | type[Effect], HeavyTails]], *, pairs: bool
) -> list[FittedModel]:
    """Tails alone and, where pairs are tried, added to every single effect.

    Each comes with the law of its effect, or with its class where the effect has a search of its own.
    """
    out = []
    for f in found:
        names = [] if f.name == "none" else f.name.split("+")
        if len(names) > 1 or (names and not pairs):
            continue
        for of, tails in glitches:
            if not isinstance(of, RandomLaw):
                own = {"name": f.name_with(of.name), "searched": (*f.searched, of), "tails": tails}
                out.append(replace(f, log_evidence=f.log_evidence + tails.evidence, **own))
            elif f.by_chance is None:
                out.append(tailed(f, of, tails))
    return out


def commanded(base: FittedModel, law: RandomLaw, raw: Record) -> FittedModel:
    """`base` with errors of the command, fitted jointly with the size of the jerk noise, which passes the same lag."""
    errors, plain = full_rate_errors(raw, base), full_rate_filter(raw, base)
    T_L, K_L = base.values["T_L"], base.values["K_L"]
    _, spread, _ = PRIORS["process_sd"]
    own = base.noise.noise.process_sd
    centre = float(np.log(own) - PRIORS["process_sd"][0]) / spread
    flat = float(plain.row_likelihoods(errors).sum())

    def white(shift: float) -> WhiteningFilter:
        return WhiteningFilter(raw, plain.noise.replaced(process_sd=own * float(np.exp(spread * shift))))

    def without(x: FloatArray) -> float:
        return flat - float(white(x[0]).row_likelihoods(errors).sum()) + 0.5 * ((centre + x[0]) ** 2 - centre**2)

    def cost(x: FloatArray) -> float:
        if abs(x[0]) > 3 or np.abs(x[1:]).max(initial=0.0) > 5:
            return 1e9 * (1 + float(np.abs(x).max()))
        variance = variance_of(law, x[1:], base, raw)
        gained = float(command_error_gains(white(x[0]), errors, variance, T_L, K_L).sum())
        return without(x) - gained + 0.5 * float(x[1:] @ x[1:])

    # start with less jerk noise, as it has absorbed part of these errors
    begin = np.concatenate([[-0.3], np.zeros(law.size)])
    simplex = begin + np.concatenate([np.zeros((1, len(begin))), _SIMPLEX * np.eye(len(begin))])
    options = {"xatol": 0.02, "fatol": 0.05, "maxfev": 100 * (1 + law.size), "initial_simplex": simplex}
    best = minimize(cost, begin, method="Nelder-Mead", options=options)
    hessian = hessian_of(cost, best.x)
    # the prior of the jerk noise's size is already included in the base
    curvature = max(float(hessian_of(without, np.zeros(1))[0, 0]), 1.0)
    evidence = -float(best.fun) - 0.5 * float(np.linalg.slogdet(hessian)[1]) + 0.5 * float(np.log(curvature))
    covariance = np.asarray(np.linalg.inv(hessian)[1:, 1:], np.float64)
    sd = own * float(np.exp(spread * best.x[0]))
    by_chance = ByChance(law, best.x[1:], covariance, explained=evidence, process_sd=sd)
    return replace(base, name=base.name_with(law.name), log_evidence=base.log_evidence + evidence, by_chance=by_chance)


def variance_of(law: RandomLaw, z: FloatArray, base: FittedModel, raw: Record) -> FloatArray:
    """Variance of the command's errors at the actuator, (counted,) [(m/s²)²], delayed where the base has a delay."""
    late = 0.0
    for e in base.hypothesis.effects:
        if e.shift is not None and law.effect.order <= e.order:
            late += base.values[f"{e.name}.{e.shift}"]
    parts, first = [], 0
    whole = law.command_variance(z, raw.drives)
    for drive in raw.drives:
        own = whole[first : first + len(drive.time)]
        rows = np.arange(len(own)) - round(late / raw.dt)
        parts.append(own[rows.clip(0)])
        first += len(own)
    return np.concatenate(parts)[raw.source]
