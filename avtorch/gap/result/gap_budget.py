"""What each named cause takes off held-out free runs: the budget of a gap, and how far the gap shrinks.

Energies are squared errors of free runs of 10 s on held-out blocks, each channel over its own floor, averaged over the
channels. The floor is what the last model leaves after a black box on top, taught by other blocks. A part's share is
what it takes off on top of the parts before it, over the whole gap; shares and what is unexplained sum to 1. Intervals
are the bootstrap's over blocks (Efron and Tibshirani 1993). Blocks measure what is named; they name nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.answer.budget import LIKELY, MATERIAL, Budget, ChancePart, ChannelError, Part, Unexplained
from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.held_out import HeldOut
from avtorch.gap.result.hypotheses import aliases_of, implausible, onset_of, part_probability
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.effect import EFFECTS
from avtorch.io import Log

CHANCE = ("gust", "outliers", "command_hold")
"""Causes that chance decides: no free run foretells them."""
_RESAMPLES = 400
_NOTHING = 1e-3  # of the energy before, below which free runs show no gap
_NO_GAP = 0.1  # share of the error before that is within the floor: nothing to close


@dataclass(frozen=True)
class MetricShrinkage:
    """Errors by one measure: `before` the effect is added, `after`, and the `floor` that no model can go below.

    `closed`: (before - after) / (before - floor), None where there is almost nothing to close. Rollout errors are root
    mean squares [m/s², m/s]; densities are mean log densities per row [nats], of which higher is better.

    `horizon_s`: length of the rollouts [s], None for those of whole drives and for densities.
    """

    before: float
    after: float
    floor: float
    closed: Quantity | None
    horizon_s: float | None = None

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on held-out blocks of the drives.

    `metric`: the one of `by_metric` in which the gap is clearest. `placebo`: what `placebo_effect`, a wrong effect with
    about as many parameters, closes when added. `ceiling`: error after a flexible black box is added to the bare
    baseline, by metric. `blocks`: number of held-out blocks. `by_drives`: whole drives were held out.
    """

    metric: str
    by_metric: Mapping[str, MetricShrinkage]
    placebo_effect: str | None
    placebo: Quantity | None
    ceiling: Mapping[str, float]
    blocks: int
    by_drives: bool = False

    @property
    def top(self) -> MetricShrinkage:
        return self.by_metric[self.metric]

    def to_dict(self) -> dict[str, Any]:
        """The object `shrinkage` of `diagnosis.json`."""
        placebo = None if self.placebo is None else self.placebo.to_dict()
        return {
            "metric": self.metric,
            "heldout": True,
            **self.top.to_dict(),
            "by_metric": {name: closed.to_dict() for name, closed in self.by_metric.items()},
            "placebo": {"effect": self.placebo_effect, "closed": placebo},
            "ceiling": dict(self.ceiling),
            "chosen": None,
            "blocks": self.blocks,
            "heldout_by": "drives" if self.by_drives else "blocks",
        }


def budget_of(
    average: ModelAverage,
    posterior: ParameterPosterior,
    held: HeldOut,
    logs: Sequence[Log],
    *,
    names: Sequence[str],
    material: float = MATERIAL,
    seed: int = 0,
    chance: Sequence[str] = (),
) -> Budget:
    """The budget of the causes `names` (or `none`, `unknown`); `posterior`: of the weight that has them all.

    `chance`: names of a user's causes that chance decides. `material`: share of the gap from which what is
    unexplained is said to matter, where nothing is named by what the evidence says: with `unknown` it does, with
    `none` it does not.
    """
    energy, floor = _energies(held)
    draws = _resampled(energy, floor, seed)
    shares = {name: draws[:, k] for k, name in enumerate(held.names)}
    own = posterior.by_effect()
    onsets = {name: onset_of(posterior.weight, name, logs) for name in names}
    parts, rest = [], draws[:, -1]
    steps = dict(zip(held.names, pairwise(energy.mean(1)), strict=True))
    bottom = float(floor.mean())
    for name in names:
        if name in CHANCE or name in chance or name in ("none", "unknown"):
            continue
        # a road is in the noise's spectrum: it takes off what the black box knows of the place
        share = shares.get(name, np.zeros(len(draws)))
        after = steps[name][1] if name in steps else energy.mean(1)[-1]
        quantities = own.get(name, {})
        began = onsets[name]
        kinds = [EFFECTS[name]] if name in EFFECTS else []
        parts.append(
            Part(
                name,
                aliases_of(average, name),
                part_probability(average, name),
                _quantity(share),
                float(np.sqrt(after / bottom)),
                quantities,
                None if began is None else began.stamp_s,
                not implausible(quantities, {}, kinds),
            )
        )
    named_parts = {p.name for p in parts}
    carried = _quantity(shares["free form"]) if "free form" in shares else None
    for name, share in shares.items():  # what the hypothesis holds and the label does not name
        if name not in named_parts:
            rest = rest + share
    if not parts:
        rest = np.ones(len(draws))
    parts.sort(key=lambda p: -p.share.mean)
    unnamed = _quantity(rest)
    beyond = float((rest > material).mean()) if parts else 0.0
    matters = beyond > 0.95 if parts else tuple(names) == ("unknown",)
    if not parts and names[0] not in ("none", "unknown"):  # chance alone is named, and no part of a simulator is
        matters = held.free and _surely_takes_off(energy, seed) > material
    most = max(sum(p.share.mean for p in parts), 1.0)  # an effect without a name may cost instead of taking off
    parts = [replace(p, share=p.share.scaled(1 / most)) for p in parts]
    unnamed = _shifted(unnamed, 1 - sum(p.share.mean for p in parts) - unnamed.mean)
    by_channel = {
        name: ChannelError(*(float(np.sqrt(x)) for x in levels))
        for name, levels in zip(held.data.channels, _levels(held), strict=True)
    }
    return Budget(
        before=float(np.sqrt(energy[0].mean() / bottom)),
        left=float(np.sqrt(energy[-1].mean() / bottom)),
        by_channel=by_channel,
        parts=tuple(parts),
        unexplained=Unexplained(
            unnamed,
            matters,
            average.probabilities["unknown"] if not parts else beyond,
            still=_still(held, seed),
            carried=carried,
        ),
        baseline={key: held.chain[0][key] for key in ("T_L", "K_L")},
        repaired=posterior.moved(),
        chance=_chance(average, posterior, names, tuple(dict.fromkeys((*CHANCE, *chance)))),
        material=material,
        horizon_s=held.horizon_s,
        by_drives=held.blocks.by_drives,
    )


def shrinkage_of(held: HeldOut, seed: int = 0) -> Shrinkage:
    """How far the gap shrinks on held-out blocks with all causes, by measure."""
    rng = np.random.default_rng(seed)
    blocks = len(held.blocks.rows)
    pick = rng.integers(0, blocks, (_RESAMPLES, blocks))
    sizes = np.asarray(held.blocks.sizes, float)
    out: dict[str, MetricShrinkage] = {}
    ceiling: dict[str, float] = {}
    for c, channel in enumerate(held.data.channels):
        squares = np.stack([x.squares[c] for x in (held.steps[0], held.steps[-1], held.floor, held.ceiling)])
        rms = np.sqrt(squares.sum(1) / sizes.sum())
        drawn = np.sqrt(squares[:, pick].sum(-1) / sizes[pick].sum(-1))
        name = f"rollout_rmse_{channel}"
        out[name] = _metric(rms, drawn, held.horizon_s)
        ceiling[name] = float(rms[3])
    rows = held.frame_rows
    nats = np.stack([x.nats for x in (held.steps[0], held.steps[-1], held.floor, held.ceiling)])
    mean = nats.sum(1) / rows.sum()
    drawn = nats[:, pick].sum(-1) / rows[pick].sum(-1)
    out["log_predictive_density"] = _metric(mean, drawn, None, density=True)
    ceiling["log_predictive_density"] = float(mean[3])
    rollouts = [k for k in out if k != "log_predictive_density"]
    # the measure in which the gap shows most
    clearest = max(rollouts, key=lambda k: out[k].before / max(out[k].floor, 1e-12))
    top = clearest if any(out[k].closed is not None for k in rollouts) else "log_predictive_density"
    return Shrinkage(
        metric=top,
        by_metric=out,
        placebo_effect=None,
        placebo=None,
        ceiling=ceiling,
        blocks=blocks,
        by_drives=held.blocks.by_drives,
    )


# inside ---------------------------------------------------------------------------------------------------------------
def _energies(held: HeldOut) -> tuple[FloatArray, FloatArray]:
    """Energies (model, block) of the chain and (block,) of the floor, each channel over its own floor."""
    levels = np.stack([x.squares for x in held.steps])  # model, channel, block
    # where a black box on top only harms, the model itself is the floor
    worse = held.floor.squares.sum(1) > levels[-1].sum(1)
    bottom = np.where(worse[:, None], levels[-1], held.floor.squares)
    scale = np.maximum(bottom.mean(1), 1e-12)[:, None]
    return (levels / scale).mean(1), (bottom / scale).mean(0)


def _levels(held: HeldOut) -> list[tuple[float, float, float]]:
    """Mean squares before, at the floor and left, a channel."""
    count = float(np.sum(held.blocks.sizes))
    out = []
    for c in range(len(held.data.channels)):
        before, left, floor = (float(x.squares[c].sum()) / count for x in (held.steps[0], held.steps[-1], held.floor))
        out.append((before, min(floor, left), left))
    return out


def _resampled(energy: FloatArray, floor: FloatArray, seed: int) -> FloatArray:
    """Shares (draw, part and rest) of the gap under resampled blocks; the first draw is of the blocks themselves."""
    blocks = energy.shape[1]
    pick = np.random.default_rng(seed).integers(0, blocks, (_RESAMPLES, blocks))
    pick[0] = np.arange(blocks)
    levels = np.moveaxis(energy[:, pick].mean(-1), 0, 1)  # draw, model
    bottom = np.minimum(floor[pick].mean(-1), levels[:, -1])
    parts = np.column_stack([np.maximum(-np.diff(levels, axis=1), 0.0), levels[:, -1] - bottom])
    total = parts.sum(1, keepdims=True)
    alike = np.full_like(parts, 1.0 / max(parts.shape[1] - 1, 1))  # where runs show no gap, shares say nothing
    alike[:, -1] = 0.0 if parts.shape[1] > 1 else 1.0
    return np.where(total > _NOTHING * levels[:, :1], parts / np.maximum(total, 1e-300), alike)


def _surely_takes_off(energy: FloatArray, seed: int) -> float:
    """The lower end of what the last step takes off, in shares of the error before, under resampled blocks."""
    blocks = energy.shape[1]
    pick = np.random.default_rng(seed).integers(0, blocks, (_RESAMPLES, blocks))
    before, named, last = (energy[k][pick].mean(1) for k in (0, -2, -1))
    return float(np.quantile((named - last) / before, 0.05))


def _still(held: HeldOut, seed: int) -> Quantity:
    """Share of the squared error of the repaired simulator, in the last channel, that a black box still takes off.

    The lower end is what it did on blocks that taught neither, the upper end also what these blocks would have let pass
    unseen (`HeldOut.possible`), both under resampled blocks.
    """
    plant, box = held.steps[-1].squares[-1], held.rival.squares[-1]
    named = held.steps[len(held.chain) - 1].squares[-1]
    possible = held.possible[:, -1]
    blocks = len(plant)
    rng = np.random.default_rng(seed)
    pick = rng.integers(0, blocks, (_RESAMPLES, blocks))
    pick[0] = np.arange(blocks)
    total = np.maximum(plant[pick].sum(1), 1e-12)
    did = np.clip((plant - box)[pick].sum(1) / total, 0.0, 1.0)
    drawn = np.take_along_axis(possible[rng.integers(0, len(possible), _RESAMPLES)], pick, 1).sum(1)
    could = np.clip((drawn - np.maximum((named - plant)[pick].sum(1), 0.0)) / total, 0.0, 1.0)
    low, high = float(np.quantile(did, 0.05)), float(np.quantile(np.maximum(did, could), 0.95))
    mean = float(did[0])
    return Quantity(mean, float(did.std()), min(low, mean), max(high, mean))


def _quantity(draws: FloatArray) -> Quantity:
    """The first draw's value with the interval of all."""
    q05, q95 = np.quantile(draws, (0.05, 0.95))
    mean = float(draws[0])
    return Quantity(mean, float(draws.std()), float(min(q05, mean)), float(max(q95, mean)))


def _shifted(q: Quantity, by: float) -> Quantity:
    return Quantity(q.mean + by, q.sd, min(q.q05, q.mean + by), max(q.q95, q.mean + by))


def _metric(levels: FloatArray, drawn: FloatArray, horizon: float | None, *, density: bool = False) -> MetricShrinkage:
    """Before, after and floor of one measure; `drawn` (level, draw) under resampled blocks."""
    before, after, floor, _ = levels
    floor = max(floor, after) if density else min(floor, after)
    nothing = abs(before - floor) < (1e-3 if density else _NO_GAP * before)
    closed = None
    if not nothing:
        bottom = np.maximum(drawn[2], drawn[1]) if density else np.minimum(drawn[2], drawn[1])
        shares = (drawn[0] - drawn[1]) / np.where(drawn[0] == bottom, np.inf, drawn[0] - bottom)
        value = (before - after) / (before - floor)
        q05, q95 = np.quantile(shares, (0.05, 0.95))
        closed = Quantity(float(value), float(shares.std()), float(min(q05, value)), float(max(q95, value)))
    return MetricShrinkage(float(before), float(after), float(floor), closed, horizon)


def _chance(
    average: ModelAverage, posterior: ParameterPosterior, names: Sequence[str], chance: Sequence[str]
) -> tuple[ChancePart, ...]:
    own: Mapping[str, Mapping[str, Quantity]] = posterior.by_effect()
    out = []
    for name in chance:
        if name not in names or part_probability(average, name) < LIKELY:
            continue
        quantities = dict(own.get(name, {}))
        kinds = [EFFECTS[name]] if name in EFFECTS else []
        out.append(
            ChancePart(
                name,
                part_probability(average, name),
                _share_of_noise(posterior, name),
                quantities,
                not implausible(quantities, {}, kinds),
                aliases_of(average, name),
            )
        )
    return tuple(out)


def _share_of_noise(posterior: ParameterPosterior, name: str) -> float | None:
    """Of the variance of what is left: a gust's by its size, outliers' by theirs; None for lost messages."""
    weight = posterior.weight
    h = weight.examined.hypothesis
    if name == "gust":
        data = h.data
        total = float((h.residual[-1] ** 2).sum()) / max(data.frame_count * data.frame_rows, 1)
        return float(np.clip(weight.composition.slow.gust_sd**2 / max(total, 1e-12), 0.0, 1.0))
    found = weight.examined.outliers
    if name == "outliers" and found is not None:
        total = float((found.errors**2).sum())
        return float(np.clip((found.errors[found.flags] ** 2).sum() / max(total, 1e-12), 0.0, 1.0))
    return None
