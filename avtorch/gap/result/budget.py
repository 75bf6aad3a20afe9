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

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, base_name
from avtorch.gap.engine.family import FAMILIES, FORMS, OWN, family_of
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import EFFECT_NATS
from avtorch.gap.engine.promises import Projection
from avtorch.gap.engine.search import tried
from avtorch.gap.quantity import RESAMPLES, Quantity, of_fields, plain, resampled
from avtorch.gap.result.attribution import Location
from avtorch.gap.result.counted_rows import HORIZON_S, Blocks
from avtorch.gap.result.free_form import FittedForm
from avtorch.gap.result.held_out import HeldOut
from avtorch.gap.result.hypotheses import (
    LIKELY,
    AnswerPart,
    aliases_of,
    implausible,
    map_size,
    onset_of,
    part_probability,
)
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.effect import EFFECTS as TABLE
from avtorch.gap.simulator.effect import named_cause

MATERIAL = 0.03
"""Share from which something counts, unless a user says otherwise: a part of the bare baseline's squared error, what is
unexplained of the gap."""

UNNAMED = "a force without a name"
"""What the repaired simulator carries beside the named effects, in a table."""
_NOTHING = 1e-3  # of the energy before, below which free runs show no gap
_SIZES = 48  # draws of the size of a family


@dataclass(frozen=True)
class Part:
    """A cause: its `share` of the gap, `after` it the root of the energy that is left, and its parameters.

    `alias_set`: effects that these drives cannot distinguish from it, itself among them. `probability`: that one of
    them is really there. `onset_s` on the log's own clock, None: from the start. `plausible`: its parameters are
    physically possible.
    """

    name: str
    alias_set: tuple[str, ...]
    probability: float
    share: Quantity
    after: float
    parameters: Mapping[str, Quantity]
    onset_s: float | None = None
    plausible: bool = True

    def to_dict(self) -> dict[str, Any]:
        out = of_fields(self, intervals=True)
        return {"names": [out.pop("name")]} | out


@dataclass(frozen=True)
class ChancePart:
    """A random cause, such as a gust: no rollout predicts it, so it is a part of the noise.

    `share_of_noise`: of the variance that is left with all parts (outliers: of the accelerometer's errors); None where
    it was not estimated. `alias_set`: effects that these drives cannot distinguish from it, itself among them (it is
    added).
    """

    name: str
    probability: float
    share_of_noise: float | None = None
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    plausible: bool = True
    alias_set: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "alias_set", tuple(sorted({self.name, *self.alias_set})))

    def to_dict(self) -> dict[str, Any]:
        out = of_fields(self)
        return {"names": [out.pop("name")]} | out


@dataclass(frozen=True)
class FamilyShare:
    """What acts in one place of the car, under whatever names: `names` of effects that the drives tell apart, and
    `form` of a part without a name, None where there is none; `hidden`: names that may stand behind it.

    `probability`: that something is there. `size_mps2`: root mean square of what it adds to the readings, over
    resampled blocks of the drive. `takes_off`: share of the gap that held-out free runs lose by it, everything else
    refitted without it; what two families can do alike is in neither. Both are None where nothing is likely.

    `excited`: whether an effect of the family would have shown at its typical size. `unseen_mps2`: the root mean square
    that the least visible of its effects could have without showing; None where only chance acts.
    """

    family: str
    names: tuple[str, ...] = ()
    form: str | None = None
    hidden: tuple[str, ...] = ()
    probability: float = 0.0
    size_mps2: Quantity | None = None
    takes_off: Quantity | None = None
    excited: bool = True
    unseen_mps2: float | None = None

    @property
    def present(self) -> bool:
        """Whether something of it is more likely there than not."""
        return self.probability >= LIKELY

    def to_dict(self) -> dict[str, Any]:
        """An entry of `budget.families`."""
        return of_fields(self, intervals=True)


@dataclass(frozen=True)
class Unexplained:
    """The share that is reproducible and that no cause explains.

    `material`: surely more than a user cares for; `probability`: that it is more. Where it is material, `where` holds
    the parts of the drive that it lies in, if any in particular, and `resembles` the effect that promises to explain
    much of it but is not certain enough to be named. `still`: the share of the squared error left that a black box
    takes off on blocks that taught neither, from what it surely does to what the log could have shown. `carried`: what
    of the gap a force without a name takes off, which the repaired simulator carries; a part of `share`.
    """

    share: Quantity
    material: bool
    probability: float = 0.0
    where: tuple[Location, ...] = ()
    resembles: str | None = None
    still: Quantity | None = None
    carried: Quantity | None = None

    @property
    def beyond_carried(self) -> Quantity:
        """The share that the repaired simulator does not carry either."""
        if self.carried is None:
            return self.share
        left = [max(x - y, 0.0) for x, y in ((self.share.q05, self.carried.q05), (self.share.q95, self.carried.q95))]
        mean = max(self.share.mean - self.carried.mean, 0.0)
        return Quantity(mean, self.share.sd, min(mean, *left), max(mean, *left))

    def rest(self, material: float) -> str:
        """What the error that is left is, in words: noise only where no black box could take off what matters."""
        if self.still is None or self.still.q95 < material:
            return "noise"
        low, high = (round(100 * x) for x in (self.still.q05, self.still.q95))
        if low == 0 and high == 100:
            return "noise or what a black box may still foretell: this log cannot tell"
        if high == 100:  # the log bounds it from below alone
            return f"noise but for {low} % or more, which a black box may still foretell"
        return f"noise but for {low} to {high} %, which a black box may still foretell"

    def places(self, epoch_s: float = 0.0) -> str:
        """Where it lies and what it resembles, in words; empty where nothing was found. Times count from `epoch_s`."""
        where = ", ".join(part.words(epoch_s) for part in self.where)
        alike = "" if self.resembles is None else f"most like {self.resembles}"
        return "; ".join(x for x in (where, alike) if x)

    def to_dict(self) -> dict[str, Any]:
        return of_fields(self, intervals=True)


@dataclass(frozen=True)
class ChannelError:
    """Root mean squared error of rollouts in one channel [m/s or m/s²]: before, at the floor, and with all causes."""

    before: float
    floor: float
    left: float


@dataclass(frozen=True)
class Budget:
    """The gap's budget: roots of energies `before`, `left` and `floor` (1 by definition), and where they come from.

    `parts` in the order of their shares; these and `unexplained` sum to 1. `repaired`: `T_L` [s] and `K_L` [-] with all
    parts. Where rollouts show no gap, shares mean nothing. `horizon_s` [s] of the rollouts: 10 s, or the longest
    stretch.
    """

    before: float
    left: float
    by_channel: Mapping[str, ChannelError]
    parts: tuple[Part, ...]
    unexplained: Unexplained
    repaired: Mapping[str, Quantity]
    chance: tuple[ChancePart, ...] = ()
    material: float = MATERIAL
    floor: float = 1.0
    horizon_s: float = HORIZON_S
    by_drives: bool = False
    families: tuple[FamilyShare, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Causes that are named: parts, the largest first, then those that chance decides."""
        return tuple(x.name for x in (*self.parts, *self.chance))

    @property
    def left_above_noise(self) -> float:
        """Share of the squared error that is left, with all parts, which is above the floor; the rest is noise."""
        return max(1.0 - (self.floor / self.left) ** 2, 0.0)

    @property
    def error(self) -> tuple[Quantity, Quantity]:
        """Shares of the squared error that is left: reproducible, and noise; as far as a black box tells them apart."""
        mean, still = self.left_above_noise, self.unexplained.still
        low, high = (mean, mean) if still is None else (min(still.q05, mean), max(still.q95, mean))
        return Quantity(mean, 0.0, low, high), Quantity(1 - mean, 0.0, 1 - high, 1 - low)

    @property
    def shares(self) -> dict[str, Quantity]:
        """Of the gap: of each part, of a force without a name, and of what is unexplained; without any part those of
        `error`."""
        if not self.parts:
            return dict(zip(("unexplained", "noise"), self.error, strict=True))
        carried, rest = self.unexplained.carried, self.unexplained.beyond_carried
        unnamed = {} if carried is None else {UNNAMED: carried}
        return {**{part.name: part.share for part in self.parts}, **unnamed, "unexplained": rest}

    @property
    def verdict(self) -> tuple[str, ...]:
        """`names`; without any `("unknown",)` where something material is reproducible, else `("none",)`."""
        return self.names or (("unknown",) if self.unexplained.material else ("none",))

    @property
    def partial(self) -> bool:
        """Whether causes are named and something material is left besides."""
        return bool(self.names) and self.unexplained.material

    def __str__(self) -> str:
        """What a person reads first."""
        return self.said()

    def said(self, *, told: bool = False) -> str:
        """The parts and the force without a name that the repaired simulator carries, the largest first, small ones by
        their names alone; `told`: the sentence before has told the one part that there is."""
        if not self.parts and self.unexplained.material:
            return "No known effect explains the gap."
        if not self.parts:
            return f"No known effect is missing; the error is {self.unexplained.rest(self.material)}."
        carried, rest = self.unexplained.carried, self.unexplained.beyond_carried.mean
        large = [p for p in self.parts if p.share.mean >= self.material] or [self.parts[0]]
        small = [p.name if p.plausible else _words(p) for p in self.parts if p not in large]
        shares = [] if told else [(p.share.mean, _words(p, f"{percent(p.share.mean)} of the gap")) for p in large]
        if carried is not None and carried.mean >= 0.005:
            what = f"a force of command and speed without a name ({percent(carried.mean)} of the gap)"
            shares.append((carried.mean, what))
        words = ", then ".join(said for _, said in sorted(shares, key=lambda x: -x[0]))
        lines = [f"that is {percent(self.parts[0].share.mean)} of the gap", words] if told else [f"chiefly {words}"]
        if rest >= 0.005 and not told and rest > max(share for share, _ in shares):
            lines = [f"chiefly no known effect explains it ({percent(rest)} of the gap)", words]
            rest = 0.0
        if small:
            lines.append(f"under {percent(self.material)}{' each' if small[1:] else ''}: {listing(small)}")
        if rest >= 0.005:
            lines.append(f"{percent(rest)} is reproducible and no known effect explains it")
        text = "; ".join(filter(None, lines)) + "."
        return text[0].upper() + text[1:]

    @property
    def rest(self) -> str:
        """A sentence on the error that is left, beside the named causes; empty without any, where `str()` tells it."""
        if not self.names:
            return ""
        by_chance, noise = " and ".join(map(_words, self.chance)), self.unexplained.rest(self.material)
        return f"The rest of the error is {f'in part this: {by_chance}; else {noise}' if by_chance else noise}."

    def to_dict(self) -> dict[str, Any]:
        """The object `budget` of `diagnosis.json`."""
        out = {
            "metric": "rollout_10s_over_floor",
            "heldout_by": "drives" if self.by_drives else "blocks",
        }
        keys = ("horizon_s", "before", "floor", "left", "by_channel", "parts", "chance", "families", "unexplained")
        return out | {key: plain(getattr(self, key)) for key in (*keys, "material")}


def _words(part: Part | ChancePart, behind: str = "") -> str:
    """A cause in words; by its name alone where its parameters are not those of such an effect."""
    if not part.plausible:
        return f"{part.name} ({f'{behind}, ' if behind else ''}physically implausible as fitted)"
    return named_cause(part.name, {key: q.mean for key, q in part.parameters.items()}, behind)


def listing(names: Sequence[str], last: str = "and") -> str:
    """Names in a sentence."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def percent(share: float) -> str:
    """A share as it is printed."""
    return "under 1 %" if 0 < share < 0.01 else f"{100 * share:.0f} %"


# from held-out blocks -------------------------------------------------------------------------------------------------
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
    energy, floor = np.stack([held.energy(x) for x in held.steps]), held.energy(held.floor)  # (model, block), (block,)
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
        matters = False
        if held.free:
            before, named, last = resampled(energy[[0, -2, -1]], seed)
            matters = float(np.quantile((named - last) / before, 0.05)) > material
    most = max(sum(p.share.mean for p in parts), 1.0)  # an effect without a name may cost instead of taking off
    parts = [replace(p, share=p.share.scaled(1 / most)) for p in parts]
    carried = shares.get("free form")
    three = np.stack([x.squares.sum(1) for x in (held.steps[0], held.floor, held.steps[-1])], 1)
    levels = np.sqrt(three / held.blocks.sizes.sum())  # (channel, before, floor and left)
    by_chance = (ChancePart(**about(n), share_of_noise=_share_of_noise(posterior, n)) for n in names if n in chance)
    return Budget(
        before=float(np.sqrt(energy[0].mean() / bottom)),
        left=float(np.sqrt(energy[-1].mean() / bottom)),
        by_channel={name: ChannelError(*x) for name, x in zip(held.data.channels, levels.tolist(), strict=True)},
        parts=tuple(parts),
        unexplained=Unexplained(
            Quantity.of_resampled(1 - sum(p.share.mean for p in parts), rest),
            matters,
            average.probabilities["unknown"] if not parts else beyond,
            still=_still(held, seed),
            carried=None if carried is None else Quantity.of_resampled(carried[0], carried),
        ),
        repaired=repaired,
        chance=tuple(by_chance),
        material=material,
        horizon_s=held.horizon_s,
        by_drives=held.blocks.by_drives,
    )


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
        gain, size = max(((gain, size) for gain, size in found if gain > 0 and size > 0), default=(0.0, 0.0))
        if e.name.startswith("~") or not gain:
            continue
        family = family_of(base_name(e.name))
        nats.setdefault(family, []).append(gain)
        sizes.setdefault(family, []).append(size * float(np.sqrt(EFFECT_NATS / gain)))
    return {family: (max(nats[family]), max(sizes[family])) for family in nats}


# inside ---------------------------------------------------------------------------------------------------------------
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
    total = _drawn_squares(posterior, effects, blocks.rows, seed) if effects else np.zeros(1)
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


def _drawn_squares(
    posterior: ParameterPosterior, effects: Sequence[str], parts: Sequence[slice], seed: int = 0
) -> FloatArray:
    """Mean squares (draw,) [(m/s²)²] of what effects do, in the channel that shows it most: at draws of the posterior,
    each over resampled `parts` of the rows."""
    h, draws = posterior.hypothesis, posterior.draws
    x = draws.x.reshape(-1, len(draws.names))
    at = [INDEX[name] for name in draws.names]
    own = [INDEX[c.name] for e in effects for c in EFFECTS[e].coordinates]
    rng, out = np.random.default_rng(seed), np.empty(_SIZES)
    for k, i in enumerate(np.linspace(0, len(x) - 1, _SIZES).astype(int)):
        values = h.values.copy()
        values[at] = x[i]
        without = values.copy()
        without[own] = h.neutral[own]
        does = np.stack(h.rows(values)) - np.stack(h.rows(without))
        squares = np.stack([(does[:, rows] ** 2).mean(1) for rows in parts], 1)
        out[k] = squares[:, rng.integers(0, len(parts), len(parts))].mean(1).max()
    return out


def _takes_off(held: HeldOut, family: str, seed: int) -> Quantity | None:
    """Share of the gap that free runs miss without the family, under resampled blocks."""
    without = held.apart.get(family)
    if without is None:
        return None
    before, after, less, floor = (held.energy(x) for x in (held.steps[0], held.steps[-1], without, held.floor))
    whole = np.maximum(resampled(before - floor, seed), 1e-9)
    draws = np.clip(resampled(less - after, seed) / whole, 0.0, 1.0)
    return Quantity.of_resampled(draws[0], draws)
