"""Since when an effect acts, if all parameters give way: for each onset, one step of least squares.

Parameters fitted to a wrong onset hide the right one: gain and lag make up for the effect, which comes out faint or of
the wrong sign, and then no row is better than another. What acts before an onset is linear in the model without the
effect and what acts after in the model with it, so sums over the rows before and after give the step for every onset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.robust_fit import Fit, RobustFit

_EVERY_S = 0.5  # between onsets tried; the row is found from there
_LONGEST = 2.5  # step of a parameter [prior SD]
_DAMPING = 1e-3


@dataclass(frozen=True, eq=False)
class OnsetStep:
    """A model with an onset, the place `z` (size,) that one step reaches there, and what that `promises` [nats]."""

    model: EffectModel
    z: FloatArray
    promises: float


def onset_by_step(fitting: RobustFit, fit: Fit, name: str) -> OnsetStep | None:
    """The onset of the effect `name` at which one step of all parameters promises most.

    None where no row has a block on either side.
    """
    record, whitening = fit.model.record, fitting.whitening
    by_time = np.argsort(whitening.order, kind="stable")
    rows = whitening.order[by_time]
    first = np.unique(np.floor(record.time[rows] / _EVERY_S), return_index=True)[1]
    block = record.block[rows[first]]
    onsets = np.nonzero((block > 0) & (block < record.blocks - 1))[0]
    if not len(onsets):
        return None
    # as the search by rows: without an onset the model lacks what only one with an onset has
    always, never = fit.model.setting_in(name, -np.inf), fit.model.without(name)
    z = always.coordinates(fit.known)
    now = fitting.white(fit.model, fit.z)
    weight = fitting.weights(now, np.ones(whitening.blocks))[by_time]
    after = _sums(*_linear(fitting, always, always, z), weight, by_time, first)
    before = _sums(*_linear(fitting, never, always, z), weight, by_time, first)
    # of the bins before an onset, and of those from it on
    curvature, downhill, cost = (
        (np.cumsum(b, 0) - b + np.cumsum(a[::-1], 0)[::-1])[onsets] for b, a in zip(before, after, strict=True)
    )
    curvature, downhill = curvature + np.eye(len(z)), downhill - z
    damped = curvature * (1 + _DAMPING * np.eye(len(z)))
    step = np.linalg.solve(damped, downhill[..., None])[..., 0]
    step *= np.minimum(1.0, _LONGEST / np.abs(step).max(-1, keepdims=True, initial=1e-12))
    gain = (downhill * step).sum(-1) - 0.5 * np.einsum("oi,oij,oj->o", step, curvature, step) - cost
    best = int(np.argmax(gain))
    model = fit.model.setting_in(name, float(record.time[rows[first[onsets[best]]]]))
    there = np.clip(z + step[best], always.low, always.high)
    promises = float(gain[best]) + 0.5 * float((weight * (now[:, by_time] ** 2).sum(0)).sum())
    return OnsetStep(model, model.coordinates(always.named(there)), promises)


def _linear(fitting: RobustFit, model: EffectModel, whole: EffectModel, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """White residuals (channel, counted) of `model` at the `z` (size,) of `whole`, and their slopes (size, ...)."""
    own = model.coordinates(whole.named(z))
    white = fitting.white(model, own)
    slope, found = np.zeros((len(z), *white.shape)), fitting.slope(model, own, white)
    for key, at in model.index.items():
        slope[whole.index[key]] = found[at]
    return white, slope


def _sums(
    white: FloatArray, slope: FloatArray, weight: FloatArray, by_time: IntArray, first: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Curvature (bin, size, size), downhill (bin, size) and cost (bin,) of the rows in each bin.

    One matrix product for each bin, of few rows: the shorter bins are filled up with zeros.
    """
    columns = np.concatenate([slope, white[None]])[..., by_time] * np.sqrt(weight)
    lengths = np.diff(np.append(first, len(by_time)))
    number = np.repeat(np.arange(len(first)), lengths)
    filled = np.zeros((len(first), int(lengths.max()), white.shape[0], len(columns)))
    filled[number, np.arange(len(by_time)) - first[number]] = np.moveaxis(columns, 0, -1).swapaxes(0, 1)
    of_bins = filled.reshape(len(first), -1, len(columns))
    products = of_bins.swapaxes(-1, -2) @ of_bins
    return products[:, :-1, :-1], products[:, :-1, -1], 0.5 * products[:, -1, -1]
