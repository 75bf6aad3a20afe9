"""The budget by families: what acts in each place of the car, whatever its name, and what could act there unseen.

Sizes are root mean squares of what a family's parts add to the readings, over draws of their parameters and resampled
blocks of the drive, so that one half of it may tell of the other. What a family takes off is the difference of held-out
free runs with and without it, everything else refitted; so the order in which causes enter changes nothing.

An effect that is not there would gain half the square of its response in units of the noise, less what the parameters
that are free take up. The size at which that is what an effect's presence costs is the least that shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, base_name
from avtorch.gap.engine.family import FAMILIES, FORMS, OWN, family_of
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import EFFECT_NATS
from avtorch.gap.engine.search import Projection, tried
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import LIKELY, FamilyShare
from avtorch.gap.result.free_form import FittedForm
from avtorch.gap.result.free_runs import Blocks
from avtorch.gap.result.gap_budget import resamples
from avtorch.gap.result.held_out import HeldOut
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.result.parts import AnswerPart, map_size

_DRAWS = 48


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
    rng = np.random.default_rng(seed)
    total = np.zeros(_DRAWS)
    if effects:
        total += _drawn_squares(posterior, effects, blocks, rng)
    if any(part.name is None and part.form not in FORMS for part in own) and h.force is not None:
        if not effects:
            return map_size(h, seed)
        total += map_size(h, seed).mean ** 2
    elif free is not None:
        adds = free.without([])
        total += _resampled(blocks, np.interp(h.data.time, h.data.grid.time, adds)[None], rng)
    if total.any():
        return Quantity.of_draws(np.sqrt(total))
    return next((part.size_mps2 for part in own if part.size_mps2 is not None), None)


def _drawn_squares(
    posterior: ParameterPosterior, effects: Sequence[str], blocks: Blocks, rng: np.random.Generator
) -> FloatArray:
    h, draws = posterior.hypothesis, posterior.draws
    x = draws.x.reshape(-1, len(draws.names))
    at = [INDEX[name] for name in draws.names]
    own = [INDEX[c.name] for e in effects for c in EFFECTS[e].coordinates]
    out = np.empty(_DRAWS)
    for k, i in enumerate(np.linspace(0, len(x) - 1, _DRAWS).astype(int)):
        values = h.values.copy()
        values[at] = x[i]
        without = values.copy()
        without[own] = h.neutral[own]
        does = np.stack(h.rows(values)) - np.stack(h.rows(without))
        out[k] = _resampled(blocks, does, rng, 1)[0]
    return out


def _resampled(blocks: Blocks, does: FloatArray, rng: np.random.Generator, count: int = _DRAWS) -> FloatArray:
    """Mean squares (draw,) of rows (channel, row) over resampled blocks, of the channel that shows it most."""
    squares = np.stack([(does[:, rows] ** 2).mean(1) for rows in blocks.rows], 1)
    pick = rng.integers(0, len(blocks.rows), (count, len(blocks.rows)))
    return squares[:, pick].mean(-1).max(0)


def _takes_off(held: HeldOut, family: str, seed: int) -> Quantity | None:
    """Share of the gap that free runs miss without the family, under resampled blocks."""
    without = held.apart.get(family)
    if without is None:
        return None
    before, after, floor = (x.squares for x in (held.steps[0], held.steps[-1], held.floor))
    scale = np.maximum(np.minimum(floor, after).mean(1), 1e-12)[:, None]
    before, after, less, floor = ((x / scale).mean(0) for x in (before, after, without.squares, floor))
    pick = resamples(len(after), np.random.default_rng(seed))
    whole = np.maximum((before - np.minimum(floor, after))[pick].mean(1), 1e-9)
    draws = np.clip((less - after)[pick].mean(1) / whole, 0.0, 1.0)
    return Quantity.of_resampled(draws[0], draws)
