"""What each named cause takes off held-out free runs: the budget of a gap, and how far the gap shrinks.

Energies are squared errors of free runs of 10 s on held-out blocks, each channel over its own floor, averaged over the
channels. The floor is what the last model leaves after a black box on top, taught by other blocks. A part's share is
what it takes off on top of the parts before it, over the whole gap; shares and what is unexplained sum to 1. Intervals
are the bootstrap's over blocks (Efron and Tibshirani 1993). Blocks measure what is named; they name nothing.

Beside it, by families: what acts in each place of the car, whatever its name, and what could act there unseen. What a
family takes off is the difference of held-out free runs with and without it, everything else refitted, so that the
order of causes changes nothing. Its size is the root mean square of what its parts add to the readings. An effect that
is not there would gain half the square of its response in units of the noise, less what free parameters take up; the
size at which that is the cost of an effect's presence is the least that shows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.engine.coordinates import EFFECTS, base_name
from avtorch.gap.engine.family import FAMILIES, FORMS, OWN, family_of
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import EFFECT_NATS
from avtorch.gap.engine.search import Projection, tried
from avtorch.gap.quantity import Quantity, of_fields
from avtorch.gap.result.budget import (
    LIKELY,
    MATERIAL,
    Budget,
    ChancePart,
    ChannelError,
    FamilyShare,
    Part,
    Unexplained,
)
from avtorch.gap.result.free_form import FittedForm
from avtorch.gap.result.held_out import Blocks, HeldOut
from avtorch.gap.result.hypotheses import (
    AnswerPart,
    aliases_of,
    drawn_squares,
    implausible,
    map_size,
    onset_of,
    part_probability,
)
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.effect import EFFECTS as TABLE

RESAMPLES = 400
"""Of blocks, with replacement."""
_NOTHING = 1e-3  # of the energy before, below which free runs show no gap
_NO_GAP = 0.1  # share of the error before that is within the floor: nothing to close
_DENSITY = "log_predictive_density"


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
    *,
    names: Sequence[str],
    repaired: Mapping[str, Quantity],
    chance: Collection[str],
    material: float = MATERIAL,
    seed: int = 0,
) -> Budget:
    """The budget of the causes `names` (or `none`, `unknown`); `posterior`: of the weight that has them all.

    `repaired`: `T_L` [s] and `K_L` [-] of the repaired simulator. `chance`: names of causes that chance decides: no
    free run foretells them. `material`: share of the gap from which what is unexplained is said to matter, where
    nothing is named by what the evidence says: with `unknown` it does, with `none` it does not.
    """
    energy, floor = _energies(held)
    draws = _shares(energy, floor, seed)
    shares = {name: draws[:, k] for k, name in enumerate(held.names)}
    by_effect = posterior.by_effect()
    after = dict(zip(held.names, energy.mean(1)[1:], strict=True))
    bottom = float(floor.mean())

    def about(name: str) -> dict[str, Any]:
        own = by_effect.get(name, {})
        return {
            "name": name,
            "alias_set": aliases_of(average, name),
            "probability": part_probability(average, name),
            "parameters": own,
            "plausible": not implausible(own, {}, [TABLE[name]] if name in TABLE else []),
        }

    parts = []
    for name in names:
        if name in chance or name in ("none", "unknown"):
            continue
        # a road is in the noise's spectrum: it takes off what the black box knows of the place
        share = shares.get(name, np.zeros(len(draws)))
        left, began = float(np.sqrt(after.get(name, energy[-1].mean()) / bottom)), onset_of(posterior.weight, name)
        onset_s = None if began is None else began.stamp_s
        parts.append(Part(**about(name), share=Quantity.of_resampled(share[0], share), after=left, onset_s=onset_s))
    parts.sort(key=lambda p: -p.share.mean)
    # with what the hypothesis holds and the label does not name
    rest = np.ones(len(draws)) - sum(shares.get(p.name, 0.0) for p in parts)
    beyond = float((rest > material).mean()) if parts else 0.0
    matters = beyond > 0.95 if parts else tuple(names) == ("unknown",)
    if not parts and names[0] not in ("none", "unknown"):  # chance alone is named, and no part of a simulator is
        before, named, last = resampled(energy[[0, -2, -1]], seed)
        matters = held.free and float(np.quantile((named - last) / before, 0.05)) > material
    most = max(sum(p.share.mean for p in parts), 1.0)  # an effect without a name may cost instead of taking off
    parts = [replace(p, share=p.share.scaled(1 / most)) for p in parts]
    carried = shares.get("free form")
    by_chance = [ChancePart(**about(n), share_of_noise=_share_of_noise(posterior, n)) for n in names if n in chance]
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
        repaired=repaired,
        chance=tuple(part for part in by_chance if part.probability >= LIKELY),
        material=material,
        horizon_s=held.horizon_s,
        by_drives=held.blocks.by_drives,
    )


def shrinkage_of(held: HeldOut, seed: int = 0) -> Shrinkage:
    """How far the gap shrinks on held-out blocks with all causes, by measure."""
    four = (held.steps[0], held.steps[-1], held.floor, held.ceiling)
    sizes, framed = held.blocks.sizes, np.flatnonzero(held.frame_rows)  # a block between two frames has no density
    out: dict[str, MetricShrinkage] = {}
    ceiling: dict[str, float] = {}
    for c, channel in enumerate(held.data.channels):
        name = f"rollout_rmse_{channel}"
        levels = np.sqrt(resampled(np.stack([x.squares[c] for x in four]), seed) / resampled(sizes, seed))
        out[name], ceiling[name] = _metric(levels, held.horizon_s, _NO_GAP), float(levels[3, 0])
    # the measure in which the gap shows most
    top = max(out, key=lambda k: out[k].before / max(out[k].floor, 1e-12))
    if all(x.closed is None for x in out.values()):
        top = _DENSITY
    nats = np.stack([x.nats[framed] for x in four])
    levels = resampled(nats, seed) / resampled(held.frame_rows[framed], seed)
    out[_DENSITY], ceiling[_DENSITY] = _metric(levels, None, 1e-3, better=np.maximum), float(levels[3, 0])
    return Shrinkage(top, out, ceiling, len(held.blocks.rows), held.blocks.by_drives)


def families_of(
    average: ModelAverage,
    posterior: ParameterPosterior,
    parts: Sequence[AnswerPart],
    held: HeldOut,
    free: FittedForm | None,
    *,
    among: Sequence[str],
    seed: int = 0,
) -> tuple[FamilyShare, ...]:
    """Every family: those that are likely there, what takes most off first, then the others.

    `posterior`: of the verdict's weight; `parts` of the answer; `held` as it was made with the families left out;
    `free`: what the repaired simulator carries; `among`: effects that were tried, by the engine's names.
    """
    h = posterior.hypothesis
    unseen = least_visible(h, among)
    out = []
    for family in (*FAMILIES, OWN):
        own = [part for part in parts if part.family == family and part.probability >= LIKELY]
        carried = family == "force map" and free is not None
        # what free runs bear out is there, whatever the evidence says of knots
        probability = max(min(average.families.get(family, 0.0), 1.0), float(carried))
        if family == OWN and not own:
            continue
        names = tuple(part.name for part in own if part.name is not None)
        form = next((part.form for part in own if part.name is None), "F(u, v)" if carried else None)
        there = probability >= LIKELY
        hidden = h.force.takes_up if family == "force map" and h.force is not None else ()
        typical, least = unseen.get(family, (None, None))
        out.append(
            FamilyShare(
                family,
                names,
                form,
                tuple(n for n in (FAMILIES["force map"] if carried else hidden) if n not in names),
                probability,
                _size(posterior, own, held.blocks, free if carried else None, seed) if there else None,
                _takes_off(held, family, seed) if there else None,
                excited=typical is None or typical >= EFFECT_NATS,
                unseen_mps2=least,
            )
        )
    return tuple(sorted(out, key=lambda f: (not f.present, -(f.takes_off.mean if f.takes_off else 0.0))))


def least_visible(h: Hypothesis, among: Sequence[str]) -> Mapping[str, tuple[float, float]]:
    """By family, of its effects that `h` has not: the nats that the most visible one would gain at its typical size,
    and the root mean square [m/s²] of the least visible one at the size that gains `EFFECT_NATS`."""
    projection, response = Projection(h), h.rows()
    nats: dict[str, list[float]] = {}
    sizes: dict[str, list[float]] = {}
    for e in tried(h, among):
        found = [_shown(h, projection, response, e.name, start) for start in e.starts]
        found = [(gain, size) for gain, size in found if gain > 0 and size > 0]
        if e.name.startswith("~") or not found:
            continue
        gain, size = max(found)
        family = family_of(base_name(e.name))
        nats.setdefault(family, []).append(gain)
        sizes.setdefault(family, []).append(size * float(np.sqrt(EFFECT_NATS / gain)))
    return {family: (max(nats[family]), max(sizes[family])) for family in nats}


# inside ---------------------------------------------------------------------------------------------------------------
def _energies(held: HeldOut) -> tuple[FloatArray, FloatArray]:
    """Energies (model, block) of the chain and (block,) of the floor, each channel over its own floor."""
    levels, bottom = np.stack([x.squares for x in held.steps]), held.floor.squares  # model, channel, block
    scale = np.maximum(bottom.mean(1), 1e-12)[:, None]
    return (levels / scale).mean(1), (bottom / scale).mean(0)


def _levels(held: HeldOut) -> list[ChannelError]:
    """Root mean squares before, at the floor and left, a channel."""
    three = np.stack([x.squares.sum(1) for x in (held.steps[0], held.floor, held.steps[-1])])
    return [ChannelError(*map(float, x)) for x in np.sqrt(three / held.blocks.sizes.sum()).T]


def _shares(energy: FloatArray, floor: FloatArray, seed: int) -> FloatArray:
    """Shares (draw, part and rest) of the gap under resampled blocks; the first draw is of the blocks themselves."""
    levels = resampled(energy, seed).T  # draw, model
    bottom = np.minimum(resampled(floor, seed), levels[:, -1])
    parts = np.column_stack([np.maximum(-np.diff(levels, axis=1), 0.0), levels[:, -1] - bottom])
    total = parts.sum(1, keepdims=True)
    alike = np.full_like(parts, 1.0 / max(parts.shape[1] - 1, 1))  # where runs show no gap, shares say nothing
    alike[:, -1] = 0.0 if parts.shape[1] > 1 else 1.0
    return np.where(total > _NOTHING * levels[:, :1], parts / np.maximum(total, 1e-300), alike)


def _still(held: HeldOut, seed: int) -> Quantity:
    """Share of the squared error of the repaired simulator, in the last channel, that a black box still takes off.

    The lower end is what it did on blocks that taught neither, the upper end also what these blocks would have let pass
    unseen (`HeldOut.possible`), both under resampled blocks.
    """
    plant, box = held.steps[-1].squares[-1], held.rival.squares[-1]
    named = held.steps[len(held.chain) - 1].squares[-1]
    total = np.maximum(resampled(plant, seed), 1e-12)
    did = np.clip(resampled(plant - box, seed) / total, 0.0, 1.0)
    of_draw = np.random.default_rng(seed).integers(0, len(held.possible), RESAMPLES)
    possible = resampled(held.possible[:, -1], seed)[of_draw, np.arange(RESAMPLES)]
    could = np.clip((possible - np.maximum(resampled(named - plant, seed), 0.0)) / total, 0.0, 1.0)
    low, high = float(np.quantile(did, 0.05)), float(np.quantile(np.maximum(did, could), 0.95))
    mean = float(did[0])
    return Quantity(mean, float(did.std()), min(low, mean), max(high, mean))


def resampled(x: FloatArray, seed: int) -> FloatArray:
    """Means (..., draw) over resampled blocks of `x` (..., block); the first draw is the blocks themselves."""
    blocks = x.shape[-1]
    pick = np.random.default_rng(seed).integers(0, blocks, (RESAMPLES, blocks))
    pick[0] = np.arange(blocks)
    return x[..., pick].mean(-1)


def _metric(
    levels: FloatArray, horizon: float | None, nothing: float, better: Callable[..., Any] = np.minimum
) -> MetricShrinkage:
    """Of `levels` (before, after, floor and ceiling; draw) under resampled blocks; `nothing`: of a gap, relative to an
    error, or of a density [nats]."""
    before, after = levels[:2]
    bottom = better(levels[2], after)
    gap, closed = before - bottom, None
    if abs(gap[0]) >= nothing * (before[0] if better is np.minimum else 1.0):
        shares = (before - after) / np.where(gap == 0, np.inf, gap)
        closed = Quantity.of_resampled(shares[0], shares)
    return MetricShrinkage(float(before[0]), float(after[0]), float(bottom[0]), closed, horizon)


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


def _shown(
    h: Hypothesis, projection: Projection, response: Sequence[FloatArray], effect: str, start: Sequence[float]
) -> tuple[float, float]:
    """Expected nats and root mean square [m/s²] of an effect beside `h`."""
    # what has to set in during the drive does so half way
    middle = 0.5 * float(h.data.time[0] + h.data.time[-1]) if EFFECTS[effect].onset == "must" else None
    beside = h.with_effect(effect, start, middle)
    change = [a - b for a, b in zip(beside.rows(), response, strict=True)]
    free = projection(whiten(h.data, h.covariance, h.data.transform(change)))
    return 0.5 * float(free @ free), max(float(np.sqrt((x**2).mean())) for x in change)


def _size(
    posterior: ParameterPosterior, own: Sequence[AnswerPart], blocks: Blocks, free: FittedForm | None, seed: int
) -> Quantity | None:
    """Root mean square [m/s²] of what the parts of a family do together; of a random cause by its own size."""
    h, names = posterior.hypothesis, [part.name for part in own]
    effects = [e for e in h.effects if base_name(e) in names and EFFECTS[e].coordinates]
    total = drawn_squares(posterior, effects, blocks.rows, seed) if effects else np.zeros(1)
    if any(part.name is None and part.form not in FORMS for part in own) and h.force is not None:
        if not effects:
            return map_size(h, seed)
        total = total + map_size(h, seed).mean ** 2
    elif free is not None:
        adds = np.interp(h.data.time, h.data.grid.time, free.without([]))
        squares = np.array([(adds[rows] ** 2).mean() for rows in blocks.rows])
        total = total + resampled(squares, seed)[: None if len(total) == 1 else len(total)]
    if total.any():
        return Quantity.of_draws(np.sqrt(total))
    return next((part.size_mps2 for part in own if part.size_mps2 is not None), None)


def _takes_off(held: HeldOut, family: str, seed: int) -> Quantity | None:
    """Share of the gap that free runs miss without the family, under resampled blocks."""
    without = held.apart.get(family)
    if without is None:
        return None
    before, after, floor = (x.squares for x in (held.steps[0], held.steps[-1], held.floor))
    scale = np.maximum(floor.mean(1), 1e-12)[:, None]
    before, after, less, floor = ((x / scale).mean(0) for x in (before, after, without.squares, floor))
    whole = np.maximum(resampled(before - floor, seed), 1e-9)
    draws = np.clip(resampled(less - after, seed) / whole, 0.0, 1.0)
    return Quantity.of_resampled(draws[0], draws)
