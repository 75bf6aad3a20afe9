"""What each named cause takes off held-out free runs: the budget of a gap, and how far the gap shrinks.

Energies are squared errors of free runs of 10 s on held-out blocks, each channel over its own floor, averaged over the
channels. The floor is what the last model leaves after a black box on top, taught by other blocks. A part's share is
what it takes off on top of the parts before it, over the whole gap; shares and what is unexplained sum to 1. Intervals
are the bootstrap's over blocks (Efron and Tibshirani 1993). Blocks measure what is named; they name nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.quantity import Quantity, of_fields
from avtorch.gap.result.budget import LIKELY, MATERIAL, Budget, ChancePart, ChannelError, Part, Unexplained
from avtorch.gap.result.held_out import HeldOut
from avtorch.gap.result.hypotheses import aliases_of, implausible, onset_of, part_probability
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.effect import EFFECTS
from avtorch.io import Log

CHANCE = ("gust", "outliers", "command_hold")
"""Causes that chance decides: no free run foretells them."""
RESAMPLES = 400
"""Of blocks, with replacement."""
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


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on held-out blocks of the drives.

    `metric`: the one of `by_metric` in which the gap is clearest. `ceiling`: error after a flexible black box is added
    to the bare baseline, by metric. `blocks`: number of held-out blocks. `by_drives`: whole drives were held out.
    """

    metric: str
    by_metric: Mapping[str, MetricShrinkage]
    ceiling: Mapping[str, float]
    blocks: int
    by_drives: bool = False

    @property
    def top(self) -> MetricShrinkage:
        return self.by_metric[self.metric]

    def to_dict(self) -> dict[str, Any]:
        """The object `shrinkage` of `diagnosis.json`."""
        out = of_fields(self) | of_fields(self.top)
        out |= {"heldout": True, "heldout_by": "drives" if out.pop("by_drives") else "blocks"}
        return out | {"placebo": {"effect": None, "closed": None}, "chosen": None}


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
    after = dict(zip(held.names, energy.mean(1)[1:], strict=True))
    bottom = float(floor.mean())
    by_chance = [name for name in dict.fromkeys((*CHANCE, *chance)) if name in names]
    parts = []
    for name in names:
        if name in by_chance or name in ("none", "unknown"):
            continue
        # a road is in the noise's spectrum: it takes off what the black box knows of the place
        share = shares.get(name, np.zeros(len(draws)))
        began = onset_of(posterior.weight, name, logs)
        parts.append(
            Part(
                name,
                aliases_of(average, name),
                part_probability(average, name),
                Quantity.of_resampled(share[0], share),
                float(np.sqrt(after.get(name, energy[-1].mean()) / bottom)),
                own.get(name, {}),
                None if began is None else began.stamp_s,
                _plausible(name, own),
            )
        )
    parts.sort(key=lambda p: -p.share.mean)
    named_parts = {p.name for p in parts}
    # with what the hypothesis holds and the label does not name
    rest = sum((share for name, share in shares.items() if name not in named_parts), draws[:, -1])
    rest = rest if parts else np.ones(len(draws))
    beyond = float((rest > material).mean()) if parts else 0.0
    matters = beyond > 0.95 if parts else tuple(names) == ("unknown",)
    if not parts and names[0] not in ("none", "unknown"):  # chance alone is named, and no part of a simulator is
        matters = held.free and _surely_takes_off(energy, seed) > material
    most = max(sum(p.share.mean for p in parts), 1.0)  # an effect without a name may cost instead of taking off
    parts = [replace(p, share=p.share.scaled(1 / most)) for p in parts]
    carried = shares.get("free form")
    return Budget(
        before=float(np.sqrt(energy[0].mean() / bottom)),
        left=float(np.sqrt(energy[-1].mean() / bottom)),
        by_channel=dict(zip(held.data.channels, _levels(held), strict=True)),
        parts=tuple(parts),
        unexplained=Unexplained(
            Quantity.of_resampled(1 - sum(p.share.mean for p in parts), rest),
            matters,
            average.probabilities["unknown"] if not parts else beyond,
            still=_still(held, seed),
            carried=None if carried is None else Quantity.of_resampled(carried[0], carried),
        ),
        baseline={key: held.chain[0][key] for key in ("T_L", "K_L")},
        repaired=posterior.moved(),
        chance=tuple(
            ChancePart(
                name,
                part_probability(average, name),
                _share_of_noise(posterior, name),
                own.get(name, {}),
                _plausible(name, own),
                aliases_of(average, name),
            )
            for name in by_chance
            if part_probability(average, name) >= LIKELY
        ),
        material=material,
        horizon_s=held.horizon_s,
        by_drives=held.blocks.by_drives,
    )


def shrinkage_of(held: HeldOut, seed: int = 0) -> Shrinkage:
    """How far the gap shrinks on held-out blocks with all causes, by measure."""
    blocks, sizes = len(held.blocks.rows), held.blocks.sizes
    pick = np.random.default_rng(seed).integers(0, blocks, (RESAMPLES, blocks))
    four = (held.steps[0], held.steps[-1], held.floor, held.ceiling)
    out: dict[str, MetricShrinkage] = {}
    ceiling: dict[str, float] = {}
    for c, channel in enumerate(held.data.channels):
        squares = np.stack([x.squares[c] for x in four])
        rms = np.sqrt(squares.sum(1) / sizes.sum())
        drawn = np.sqrt(squares[:, pick].sum(-1) / sizes[pick].sum(-1))
        name = f"rollout_rmse_{channel}"
        out[name], ceiling[name] = _metric(rms, drawn, held.horizon_s), float(rms[3])
    rows, nats = held.frame_rows, np.stack([x.nats for x in four])
    mean = nats.sum(1) / rows.sum()
    drawn = nats[:, pick].sum(-1) / rows[pick].sum(-1)
    # the measure in which the gap shows most
    top = max(out, key=lambda k: out[k].before / max(out[k].floor, 1e-12))
    if all(x.closed is None for x in out.values()):
        top = "log_predictive_density"
    out["log_predictive_density"] = _metric(mean, drawn, None, density=True)
    ceiling["log_predictive_density"] = float(mean[3])
    return Shrinkage(top, out, ceiling, blocks, held.blocks.by_drives)


# inside ---------------------------------------------------------------------------------------------------------------
def _energies(held: HeldOut) -> tuple[FloatArray, FloatArray]:
    """Energies (model, block) of the chain and (block,) of the floor, each channel over its own floor."""
    levels = np.stack([x.squares for x in held.steps])  # model, channel, block
    # where a black box on top only harms, the model itself is the floor
    worse = held.floor.squares.sum(1) > levels[-1].sum(1)
    bottom = np.where(worse[:, None], levels[-1], held.floor.squares)
    scale = np.maximum(bottom.mean(1), 1e-12)[:, None]
    return (levels / scale).mean(1), (bottom / scale).mean(0)


def _levels(held: HeldOut) -> list[ChannelError]:
    """Root mean squares before, at the floor and left, a channel."""
    three = np.stack([x.squares.sum(1) for x in (held.steps[0], held.floor, held.steps[-1])])
    three[1] = np.minimum(three[1], three[2])
    return [ChannelError(*map(float, x)) for x in np.sqrt(three / held.blocks.sizes.sum()).T]


def _resampled(energy: FloatArray, floor: FloatArray, seed: int) -> FloatArray:
    """Shares (draw, part and rest) of the gap under resampled blocks; the first draw is of the blocks themselves."""
    pick = resamples(energy.shape[1], np.random.default_rng(seed))
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
    pick = np.random.default_rng(seed).integers(0, blocks, (RESAMPLES, blocks))
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
    rng = np.random.default_rng(seed)
    pick = resamples(len(plant), rng)
    total = np.maximum(plant[pick].sum(1), 1e-12)
    did = np.clip((plant - box)[pick].sum(1) / total, 0.0, 1.0)
    drawn = np.take_along_axis(possible[rng.integers(0, len(possible), RESAMPLES)], pick, 1).sum(1)
    could = np.clip((drawn - np.maximum((named - plant)[pick].sum(1), 0.0)) / total, 0.0, 1.0)
    low, high = float(np.quantile(did, 0.05)), float(np.quantile(np.maximum(did, could), 0.95))
    mean = float(did[0])
    return Quantity(mean, float(did.std()), min(low, mean), max(high, mean))


def resamples(blocks: int, rng: np.random.Generator) -> IntArray:
    """Numbers (draw, block) of resampled blocks; the first draw is the blocks themselves."""
    pick = rng.integers(0, blocks, (RESAMPLES, blocks))
    pick[0] = np.arange(blocks)
    return pick


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
        closed = Quantity.of_resampled(value, shares)
    return MetricShrinkage(float(before), float(after), float(floor), closed, horizon)


def _plausible(name: str, own: Mapping[str, Mapping[str, Quantity]]) -> bool:
    return not implausible(own.get(name, {}), {}, [EFFECTS[name]] if name in EFFECTS else [])


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
