"""Bases with a force map: what a map would gain beside a hypothesis, and the map fitted into the command.

Three bases compete in the same evidence: K u, K u with a resistance R(v), and any F(u, v). The price of a map is
linear, one Gram matrix for all sizes. A base is its fit: lag, gain, recorder and map together, the prior size of the
map chosen anew from round to round, and all sizes summed in the evidence.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.evidence import evaluate_evidence
from avtorch.gap.engine.force_map import MAP_SIZES, MapForm, map_forms, size_log_prior
from avtorch.gap.engine.free_forms import band_products, explained, linear_evidence, map_free_form
from avtorch.gap.engine.gauss_newton import fit, linearised, objective
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import log_sum
from avtorch.gap.engine.priors import UNKNOWN_NATS

_ROUNDS = 3  # of fits, each with the likeliest size of the map
_LAGS_S = (None, 0.3)  # from which a fit with a map begins: the base's own lag was fitted to a wrong force


class Price(NamedTuple):
    """What a form would gain beside a hypothesis [nats], its presence paid for, and its likeliest prior size [-]."""

    form: MapForm
    nats: float

    @property
    def gains(self) -> bool:
        """Whether the drive speaks for it at all: the odds against any map are left out."""
        return self.nats > -UNKNOWN_NATS


def prices(h: Hypothesis) -> list[Price]:
    """Gains of the forms of a map beside a hypothesis with its evidence, by one linear step; none where it has one."""
    if h.force is not None:
        return []
    out = []
    for form in map_forms(h.data):
        found = explained(h, map_free_form(h, form))
        out.append(Price(form.of_size(found.size), found.nats - UNKNOWN_NATS))
    return out


def with_force_map(base: Hypothesis, form: MapForm) -> Hypothesis:
    """A base with a force map, fitted and valued; gains count over `base`, which has none."""
    best = None
    for lag in _LAGS_S:
        h = base.copy()
        h.plain, h.force, h.force_coefficients = base, form, np.zeros(form.count)
        if lag is not None:
            h["T_L"] = lag
        fit(h, 10)
        if best is None or objective(h) > objective(best):
            best = h
    assert best is not None
    for _ in range(_ROUNDS):
        before = best.force
        best = resized(best)
        if before is not None and best.force is not None and before.size == best.force.size:
            break
    best.base = best
    return evaluate_evidence(best)


def resized(h: Hypothesis) -> Hypothesis:
    """The fitted hypothesis with the likeliest prior size of its map, changed in place: effects that do what the map
    did leave a smaller one. One without a map stays as it is."""
    if h.force is None:
        return h
    for _ in range(2):
        nats, size = _of_sizes(h), h.force.size
        k = int(np.argmax(nats))
        h.force = h.force.of_size(float(MAP_SIZES[k]), log_sum(nats) - float(nats[k]))
        if h.force.size == size:
            break
        fit(h, 5, 0.1)
    return h


def _of_sizes(h: Hypothesis) -> FloatArray:
    """Log evidence and log prior (size,) [nats] of each of `MAP_SIZES`, of a map linear around where it is."""
    assert h.force is not None
    slopes, precision, pull = linearised(h, h.free)
    products = band_products(h.data, np.concatenate([h.residual[None], slopes]))
    b, n = h.force_coefficients, len(h.free)
    nats = []
    for size in MAP_SIZES:
        precision[n:], pull[n:] = size**-2, -b / size**2
        value, _ = linear_evidence(h, products, precision, pull, 8, integrated=True)
        nats.append(value - 0.5 * float(b @ b) / size**2 - len(b) * np.log(size))
    return np.array(nats) + size_log_prior()
