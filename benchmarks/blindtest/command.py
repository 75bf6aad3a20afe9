"""From sender to actuator: a bus that loses and delays messages, and the conditioning of what arrives.

One message is sent with every row of the log. Messages arrive in order, each after a delay with sub-millisecond
resolution; where one is lost, the last value is held. Conditioning is applied only when the value changes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from benchmarks.blindtest.car import STEP_S

Parameters = Mapping[str, Mapping[str, float]]


class Command:
    """The bus and the conditioning behind it.

    Args: `effects` by name; `lost` (row,) bool, the rows whose message is lost; `start`: command in force before the
    first message arrives [m/s²]; `phase` of a delay that varies [rad].
    """

    def __init__(self, effects: Parameters, *, lost: list[bool] | None, start: float = 0.0, phase: float = 0.0) -> None:
        self._lost = lost
        self._queue: deque[tuple[float, float]] = deque()
        self._delay = effects.get("dead_time", {}).get("delay_s", 0.0)
        self._jitter = effects.get("delay_jitter")
        self._phase = phase
        self._last = 0.0
        self._condition: list[Callable[[float], float]] = []
        self.acts = start
        self.raw = start
        for name, make in _CONDITIONING.items():
            if name in effects:
                self._condition.append(make(effects[name], start))
        self.acts = self._conditioned(start)

    def take_over(self, earlier: Command) -> Command:
        """Continue from the state of `earlier`: its value is held until this bus delivers, its queue is kept."""
        self._queue = earlier._queue
        self._last = earlier._last
        self.raw, self.acts = earlier.raw, self._conditioned(earlier.raw)
        return self

    def _conditioned(self, value: float) -> float:
        for condition in self._condition:
            value = condition(value)
        return value

    def send(self, row: int, time: float, value: float) -> None:
        """The sender's message of one row."""
        if self._lost is not None and self._lost[row]:
            return
        delay = self._delay
        if self._jitter is not None:
            swing = np.sin(2 * np.pi * time / self._jitter["period_s"] + self._phase)
            delay += self._jitter["swing_s"] * 0.5 * (1.0 + float(swing))
        self._last = max(self._last, time + delay)  # a later message does not overtake an earlier one
        self._queue.append((self._last, value))

    def over(self, time: float) -> float:
        """Mean command in force over the millisecond that begins at `time`."""
        queue = self._queue
        if not queue or queue[0][0] >= time + STEP_S - 1e-12:
            return self.acts
        mean, since = 0.0, time
        while queue and queue[0][0] < time + STEP_S - 1e-12:
            arrival, self.raw = queue.popleft()
            arrival = max(arrival, time)
            mean += (arrival - since) * self.acts
            since = arrival
            self.acts = self._conditioned(self.raw)
        return (mean + (time + STEP_S - since) * self.acts) / STEP_S


def losses(rng: np.random.Generator, rows: int, fraction: float) -> list[bool]:
    """Rows whose message is lost: `fraction` of them, in bursts of 1.3 on average (a Gilbert channel)."""
    if fraction <= 0:
        return [False] * rows
    stay = 1 - 1 / 1.3
    enter = min(1.0, fraction * (1 - stay) / (1 - fraction))
    draws = rng.random(rows)
    lost, out = False, []
    for draw in draws.tolist():
        lost = draw < (stay if lost else enter)
        out.append(lost)
    return out


def _dead_band(p: Mapping[str, float], start: float) -> Callable[[float], float]:
    width = p["half_width_mps2"]
    return lambda u: u - width if u > width else u + width if u < -width else 0.0


def _backlash(p: Mapping[str, float], start: float) -> Callable[[float], float]:
    width, state = p["half_width_mps2"], start

    def play(u: float) -> float:
        nonlocal state
        state = min(max(state, u - width), u + width)
        return state

    return play


def _stiction(p: Mapping[str, float], start: float) -> Callable[[float], float]:
    width, state = p["breakaway_mps2"], start

    def stick(u: float) -> float:
        nonlocal state
        if abs(u - state) > width:
            state = u
        return state

    return stick


_CONDITIONING = {"backlash": _backlash, "stiction": _stiction, "dead_band": _dead_band}
