"""A chain of effects that answers as a simulator does: its surrogate.

A simulator whose inside is unknown is identified by its own output, as a car is; but it has no noise, so what decides
is least squares, and how much of the response is left to explain:

    log L = -1/2 sum_c |R_c|² / s_c²

with coefficients R (channel, frame, bin) below 10 Hz and the size s (channel,) [m/s²] of what is left. Frames held out
say whether an effect is there. The surrogate stands in for the simulator wherever one has to ask what it would have
done with another parameter or with an effect more; what it leaves over is known, and stays the simulator's own
(`discrepancy`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.car import plant_of
from avtorch.gap.engine.coordinates import EFFECTS as ATOMS
from avtorch.gap.engine.coordinates import EngineEffect, adopt
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit, jacobian, objective, prior_terms, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import CLAIM_HZ
from avtorch.gap.engine.search import other_limit, promises
from avtorch.gap.simulator.effect import EFFECTS
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log

_LATE_S = 0.1  # either way, of the speed against the acceleration: a step of the slowest simulators
_FOLDS = 6


@dataclass(eq=False)
class NoiseFree(Hypothesis):
    """A hypothesis about a simulator's output, whose errors have the size `sd` (channel,) [m/s²] and no colour."""

    sd: FloatArray = field(default_factory=lambda: np.ones(1))

    @property
    def free(self) -> list[str]:
        """Names of the coordinates that a fit moves: lag and gain, the speed's lateness, those of the effects."""
        late = ["speed_delay"] if self.data.channel_count == 2 else []
        return ["T_L", "K_L", *late, *(c.name for e in self.effects for c in ATOMS[e].coordinates)]

    def limits(self, name: str) -> tuple[float, float]:
        return (-_LATE_S, _LATE_S) if name == "speed_delay" else super().limits(name)

    def copy(self) -> Self:
        other = super().copy()
        other.sd = self.sd
        return other

    def with_sd(self, sd: FloatArray) -> Self:
        """The same hypothesis with errors of another size."""
        other = self.copy()
        other.sd = sd
        return other.evaluate()

    def fitted(self, iterations: int = 8) -> Self:
        """The hypothesis at its best, changed in place."""
        fit(self, iterations)
        return self

    def evaluate(self) -> Self:
        self.predicted = self.response()
        self.residual = self.data.measured - self.predicted
        self.covariance = np.broadcast_to(np.diag(self.sd**2), (self.data.band_count, len(self.sd), len(self.sd)))
        self.log_likelihood = -0.5 * float((whiten(self.data, self.covariance, self.residual) ** 2).sum())
        return self

    @property
    def errors(self) -> FloatArray:
        """Root mean square (channel,) [m/s²] of what is left."""
        return np.sqrt((self.residual**2).sum((1, 2)) / (self.data.frame_count * self.data.frame_rows))

    @property
    def held_out(self) -> float:
        """Root mean square of what is left of frames that the fit did not see, over `sd`, to first order."""
        names, data = self.free, self.data
        by_frame = (data.channel_count, data.frame_count, data.bin_count)
        W = whitened_jacobian(self, jacobian(self, names)).reshape(len(names), *by_frame)
        r = whiten(data, self.covariance, self.residual).reshape(by_frame)
        precision, pull = prior_terms(self, names)
        each = np.einsum("icfk,jcfk->fij", W, W, optimize=True)
        scores = np.einsum("icfk,cfk->fi", W, r, optimize=True)
        fold = np.arange(data.frame_count) % min(_FOLDS, data.frame_count)
        total = 0.0
        for k in range(int(fold.max()) + 1):
            own = fold == k
            A = each[~own].sum(0) + np.diag(precision)
            step = np.linalg.lstsq(A, scores[~own].sum(0) + pull, rcond=None)[0]
            total += float(((r[:, own] - np.tensordot(step, W[:, :, own], 1)) ** 2).sum())
        return float(np.sqrt(total / r.size))


MOST_EFFECTS = 8
ENOUGH = 0.002
"""Share of the response (root mean square) that may be left over."""
_WORTH = 0.95  # of the errors on frames held out, that an effect must leave at most
_PER_PARAMETER = 1.5  # times smaller errors, that a parameter more has to be worth when two effects compete
_FITTED, _HELD_OUT = 16, 4  # effects fitted, those that promise most, and held out of these
_LAGS_S = (0.07, 0.15, 0.3, 0.6)  # from which the first fits begin
_SHORTER = 0.5  # of a lag that gives its time to a delay or a second pole
_FIRST_ERROR = 0.1  # of the response
_LEAST_ERROR = 1e-5  # of the response, so that a perfect fit has a scale


@dataclass(frozen=True)
class Surrogate:
    """`plant`: the chain that answers as the simulator does; `left`: share of the response that it does not, by channel
    (root mean squares, of acceleration and of the derivative of speed, below 10 Hz)."""

    plant: GapPlant
    left: Mapping[str, float]


def surrogate_of(
    simulated: Sequence[Log],
    *,
    enough: float = ENOUGH,
    progress: Callable[[str, int, int], None] | None = None,
) -> Surrogate:
    """The surrogate of the simulator whose output these logs are.

    `enough`: share of the response that may be left over.
    `progress(what, done, of)` is called at each effect.

    Raises `InputError` where the drives are too short, see `DriveData.of`.
    """
    data = DriveData.of(simulated)
    size = np.std(data.channel_rows(data.accel, data.speed), axis=1) + 1e-9
    data = data.below(CLAIM_HZ)
    bare = [NoiseFree(data, sd=_FIRST_ERROR * size) for _ in _LAGS_S]
    for h, lag in zip(bare, _LAGS_S, strict=True):
        h["T_L"] = lag
    now = max((h.fitted(15) for h in bare), key=objective)
    kinds = _kinds(data)
    for number in range(MOST_EFFECTS):
        if progress is not None:
            progress("simulator", number, MOST_EFFECTS)
        if (now.errors < enough * size).all():
            break
        now = now.with_sd(np.maximum(now.errors, _LEAST_ERROR * size)).fitted()
        entered = _entered(now, [e for e in kinds if e.base not in now.names])
        if entered is None:
            break
        now = entered
    now = _without_the_idle(now, size, enough)
    now = now.with_sd(np.maximum(now.errors, _LEAST_ERROR * size)).fitted()
    left = dict(zip(data.channels, (now.errors / size).tolist(), strict=True))
    return Surrogate(plant_of(now, plant([], sigma=0.0)), left)


def _kinds(data: DriveData) -> list[EngineEffect]:
    """Effects that a simulator can have: the same on every drive, by no chance, and seen in these channels."""
    kinds = [k for k in EFFECTS.values() if not (k.random or k.of_the_drive or k.own_onset)]
    for kind in kinds:
        adopt(kind)
    names = {kind.name for kind in kinds}
    return [
        replace(e, onset="never")
        for e in ATOMS.values()
        if e.base in names and e.onset != "must" and e.coordinates and e.needs <= set(data.channels)
    ]


def _entered(now: NoiseFree, kinds: Sequence[EngineEffect]) -> NoiseFree | None:
    """The model with the effect that leaves least on frames held out; an effect with more parameters has to leave
    less for each. None where no effect is worth it."""
    before, starts = now.held_out, dict[str, list[tuple[float, ...]]]()
    for promise in promises(now, kinds):
        if promise.effect in starts or len(starts) < _FITTED:
            starts.setdefault(promise.effect, []).append(promise.start)
    rough = [max((h.fitted(4) for h in _begun(now, e, starts[e])), key=objective) for e in starts]
    best = sorted(rough, key=lambda h: -objective(h))[:_HELD_OUT]
    fits = [_with_limits(h.fitted(12)) for h in best]
    left = [h.held_out / before for h in fits]
    worth = [(share * _PER_PARAMETER ** len(h.free), n) for n, (share, h) in enumerate(zip(left, fits, strict=True))]
    worth = [(value, n) for value, n in worth if left[n] < _WORTH]
    return fits[min(worth)[1]] if worth else None


def _begun(now: NoiseFree, effect: str, starts: Sequence[tuple[float, ...]]) -> list[NoiseFree]:
    """The model with one more effect at each of `starts`; a lag and a delay trade places, so from a shorter lag too."""
    out = [now.with_effect(effect, start) for start in starts]
    for h in list(out):
        if EFFECTS[ATOMS[effect].base].memory or effect in ("second_order_actuator", "rate_limit"):
            shorter = h.copy()
            shorter["T_L"] *= _SHORTER
            out.append(shorter)
    return out


def _with_limits(h: NoiseFree) -> NoiseFree:
    """The model with limits of the command that a fit put out of reach brought back, where that explains more."""
    found = other_limit(h)
    assert isinstance(found, NoiseFree)
    return found


def _without_the_idle(now: NoiseFree, size: FloatArray, enough: float) -> NoiseFree:
    """The model without effects that the others make superfluous, the most superfluous first."""
    while now.effects:
        errors = np.maximum(now.errors, _LEAST_ERROR * size)
        without = [now.without(e).with_sd(errors).fitted() for e in now.effects]
        cost = [float((h.errors / np.maximum(errors, enough * size)).max()) for h in without]
        if min(cost) > 1 / _WORTH:
            break
        now = without[int(np.argmin(cost))]
    return now
