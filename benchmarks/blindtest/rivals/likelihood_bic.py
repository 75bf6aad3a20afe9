"""The classical way: maximum likelihood of every candidate, and the Bayesian information criterion to choose.

Output-error models with process noise and sensor noise only, fitted in the frequency domain
(`spectrum.py`), first on the log thinned to 20 Hz. Those that lead are fitted again at the log's own
rate, and the best one is tried in pairs with each other. There is no answer `unknown`, and no moment of onset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from avtorch.gap import EFFECTS
from avtorch.io import Log
from benchmarks.blindtest.reply import reply, softmax
from benchmarks.blindtest.rivals import chance_causes
from benchmarks.blindtest.rivals.maximum_likelihood import Fitter, MaximumLikelihoodFit
from benchmarks.blindtest.rivals.residuals import Residuals

CHANCE = ("command_hold", "gust", "outliers", "road_grade")
"""Causes identified by the noise, not by the response."""
_SINGLES, _PAIRS = 5, 3  # that are fitted at the full rate
_THIN_HZ = 20.0


@dataclass(frozen=True)
class Scored:
    """A candidate with its score, -BIC / 2, and the fit behind it."""

    names: tuple[str, ...]
    score: float
    fit: MaximumLikelihoodFit


def likelihood_bic(log: Log) -> dict[str, Any]:
    """Answer with `none`, an effect or a pair; probabilities are in proportion to exp(-BIC / 2)."""
    known = candidates(log)
    thin = _Search(Fitter(Residuals.of(log, rate_hz=_THIN_HZ)))
    none = thin.score(())
    found = sorted((thin.score((name,), none.fit) for name in known), key=lambda one: -one.score)
    search = thin
    if round(log.rate_hz / _THIN_HZ) > 1:
        search = _Search(Fitter(Residuals.of(log, rate_hz=log.rate_hz)))
        none = search.score((), none.fit)
        found = [search.score(one.names, one.fit) for one in found[:_SINGLES]]
    best = max(found, key=lambda one: one.score)
    scored = [none, *found]
    if best.score > none.score:
        near = thin.score(best.names).fit
        pairs = [thin.score(_joined(best.names, name), near, steps=1) for name in known if name not in best.names]
        pairs = sorted(pairs, key=lambda one: -one.score)[:_PAIRS]
        scored += [search.score(one.names, one.fit) for one in pairs]
        # backward step: an effect that was added second may suffice without the first
        best = max(scored, key=lambda one: one.score)
        if len(best.names) == 2:
            scored = _with(scored, [search.again((name,), best.fit) for name in best.names if name not in CHANCE])
    return _answer(log, scored, none)


def candidates(log: Log) -> list[str]:
    """Effects that the log's channels can show at all."""
    needs_accel = {"speed_lag", "sensor_lag", "sensor_bias", "sensor_scale", "outliers"}
    return [
        name
        for name, effect in EFFECTS.items()
        if not (effect.needs_speed and log.speed is None) and not (name in needs_accel and log.accel is None)
    ]


class _Search:
    """Scores of candidates on one drive; fits shared by several candidates are computed once."""

    def __init__(self, fitter: Fitter) -> None:
        self.fitter = fitter
        self._price = 0.5 * math.log(fitter.spectrum.rows)
        self._fits: dict[tuple[tuple[str, ...], bool, int], MaximumLikelihoodFit] = {}

    def again(self, names: tuple[str, ...], near: MaximumLikelihoodFit) -> Scored:
        """Score of a deterministic candidate fitted anew from another fit."""
        fit = self.fitter.fit(names, near=near)
        return Scored(names, -fit.loss - len(fit.z) * self._price, fit)

    def score(self, names: tuple[str, ...], near: MaximumLikelihoodFit | None = None, *, steps: int = 12) -> Scored:
        """`near`: a fit to begin from; `steps` at most."""
        plain = tuple(name for name in names if name not in CHANCE)
        chance = [name for name in names if name in CHANCE]
        key = (plain, "gust" in chance, steps)
        if key not in self._fits:
            self._fits[key] = self.fitter.fit(plain, near=near, gust="gust" in chance, steps=steps)
        fit = self._fits[key]
        loss, count = fit.loss, len(fit.z)
        gained = 0.0
        for name in chance:
            count += 2 if name in ("gust", "outliers") else 1
            if name != "gust":
                after = getattr(chance_causes, name)(self.fitter, fit)
                gained += fit.loss - (math.inf if after is None else after)
        return Scored(names, gained - loss - count * self._price, fit)


def _with(scored: list[Scored], more: list[Scored]) -> list[Scored]:
    """The better of two candidates of one name."""
    best = {one.names: one for one in scored}
    for one in more:
        if one.names not in best or one.score > best[one.names].score:
            best[one.names] = one
    return list(best.values())


def _joined(names: tuple[str, ...], name: str) -> tuple[str, ...]:
    return tuple(sorted((*names, name)))


def _answer(log: Log, scored: list[Scored], none: Scored) -> dict[str, Any]:
    weights = softmax([one.score for one in scored])
    named = {"+".join(one.names) or "none": one for one in scored}
    best = max(scored, key=lambda one: one.score)
    probabilities = dict(zip(named, weights.tolist(), strict=True))
    rows = none.fit.transformed.shape[0]
    values = best.fit.values()
    parameters = {name: _reported(one) for name, one in named.items() if one.names}
    onset = parameters.get("gain_change", {}).get("change_s") if best.names == ("gain_change",) else None
    return reply(
        log,
        probabilities,
        why=f"least BIC of {len(scored)} fitted hypotheses, {best.score - none.score:.1f} nats from none, {rows} rows",
        baseline={name: values[name] for name in ("T_L", "K_L")},
        log_evidence={name: one.score - none.score for name, one in named.items()},
        parameters=parameters,
        onset_s=None if onset is None else onset[0],
    )


def _reported(one: Scored) -> dict[str, tuple[float, float]]:
    """Parameters as an answer names them, standard deviations carried over to first order."""
    values = one.fit.values()
    means = {name: torch.tensor(mean, dtype=torch.float64) for name, (mean, _) in values.items()}

    def report_at(at: dict[str, torch.Tensor]) -> dict[str, float]:
        own = one.fit.plant.with_values(at).report()
        pair = len(one.names) > 1
        return {f"{e}.{key}" if pair else key: float(x) for e, keys in own.items() for key, x in keys.items()}

    middle = report_at(means)
    variance = dict.fromkeys(middle, 0.0)
    for name, (mean, sd) in values.items():
        moved = report_at({**means, name: torch.tensor(mean + 0.1 * sd, dtype=torch.float64)})
        for key in middle:
            variance[key] += ((moved[key] - middle[key]) / 0.1) ** 2
    return {key: (middle[key], math.sqrt(variance[key])) for key in middle}
