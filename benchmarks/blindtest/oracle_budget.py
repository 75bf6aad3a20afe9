"""The true budget of a case with several causes: what each takes off the error of 10 s rollouts, by an oracle.

The oracle drives the reference vehicle itself along the logged commands, speed and place, with some of the causes and
without the others. Lag and gain are fitted anew to each such car, as a simulator's would be. Its energy is the mean
squared error of rollouts, each channel in units of its own floor, the mean of the channels; the floor is the error of
the vehicle with all causes, so what is left there is noise, gusts, outliers, and what the recorder has done.

Causes enter one by one, each time the one after which the energy is lowest. A cause's share is what it takes off the
energy on top of those before it, over the whole gap. A cause outside the table enters last: its share is what remains
unexplained to whoever knows the table alone. Shares below 0 count as 0; all sum to 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.io import Log
from benchmarks.blindtest.catalogue import EFFECTS, family
from benchmarks.blindtest.replay import Replay
from benchmarks.blindtest.visibility import HORIZON_S

_START_S = 0.5  # over which the measured start of a speed's rollout is averaged
_SHORTEST_S = 2.0
_SETTLED_S = 2.0  # start of a drive, in which no log identifies the actuator's initial state
_LAGS_S = (0.02, 3.0)
_GAINS = (0.1, 3.0)
# of lag and gain, and the share of the energy that a further one must promise. Against 25 trials of 1e-5, shares of 20
# cases of a minute differ by 0.0003 in the median and 0.012 at most, and causes enter in the same order
_TRIALS, _WORTH = 6, 0.003


@dataclass(frozen=True)
class OracleBudget:
    """`before`: root of the energy without any cause, at a floor of 1. `shares` of the causes in the table, the first
    to enter first, and `after`, the root of the energy with it and those before it; `chance`: causes that take nothing
    off a rollout; `unexplained`: share of a cause outside the table. `by_channel`: root mean squared errors before and
    at the floor [m/s², m/s]."""

    before: float
    shares: Mapping[str, float]
    after: Mapping[str, float]
    chance: tuple[str, ...]
    unexplained: float
    by_channel: Mapping[str, tuple[float, float]]

    def to_dict(self) -> dict[str, Any]:
        """As the `budget` of `avtorch.diagnosis/2`, without intervals and probabilities."""
        return {
            "metric": "rollout_10s_over_floor",
            "horizon_s": HORIZON_S,
            "before": self.before,
            "floor": 1.0,
            "by_channel": {name: {"before": b, "floor": f} for name, (b, f) in self.by_channel.items()},
            "parts": [{"names": [n], "share": share, "after": self.after[n]} for n, share in self.shares.items()],
            "chance": [{"names": [name]} for name in self.chance],
            "unexplained": {"share": self.unexplained},
        }


def oracle_budget(replay: Replay, log: Log) -> OracleBudget:
    """The budget of the causes of `replay` in its `log`, over the channels that the log has.

    Example:
        >>> from benchmarks.blindtest import draw_case
        >>> case = draw_case(0, seed=1, mix={"several": 1.0}, seconds=60.0)
        >>> budget = case.budget
        >>> abs(sum(part["share"] for part in budget["parts"]) + budget["unexplained"]["share"] - 1) < 1e-9
        True
    """
    predictable = [name for name in replay.effects if not family(name).by_chance]
    known = [name for name in predictable if name in EFFECTS]
    rollouts = _Rollouts(replay, log)
    floor = rollouts.floor(predictable)
    # like the others fitted to the log, noise and gusts included: else it would not be the lowest
    floor = np.maximum(rollouts.squares(rollouts.errors(predictable, *rollouts.fit(predictable, floor))), 1e-12)
    energy = {frozenset(): rollouts.energy([], floor), frozenset(predictable): 1.0}

    def after(names: Sequence[str]) -> float:
        key = frozenset(names)
        if key not in energy:
            energy[key] = rollouts.energy(names, floor, begin=names[:-1])
        return energy[key]

    entered: list[str] = []
    while len(entered) < len(known):
        entered.append(min((n for n in known if n not in entered), key=lambda n: after([*entered, n])))
    levels = [after(entered[:k]) for k in range(len(entered) + 1)]
    taken = [max(b - a, 0.0) for b, a in pairwise(levels)]
    rest = max(levels[-1] - 1.0, 0.0) if len(known) < len(predictable) else 0.0
    whole = max(sum(taken) + rest, 1e-12)
    before = rollouts.squares(rollouts.errors([], *rollouts.fit([], floor)))
    return OracleBudget(
        before=float(np.sqrt(levels[0])),
        shares={name: share / whole for name, share in zip(entered, taken, strict=True)},
        after={name: float(np.sqrt(level)) for name, level in zip(entered, levels[1:], strict=True)},
        chance=tuple(name for name in replay.effects if name not in predictable),
        unexplained=rest / whole,
        by_channel={
            name: (float(np.sqrt(b)), float(np.sqrt(f)))
            for name, b, f in zip(rollouts.channels, before, floor, strict=True)
        },
    )


def gap_over_floor(replay: Replay, log: Log, T_L: float, K_L: float) -> float:
    """`before` of the budget for a lag [s] and gain that are fitted already: one simulation in place of dozens."""
    rollouts = _Rollouts(replay, log)
    floor = rollouts.floor([name for name in replay.effects if not family(name).by_chance])
    return float(np.sqrt((rollouts.squares(rollouts.errors([], T_L, K_L)) / floor).mean()))


class _Rollouts:
    """Errors of rollouts of the vehicle with some of its causes against a log.

    `channels` of the log, speed first. The rows of both that count: usable, in stretches of 2 s or more.
    """

    def __init__(self, replay: Replay, log: Log) -> None:
        self._replay, self._log = replay, log
        self.channels = tuple(name for name in ("speed", "accel") if getattr(log, name) is not None)
        # a recorder loses rows and keeps the times of the others
        self._row: IntArray = np.searchsorted(replay.run.time, log.time - 1e-6).astype(np.int64)
        self._parts = list(_stretches(log))
        self._fits: dict[frozenset[str], tuple[float, float]] = {}

    def errors(self, names: Sequence[str], T_L: float, K_L: float) -> list[FloatArray]:
        """By channel, (counted row,): speed from its measured start, acceleration from the drive's."""
        response = self._replay.response(names, T_L=T_L, K_L=K_L)
        out = []
        for channel in self.channels:
            error = getattr(self._log, channel) - getattr(response, channel)[self._row]
            pieces = [error[part] for part in self._parts]
            if channel == "speed":
                begin = max(1, round(_START_S * self._log.rate_hz))
                pieces = [piece - piece[:begin].mean() for piece in pieces]
            out.append(np.concatenate([np.zeros(0), *pieces]))
        return out

    @staticmethod
    def squares(errors: Sequence[FloatArray]) -> FloatArray:
        """Mean squares (channel,)."""
        return np.array([np.mean(e**2) if len(e) else 0.0 for e in errors])

    def floor(self, names: Sequence[str]) -> FloatArray:
        """Mean squares (channel,) that the car's true lag and gain leave with all causes that can be predicted."""
        return np.maximum(self.squares(self.errors(names, self._replay.car.T_L, self._replay.car.K_L)), 1e-12)

    def energy(self, names: Sequence[str], floor: FloatArray, *, begin: Sequence[str] | None = None) -> float:
        """Mean over the channels of squared errors over their `floor` (channel,), at the best lag and gain."""
        return float((self.squares(self.errors(names, *self.fit(names, floor, begin=begin))) / floor).mean())

    def fit(
        self, names: Sequence[str], floor: FloatArray, *, begin: Sequence[str] | None = None
    ) -> tuple[float, float]:
        """Lag [s] and gain with the least energy, by Gauss-Newton steps from those of the causes `begin`.

        The slopes of the first step are those of the bare car, which cost no simulation; later ones have learnt from
        every step that was tried (Broyden, Math. Comp. 19 (1965) 577).
        """
        if frozenset(names) not in self._fits:
            car = self._replay.car
            start = (car.T_L, car.K_L) if begin is None else self._fits[frozenset(begin)]
            self._fits[frozenset(names)] = self._fitted(names, floor, start)
        return self._fits[frozenset(names)]

    def _fitted(self, names: Sequence[str], floor: FloatArray, start: tuple[float, float]) -> tuple[float, float]:
        weigh = 1 / np.sqrt(floor)

        def residuals(at: FloatArray, some: Sequence[str]) -> FloatArray:
            errors = self.errors(some, float(np.exp(at[0])), float(at[1]))
            return np.concatenate([w * e for w, e in zip(weigh, errors, strict=True)])

        low = np.array([np.log(_LAGS_S[0]), _GAINS[0]])
        high = np.array([np.log(_LAGS_S[1]), _GAINS[1]])
        at: FloatArray = np.array([np.log(start[0]), start[1]])
        now, small = residuals(at, names), 1e-3
        bare = residuals(at, [])
        slopes = np.stack([(residuals(at + small * unit, []) - bare) / small for unit in np.eye(2)], 1)
        damping = 1e-6
        for _ in range(_TRIALS):
            square = slopes.T @ slopes
            step = np.linalg.solve(square + damping * np.diag(np.diag(square) + 1e-12), -slopes.T @ now)
            step = np.clip(at + np.clip(step, -0.7, 0.7), low, high) - at
            expected = now + slopes @ step
            if now @ now - expected @ expected < _WORTH * (now @ now):
                break
            tried = residuals(at + step, names)
            slopes = slopes + np.outer(tried - expected, step) / (step @ step)
            if tried @ tried < now @ now:
                at, now, damping = np.asarray(at + step, np.float64), tried, damping * 0.1
            else:
                damping = max(damping, 1e-3) * 30
        return float(np.exp(at[0])), float(at[1])


def _stretches(log: Log) -> list[slice]:
    """Usable rows of a log, in unbroken stretches of 2 to 10 s."""
    usable = log.usable & (log.elapsed >= _SETTLED_S)
    longest, shortest = round(HORIZON_S * log.rate_hz), round(_SHORTEST_S * log.rate_hz)
    out = []
    for part in log.segments():
        edges = np.flatnonzero(np.diff(np.concatenate([[0], usable[part].astype(int), [0]]))) + part.start
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            for first in range(begin, end, longest):
                if min(first + longest, end) - first >= shortest:
                    out.append(slice(first, min(first + longest, end)))
    return out
