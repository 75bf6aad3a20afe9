"""Two effects at once: which second one would help a first, and where the two of them come to rest together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.candidate import Candidate
from avtorch.gap.effect import Effect
from avtorch.gap.fit import modes
from avtorch.gap.innovations import Whitener
from avtorch.gap.screening import ENOUGH, Look, looks
from avtorch.gap.starts import of_effect, starts

Float = NDArray[np.float64]

_AT_ONCE = 32
_MANY = 50  # starts of one effect, more than which are left to the fit of that effect alone


def score(
    candidate: Candidate,
    base: Candidate,
    z: Float,
    values: Mapping[str, float],
    onset: int | None,
    white: Whitener,
    alone: Mapping[str, Mapping[str, float]],
) -> tuple[float, Float]:
    """Nats a `candidate` of one effect more could gain on a `base` at `z` (coordinate,), and from which start of its.

    By one linear step from each start, with whatever the base's own parameters can do taken out. `alone`: where single
    effects came to rest, by name and parameter; those with a large grid of starts begin there.
    """
    (more,) = set(candidate.effects) - set(base.effects)
    known = {k: v for k, v in alone.get(more.name, {}).items() if "." in k}
    begin = np.zeros((0, candidate.size))
    if known:
        begin = candidate.z_of({**values, **known})[None]
    if not known or len(of_effect(candidate, more.name)) <= _MANY:
        begin = np.concatenate([begin, starts(candidate, values)])
    if candidate.grade_means is not None and base.grade_means is None:
        flat = white.log_likelihood(base.errors(z[None], onset, coarse=True))[0]
        step, value = modes(candidate, white, begin[:1], onset=onset, iterations=2, coarse=True)
        return float(value[0] - flat), step[0]
    own = _own_directions(base, z, onset, white)
    e = white(base.errors(z[None], onset, coarse=True)).ravel()
    e = e - own.T @ (own @ e)
    silent = base.rollouts(z[None], onset, coarse=True)[0]
    best, at = -np.inf, begin[0]
    for i in range(0, len(begin), _AT_ONCE):
        some = begin[i : i + _AT_ONCE]
        apart = white(candidate.rollouts(some, onset, coarse=True) - silent).reshape(len(some), -1)
        apart = apart - (apart @ own.T) @ own
        square, cross = np.einsum("cr,cr->c", apart, apart), apart @ e
        # a start that overshoots still tells the direction
        gains = np.where(square > 1e-6, 0.5 * np.maximum(cross, 0) ** 2 / np.maximum(square, 1e-6), 0.0)
        k = int(gains.argmax())
        if gains[k] > best:
            best, at = float(gains[k]), some[k]
    return best, at


def joint(
    candidate: Candidate, first: type[Effect], z: Float, onset: int | None, white: Whitener, *, onsets: bool
) -> Look:
    """Where a pair comes to rest: from `z`, and with the `first` effect begun anew.

    Fitted alone, the first has bent to what the second does, often over a hill.
    """
    values = {key: float(x[0]) for key, x in candidate.values(z[None]).items()}
    anew = of_effect(candidate, first.name)
    begin = [z]
    if len(anew) <= _MANY:
        begin += [candidate.z_of({**values, **own, "K_L": k}) for own in anew for k in (values["K_L"], 1.0)]
    found = looks(candidate, white, np.stack(begin), onsets=onsets and onset is None, keep=2)
    if onset is not None or len(begin) > 1:
        found.append(_rest(candidate, white, z, onset))
    return max(found, key=lambda look: look.value)


def swapped(
    pair: Look,
    kinds: Sequence[type[Effect]],
    white: Whitener,
    alone: Mapping[str, Mapping[str, float]],
    *,
    tries: int,
) -> list[Look]:
    """The best pairs that keep one half of `pair` and have another effect in the place of the other."""
    record, baseline = pair.candidate.record, pair.candidate.baseline
    values = {key: float(x[0]) for key, x in pair.candidate.values(pair.z[None]).items()}
    out = []
    for kept in pair.candidate.effects:
        base = Candidate(record, (kept,), baseline)
        own = {k: v for k, v in values.items() if "." not in k or k.startswith(f"{kept.name}.")}
        z = base.z_of(own)
        scored = []
        for kind in kinds:
            if kind in pair.candidate.effects:
                continue
            candidate = Candidate(record, (kept, kind), baseline)
            gain, start = score(candidate, base, z, own, pair.onset, white, alone)
            scored.append((gain, candidate, start))
        scored.sort(key=lambda s: -s[0])
        for gain, candidate, start in scored[:tries]:
            if gain < 2:
                break
            near, value = modes(
                candidate, white, start[None], onset=pair.onset, iterations=6, coarse=True, enough=ENOUGH
            )
            out.append(Look(candidate, near[0], float(value[0]), pair.onset))
    return sorted(out, key=lambda look: -look.value)


def _rest(candidate: Candidate, white: Whitener, z: Float, onset: int | None) -> Look:
    near, value = modes(candidate, white, z[None], onset=onset, iterations=6, coarse=True, enough=ENOUGH)
    return Look(candidate, near[0], float(value[0]), onset)


def _own_directions(base: Candidate, z: Float, onset: int | None, white: Whitener) -> Float:
    """Orthonormal white directions (direction, row) along which the base's own parameters move its rollout."""
    size = len(z)
    moved = np.repeat(z[None], size + 1, 0)
    moved[1:] += 1e-4 * np.eye(size)
    e = white(base.rollouts(moved, onset, coarse=True)).reshape(size + 1, -1)
    columns = e[1:] - e[:1]
    grade = base.grade_means
    if grade is not None:
        columns = np.concatenate([columns, white(grade).reshape(len(grade), -1)])
    norms = np.linalg.norm(columns, axis=1)
    columns = columns[norms > 1e-9] / norms[norms > 1e-9][:, None]
    if not len(columns):
        return np.zeros((0, e.shape[1]))
    axes, sizes, _ = np.linalg.svd(columns.T, full_matrices=False)
    return axes[:, sizes > 1e-6 * sizes[0]].T
