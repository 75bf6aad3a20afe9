"""Score tests: what an effect would gain, from one simulation and one step of least squares.

The white residuals of a fit are regressed on the change that an effect makes to the response, together with the slopes
of the parameters so far, which give way. This ranks effects, the places to start their fits from, and onsets at any
row, without a fit of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated

_OTHER_SIZES = (0.7, 1.4)  # times the baseline's own value
_FAINT = -2.0  # prior SD, for effects that name no first values
_MOST_STARTS = 60
_LIMITS = 12  # places over the physical range, for a parameter whose effect vanishes at infinity
_LEAST, _LARGEST = 0.1, 6.0  # times the first size, that a size may become
_ROOM = 3.0  # times faster or slower, for an effect that has no size
_LONGEST = 1.5  # step of the parameters so far [prior SD]
_SHORTER = -1.0  # prior SD of a lag that gives its time to a delay
_BEST = 3  # places to start from


@dataclass(frozen=True, eq=False)
class Candidate:
    """A `model` with one effect more, promising places (start, size) to fit it from, and what they `promise` [nats].

    `late`: the same with the effect from the onset on that promises most.
    """

    model: EffectModel
    starts: FloatArray
    promise: float
    late: Candidate | None = None


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """The neighbourhood of a fit: white residuals and slopes, weighted by rows as the fit's next step would be.

    `white`, `weight` (value,) over channels and counted rows, `slope` (size, value), `inverse` (size, size) of the
    curvature, `downhill` (size,).
    """

    fitting: RobustFit
    fit: Fit
    white: FloatArray
    weight: FloatArray
    slope: FloatArray
    inverse: FloatArray
    downhill: FloatArray

    @classmethod
    def at(cls, fitting: RobustFit, fit: Fit) -> ScoreTest:
        white = fitting.white(fit.model, fit.z)
        slope = fitting.slope(fit.model, fit.z, white).reshape(fit.model.size, -1)
        weight = np.tile(fitting.weights(white, np.ones(fitting.whitening.blocks)), len(white))
        curvature = (slope * weight) @ slope.T + np.eye(fit.model.size)
        downhill = (slope * weight) @ white.ravel() - fit.z
        return cls(fitting, fit, white.ravel(), weight, slope, np.asarray(np.linalg.inv(curvature), float), downhill)

    def candidate(self, kind: type[Effect]) -> Candidate:
        """The fit's model with `kind`, present from the start on."""
        model = self.fit.model.with_effect(kind)
        starts = _starts(model, self.fit, kind)
        if issubclass(kind, Integrated):
            return Candidate(model, starts, self._promise_of_all(model, starts[0]))
        change = self._change(model, starts)
        scaled = _centres(model, kind)
        least, most = (_LEAST, _LARGEST) if scaled else (1 / _ROOM, _ROOM)
        both = _either_sign(model, scaled)
        gain, amount, step = self._gains(*self._sums(change), least, most, both)
        best = np.argsort(-gain)[:_BEST]
        moved = [self._moved(model, starts[i], float(amount[i]) if scaled else 1.0, step[i], scaled) for i in best]
        return Candidate(model, np.array([*moved, *starts[best]]), float(gain[best[0]]))

    def late(self, candidate: Candidate) -> Candidate | None:
        """The candidate from the onset on that promises most, to a row; None where the drive holds no such row."""
        kind, record = candidate.model.effects[-1], self.fit.model.record
        start = candidate.starts[-len(candidate.starts) // 2]  # the best one, before any step
        change = self._change(candidate.model, start[None])[0].reshape(len(record.channels), -1)
        order = self.fitting.whitening.order
        by_time = np.argsort(order, kind="stable")
        rows = order[by_time]

        def later(x: FloatArray) -> FloatArray:
            """Sums (..., row) of `x` (..., value) from each row on."""
            each = x.reshape(*x.shape[:-1], len(record.channels), -1).sum(-2)[..., by_time]
            return np.cumsum(each[..., ::-1], -1)[..., ::-1]

        d, w = change.ravel(), self.weight
        size, along, shared = later(w * d * d), later(w * d * self.white), later(self.slope * (w * d))
        scaled = _centres(candidate.model, kind)
        least, most = (_LEAST, _LARGEST) if scaled else (1 / _ROOM, _ROOM)
        gain, amount, step = self._gains(size, along, shared.T, least, most, _either_sign(candidate.model, scaled))
        # a block at least on either side
        inner = (record.block[rows] > 0) & (record.block[rows] < record.blocks - 1)
        if not inner.any():
            return None
        best = int(np.argmax(np.where(inner, gain, -np.inf)))
        model = candidate.model.setting_in(kind.name, float(record.time[rows[best]]))
        known = candidate.model.named(
            self._moved(candidate.model, start, float(amount[best]) if scaled else 1.0, step[best], scaled)
        )
        plain = candidate.model.named(start)
        return Candidate(model, np.array([model.coordinates(x) for x in (known, plain)]), float(gain[best]))

    # sums ----------------------------------------------------------------------------------------------------------
    def _change(self, model: EffectModel, starts: FloatArray) -> FloatArray:
        """(start, value): what the effect at `starts` adds to the white response."""
        return self.white - self.fitting.white(model, starts).reshape(len(starts), -1)

    def _sums(self, change: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        weighed = change * self.weight
        return (weighed * change).sum(-1), weighed @ self.white, weighed @ self.slope.T

    def _gains(
        self, size: FloatArray, along: FloatArray, shared: FloatArray, least: float, most: float, both: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gains (start,) [nats], the amounts (start,) that gain most, steps (start, size) of the parameters so far."""
        given = shared @ self.inverse
        own = np.maximum(size - (given * shared).sum(-1), 1e-3 * size + 1e-9)
        pull = along - given @ self.downhill
        amount = pull / own
        limited = np.clip(np.abs(amount), least, most) * np.where(both, np.sign(amount), 1.0)
        gain = pull * limited - 0.5 * own * limited**2
        step = (self.downhill - limited[:, None] * shared) @ self.inverse
        longest = np.abs(step).max(-1, keepdims=True, initial=1e-12)
        return gain, limited, step * np.minimum(1.0, _LONGEST / longest)

    def _promise_of_all(self, model: EffectModel, start: FloatArray) -> float:
        """What all coefficients of a force along the road would gain together."""
        white = self.fitting.white(model, start)
        slope = self.fitting.slope(model, start, white).reshape(model.size, -1)
        weighed = slope * self.weight
        downhill = weighed @ white.ravel() - start
        return float(0.5 * downhill @ np.linalg.solve(weighed @ slope.T + np.eye(model.size), downhill))

    def _moved(
        self, model: EffectModel, start: FloatArray, amount: float, step: FloatArray, scaled: Mapping[str, float]
    ) -> FloatArray:
        """`start` (size,) with its effect `amount` times as large, and the other parameters as they give way."""
        known = dict(model.named(start))
        for key, at in self.fit.model.index.items():
            known[key] = self.fit.z[at] + step[at]
        parameters, values = model.plant.parameters(), model.values(start)
        for key, centre in scaled.items():
            parameter = parameters[key]
            low, high = parameter.physical
            inside = np.clip(centre + amount * (float(values[key]) - centre), low, high)
            known[key] = np.array([float(parameter.unconstrain(torch.tensor(inside, dtype=torch.float64)))])
        return np.clip(model.coordinates(known), model.low, model.high)


def _centres(model: EffectModel, kind: type[Effect]) -> Mapping[str, float]:
    """Parameters of `kind` and where they change nothing: the response is about proportional to the distance from it.

    That is the baseline's own value where it has the effect, else the neutral one.
    """
    given = _given(model, kind)
    found = {}
    for key, parameter in model.plant.parameters().items():
        centre = given.get(key, parameter.neutral)
        if key.startswith(f"{kind.name}.") and key in model.index and centre is not None and np.isfinite(centre):
            found[key] = float(centre)
    return found


def _given(model: EffectModel, kind: type[Effect]) -> Mapping[str, float]:
    """The baseline's own values of the effect's parameters; empty where it lacks the effect."""
    own = [e for e in model.base.effects if e.name == kind.name]
    return {f"{kind.name}.{key}": float(x) for e in own for key, x in e.values().items() if x.dim() == 0}


def _either_sign(model: EffectModel, centres: Mapping[str, float]) -> bool:
    """Whether physics allows values on both sides of the centres."""
    parameters = model.plant.parameters()
    return bool(centres) and all(parameters[k].physical[0] < centre for k, centre in centres.items())


def _starts(model: EffectModel, fit: Fit, kind: type[Effect]) -> FloatArray:
    """First vectors (start, size): the parameters so far, with the effect's own first values."""
    time = model.record.time
    known, parameters = dict(fit.known), model.plant.parameters()
    given = _given(model, kind)
    grids, keys = [], []
    for name, values in kind.starts_in(float(time.min()), float(time.max())).items():
        key = f"{kind.name}.{name}"
        if key not in model.index:
            continue
        parameter = parameters[key]
        keys.append(key)
        points = torch.tensor(values, dtype=torch.float64)
        if len(kind.parameters) == 1 and parameter.neutral is not None and np.isinf(parameter.neutral):
            low, high = (abs(x) for x in parameter.physical)
            points = torch.as_tensor(np.geomspace(low, high, _LIMITS + 2)[1:-1] * np.sign(parameter.neutral))
        if key in given:  # a change of the value that the baseline has
            points = given[key] * torch.tensor(_OTHER_SIZES, dtype=torch.float64)
        grids.append([float(z) for z in parameter.unconstrain(points)])
    starts = [model.coordinates({**known, **dict(zip(keys, z, strict=True))}) for z in product(*grids)]
    own = [key for key in model.index if key.startswith(f"{kind.name}.")]
    if not grids and own and not issubclass(kind, Integrated):
        starts += [model.coordinates({**known, own[0]: np.array([z])}) for z in (_FAINT, -_FAINT)]
    out = np.clip(np.array(starts), model.low, model.high)
    if len(out) > _MOST_STARTS:
        out = out[np.linspace(0, len(out) - 1, _MOST_STARTS).astype(int)]
    if not kind.memory and kind.role != "delay":
        return out
    # a lag and a delay trade places, so from a shorter lag too
    shorter = out.copy()
    shorter[:, model.index["T_L"]] += _SHORTER
    return np.clip(np.concatenate([out, shorter]), model.low, model.high)
