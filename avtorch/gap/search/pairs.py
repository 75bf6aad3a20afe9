"""Pairs of effects: screening for the second effect, and the joint fit of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import modes, whitened_jacobian
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.initial_values import effect_starts, start_points
from avtorch.gap.search.onset import allowed
from avtorch.gap.search.screening import Screened, converge, refine, screen
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated

_AT_ONCE = 32
_CLOSELY = 4  # starts of an effect in a long log that are looked at row by row
_MANY = 50  # with more starts of one effect, only the fit of that effect alone is used
_MUCH = 6_000_000  # the same limit for starts times rows


@dataclass(frozen=True, eq=False)
class PairBase:
    """The model to which a second effect is added: a `hypothesis` at `z` (coordinate,), parameter `values`, `white`."""

    hypothesis: Hypothesis
    z: FloatArray
    values: Mapping[str, float]
    onset: int | None
    white: WhiteningFilter

    @cached_property
    def _rested(self) -> tuple[FloatArray, float]:
        """The base's mode under this noise, and its log joint density there."""
        z, value = modes(self.hypothesis, self.white, self.z[None], onset=self.onset, iterations=4)
        return z[0], float(value[0])

    @property
    def flat(self) -> float:
        """Log joint density of the base alone."""
        return self._rested[1]

    @cached_property
    def _fine(self) -> _Directions:
        return _Directions.of(self, self._rested[0], coarse=False)

    @cached_property
    def _coarse(self) -> _Directions:
        return _Directions.of(self, self._rested[0], coarse=True)

    def score(self, hypothesis: Hypothesis, alone: Mapping[str, Mapping[str, float]]) -> tuple[float, FloatArray]:
        """Approximate gain [nats] of a `hypothesis` with one more effect, and the start that gives it.

        From one linear step from each start, with the base's own parameter directions projected out. `alone`: modes of
        single effects, by name and parameter; effects with a large grid of starts begin there. In a long log averaged
        commands choose the starts of a large grid; the gain is that of single rows all the same.
        """
        record = self.hypothesis.record
        (more,) = set(hypothesis.effects) - set(self.hypothesis.effects)
        known = {k: v for k, v in alone.get(more.name, {}).items() if "." in k}
        begin = np.zeros((0, hypothesis.size))
        if known:
            begin = hypothesis.z_of({**self.values, **known})[None]
        if not known or len(effect_starts(hypothesis, more.name)) * record.rows * record.group <= _MUCH:
            begin = np.concatenate([begin, start_points(hypothesis, self.values)])
        if hypothesis.grade_means is not None and self.hypothesis.grade_means is None:
            step, value = modes(hypothesis, self.white, begin[:1], onset=self.onset, iterations=2)
            return float(value[0]) - self.flat, step[0]
        if record.coarse is not record.drives and len(begin) > _CLOSELY:
            begin = begin[np.argsort(-self._coarse.gains(hypothesis, begin), kind="stable")[:_CLOSELY]]
        gains = self._fine.gains(hypothesis, begin)
        k = int(gains.argmax())
        return float(gains[k]), begin[k]

    def partners(
        self, kinds: Sequence[type[Effect]], alone: Mapping[str, Mapping[str, float]], *, most: int, least: float
    ) -> list[tuple[Hypothesis, FloatArray]]:
        """The `most` best hypotheses with one more effect of `kinds`, and their starts; `least` gain in nats."""
        record, baseline, own = self.hypothesis.record, self.hypothesis.baseline, self.hypothesis.effects
        roads = self.hypothesis.integrated is not None  # a hypothesis integrates out one effect at most
        pairs = [
            Hypothesis(record, (*own, kind), baseline)
            for kind in kinds
            if kind not in own and not (roads and issubclass(kind, Integrated))
        ]
        scored = sorted(((*self.score(pair, alone), pair) for pair in pairs), key=lambda s: -s[0])
        return [(pair, start) for gain, start, pair in scored[:most] if gain > least]


@dataclass(frozen=True, eq=False)
class _Directions:
    """What is left of errors and of new directions once a base's own parameters have taken their part.

    `silent`: the base's rollout, `errors` (row,): its whitened errors, apart from `columns` (direction, row), the
    whitened derivatives of the rollout by its parameters, of which `inverse` is the inverse Gram.
    """

    base: PairBase
    coarse: bool
    silent: FloatArray
    columns: FloatArray
    inverse: FloatArray
    errors: FloatArray

    @classmethod
    def of(cls, base: PairBase, z: FloatArray, *, coarse: bool) -> _Directions:
        columns = whitened_jacobian(base.hypothesis, base.white, z, base.onset, coarse=coarse)
        columns = columns[np.linalg.norm(columns, axis=1) > 1e-9]
        inverse = np.asarray(np.linalg.pinv(columns @ columns.T, rcond=1e-10, hermitian=True), np.float64)
        silent = base.hypothesis.rollouts(z[None], base.onset, coarse=coarse)[0]
        measured = base.hypothesis.record.measured
        whole = (measured.mean(-1, keepdims=True) if coarse else measured) - silent
        made = cls(base, coarse, silent, columns, inverse, np.zeros(0))
        return replace(made, errors=made._apart(base.white(whole).reshape(1, -1))[0])

    def _apart(self, images: FloatArray) -> FloatArray:
        """Whitened `images` (column, row), with the base's own parameter directions projected out."""
        return images - (images @ self.columns.T) @ self.inverse @ self.columns

    def gains(self, hypothesis: Hypothesis, begin: FloatArray) -> FloatArray:
        """Gain [nats] (start,) of the best multiple of the direction to each start, as `_gained` has it."""
        out, base = [], self.base
        for i in range(0, len(begin), _AT_ONCE):
            some = begin[i : i + _AT_ONCE]
            moved = hypothesis.rollouts(some, base.onset, coarse=self.coarse) - self.silent
            apart = self._apart(base.white(moved).reshape(len(some), -1))
            # a start that overshoots still gives the direction
            out.append(_gained(apart**2, apart * self.errors, base.onset is None, base.hypothesis.record, self.coarse))
        return np.concatenate(out)


def _gained(squares: FloatArray, crosses: FloatArray, onsets: bool, record: Record, coarse: bool) -> FloatArray:
    """Gain [nats] (column,) of the best multiple of a direction, from rows' contributions (column, row).

    Over the whole drive or, with `onsets`, from any row on.
    """
    square, cross = (
        x.reshape(len(x), -1, record.rows, 1 if coarse else record.group).sum((1, 3))[:, ::-1].cumsum(1)[:, ::-1]
        for x in (squares, crosses)
    )
    gains = np.where(square > 1e-6, 0.5 * np.maximum(cross, 0) ** 2 / np.maximum(square, 1e-6), 0.0)
    if not onsets:
        return gains[:, 0]
    late = gains[:, allowed(record.rows, record.dt)].max(1) - np.log(record.rows)
    return np.maximum(gains[:, 0], late)


def joint_fit(
    hypothesis: Hypothesis,
    first: type[Effect],
    z: FloatArray,
    onset: int | None,
    white: WhiteningFilter,
    *,
    onsets: bool,
) -> Screened:
    """The best fit of a pair: from `z`, and from new starting values of the `first` effect.

    Fitted alone, the first effect has adapted to the second one's response, often in another mode.
    """
    values = {key: float(x[0]) for key, x in hypothesis.values(z[None]).items()}
    anew = effect_starts(hypothesis, first.name)
    begin = [z]
    if len(anew) <= _MANY:
        begin += [hypothesis.z_of({**values, **own, "K_L": k}) for own in anew for k in (values["K_L"], 1.0)]
    found = screen(hypothesis, white, np.stack(begin), onsets=onsets and onset is None, keep=2)
    if onset is not None or len(begin) > 1:
        found.append(converge(hypothesis, white, z, onset))
    return max(found, key=lambda look: look.value)


def exchanged(
    pair: Screened,
    kinds: Sequence[type[Effect]],
    white: WhiteningFilter,
    alone: Mapping[str, Mapping[str, float]],
    *,
    tries: int,
) -> list[Screened]:
    """The best pairs that keep one effect of `pair` and replace the other."""
    record, baseline = pair.hypothesis.record, pair.hypothesis.baseline
    values = {key: float(x[0]) for key, x in pair.hypothesis.values(pair.z[None]).items()}
    out = []
    for kept in pair.hypothesis.effects:
        base = Hypothesis(record, (kept,), baseline)
        own = {k: v for k, v in values.items() if "." not in k or k.startswith(f"{kept.name}.")}
        here = PairBase(base, base.z_of(own), own, pair.onset, white)
        others = [kind for kind in kinds if kind not in pair.hypothesis.effects]
        for hypothesis, start in here.partners(others, alone, most=tries, least=2.0):
            out.append(refine(converge(hypothesis, white, start, pair.onset), white))
    return sorted(out, key=lambda look: -look.value)
