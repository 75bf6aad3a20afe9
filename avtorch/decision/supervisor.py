"""The loop closed online: plant → log → belief → monitor → action → plant, batched over scenarios."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from avtorch.decision.monitor import Monitor
from avtorch.decision.replay import History
from avtorch.decision.settings import Setting
from avtorch.decision.strategist import Strategist
from avtorch.decision.watch import Watch, WatchedWindow
from avtorch.errors import InputError
from avtorch.inference.stream import BeliefStream
from avtorch.io.log import STANDSTILL_MPS
from avtorch.vehicle.block import Block
from avtorch.vehicle.controllers import LinearController
from avtorch.vehicle.loop import ClosedLoop
from avtorch.vehicle.plant import GLVDPlant

HISTORY_S = 20.0
"""What the strategist replays [s]: ten windows, long enough to hold a manoeuvre of the leader."""

Strategy = Literal["auto", "1", "2", "3"]

ALLOWED: dict[str, frozenset[int]] = {
    "auto": frozenset({1, 2, 3}),
    "1": frozenset({1}),
    "2": frozenset({1, 2}),
    "3": frozenset({1, 3}),
}
"""What each `strategy` may use: the paper adopts Strategy 1 at a minimum, 2 and 3 in addition to it (Section 4)."""


@dataclass(frozen=True)
class Alert:
    """`detector` was alarmed at `time_s`, the end of a window; `why` in one sentence."""

    time_s: float
    detector: str
    why: str


@dataclass(frozen=True)
class Action:
    """A new setting, in force from `time_s` on, for one scenario.

    `strategies` lead to `setting` (of shape ``(1,)``) from the default; `sufficient` tells whether it meets the
    strategist's conditions. `peak_gain_true`: the exact peak gain at the true vehicle, None where there is no truth.
    """

    time_s: float
    strategies: list[int]
    setting: Setting
    why: str
    sufficient: bool
    p_string_stable: float
    peak_gain_true: float | None


@dataclass(frozen=True)
class SupervisedRun:
    """What a supervised run leaves: `rows` (scenario, time), `windows`, and per scenario its `alerts` and `actions`."""

    rows: Block
    windows: list[WatchedWindow]
    alerts: list[list[Alert]]
    actions: list[list[Action]]


class Supervisor:
    """Runs a closed `loop` window by window, watches it, and changes its setting where the monitor is alarmed.

    The stability verdict asks the setting in force: the gains are those of a `LinearController`, or the equivalent
    gains of a controller that tells them (an MPC). Another controller of unknown structure is watched with `setting` given;
    its actuation is estimated all the same, and only the lower level may be changed.

    Args:
        loop: plant and controllers; its plant may change on the way (`events` of `run`).
        window: length [s], a multiple of the loop's step.
        strategist: chooses actions; None only watches.
        monitor, stream: by default those of the paper's numbers, for the loop's scenarios.
        setting: in force at the start, by default read off the loop's controller and lower level.
        seed: of the sampler's noise.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        *,
        window: float = 2.0,
        strategist: Strategist | None = None,
        monitor: Monitor | None = None,
        stream: BeliefStream | None = None,
        setting: Setting | None = None,
        seed: int = 0,
    ) -> None:
        if loop.vehicles is not None:
            raise InputError("loop: supervises one follower a scenario, not a platoon")
        self.loop = loop
        self.steps = round(window / loop.dt)
        if self.steps < 2 or abs(self.steps * loop.dt - window) > 1e-9:
            raise InputError(f"window: found {window:g} s, needs a multiple of the step {loop.dt:g} s")
        n = loop.scenarios
        stream = BeliefStream(window=window, vehicles=n, seed=seed) if stream is None else stream
        self.setting = read_setting(loop) if setting is None else setting
        accepted = (self.setting.T_hat, self.setting.K_hat)
        self.watch = Watch(stream, Monitor(n, accepted=accepted) if monitor is None else monitor)
        self.default = self.setting
        self.strategist = strategist
        # the model in the lower level is known to be wrong from a detected change until it is updated
        self._model_wrong = torch.zeros(n, dtype=torch.bool)
        self._acted = torch.zeros(n, dtype=torch.bool)

    def run(
        self,
        duration: float,
        *,
        events: Sequence[tuple[float, Callable[[ClosedLoop], None]]] = (),
        progress: Callable[[float], None] | None = None,
    ) -> SupervisedRun:
        """Advance by `duration` [s]. `events` are `(time [s], change)`: at that time `change(loop)` alters the world.

        `progress(seconds done)` is called after each window.
        """
        loop, n = self.loop, self.loop.scenarios
        end = loop.steps_done + round(duration / loop.dt)
        pending = sorted(((round(t / loop.dt), change) for t, change in events), key=lambda event: event[0])
        blocks: list[Block] = []
        windows: list[WatchedWindow] = []
        alerts: list[list[Alert]] = [[] for _ in range(n)]
        actions: list[list[Action]] = [[] for _ in range(n)]
        while loop.steps_done < end:
            while pending and pending[0][0] <= loop.steps_done:
                pending.pop(0)[1](loop)
            until = min(end, (loop.steps_done // self.steps + 1) * self.steps)
            if pending:
                until = min(until, pending[0][0])
            block = loop.advance(until - loop.steps_done)
            blocks.append(block)
            for watched in self._feed(block):
                windows.append(watched)
                self._note(watched, alerts)
                if self.strategist is not None and loop.steps_done < end:
                    self._act(watched, blocks, actions)
            if progress is not None:
                progress(loop.time)
        return SupervisedRun(Block.concatenate(blocks), windows, alerts, actions)

    def _feed(self, block: Block) -> list[WatchedWindow]:
        columns = {"accel_cmd": block.accel_cmd, "accel": block.accel, "speed": block.speed, "jerk": block.jerk}
        # a crashed car's rows mean nothing; standstill is not GLVD
        usable = (block.speed >= STANDSTILL_MPS) & ~self.loop.collided[:, None]
        return self.watch.feed(block.time, columns, self.setting, usable=usable, until=self.loop.time)

    def _note(self, watched: WatchedWindow, alerts: list[list[Alert]]) -> None:
        report = watched.report
        for i in torch.nonzero(report.any).squeeze(-1).tolist():
            for name in report.names(i):
                alerts[i].append(Alert(watched.window.end_s, name, report.why(name, i)))

    def _act(self, watched: WatchedWindow, blocks: list[Block], actions: list[list[Action]]) -> None:
        assert self.strategist is not None
        report, loop = watched.report, self.loop
        # a setting that was chosen and still does its work stays: the paper warns of changing the controller often
        p = torch.minimum(report.p_string_stable, report.p_local_stable)
        content = self._acted & (p >= self.strategist.required)
        self.watch.monitor.accept(report.any & content)
        self._model_wrong |= report.actuation_changed & ~content
        asked = torch.nonzero(report.any & ~content).squeeze(-1)
        if len(asked) == 0:
            return
        T_L, K_L = (watched.window.belief.draws[:, asked, i].mT for i in range(2))
        gap_now = _time_gap_now(loop, self.setting)
        lower = loop.lower_level
        decision = self.strategist.decide(
            T_L,
            K_L,
            History.of_blocks(blocks, seconds=HISTORY_S)[asked],
            current=self.setting[asked],
            default=self.default[asked],
            time_gap_now=gap_now[asked],
            model_wrong=self._model_wrong[asked],
            accel_min=_of(lower.accel_min, asked),
            accel_max=_of(lower.accel_max, asked),
        )
        changed = decision.changes
        where = torch.zeros(loop.scenarios, dtype=torch.bool).index_put((asked,), changed)
        if bool(changed.any()):
            self._put_in_force(_scatter(self.setting, asked, decision.setting), loop)
        truth = _truth(loop)
        for j, i in enumerate(asked.tolist()):
            if not bool(changed[j]):
                continue
            chosen = decision.setting[j : j + 1]
            gain = None if truth is None else float(chosen.peak_gain(truth[0][i], truth[1][i])[0])
            actions[i].append(
                Action(
                    loop.time,
                    sorted(decision.strategies[j]),
                    chosen,
                    decision.why[j],
                    bool(decision.sufficient[j]),
                    float(decision.p_string_stable[j]),
                    gain,
                )
            )
        # what was acted on, or found good as it is, is the new normal; where nothing is sufficient the alarm goes on
        settled = torch.zeros_like(where).index_put((asked,), decision.sufficient)
        self.watch.monitor.accept(where | settled)
        self._model_wrong &= ~where
        self._acted |= where

    def _put_in_force(self, setting: Setting, loop: ClosedLoop) -> None:
        loop.controller = setting.retarget(loop.controller, at=loop.time)
        lower = loop.lower_level
        loop.lower_level = setting.lower_level(accel_min=lower.accel_min, accel_max=lower.accel_max)
        self.setting = setting


def read_setting(loop: ClosedLoop) -> Setting:
    """The setting a loop runs with, (scenario,).

    Raises `InputError` for a controller that tells neither gains nor a time gap.
    """
    controller, lower = loop.controller, loop.lower_level
    gains: Any = getattr(controller, "gains", None)
    if gains is None or not hasattr(controller, "time_gap"):
        raise InputError("controller: tells no gains and time_gap; give the setting to be judged by")
    gap = controller.time_gap  # type: ignore[attr-defined]
    return Setting(lower.T_hat, lower.K_hat, lower.T_d, lower.K_d, gap, gains, scenarios=loop.scenarios)


def _truth(loop: ClosedLoop) -> tuple[Tensor, Tensor] | None:
    """The vehicle's true (T_L [s], K_L [-]), each (scenario,), where the plant is a GLVD."""
    if not isinstance(loop.plant, GLVDPlant):
        return None
    pair = (torch.as_tensor(x, dtype=torch.float64).expand(loop.scenarios) for x in (loop.plant.T_L, loop.plant.K_L))
    T, K = pair
    return T, K


def _time_gap_now(loop: ClosedLoop, setting: Setting) -> Tensor:
    """The time gap in force [s], (scenario,), on its way to the setting's."""
    if isinstance(loop.controller, LinearController):
        return loop.controller.time_gap_at(loop.time).expand(loop.scenarios)
    return setting.time_gap


def _of(value: float | Tensor, index: Tensor) -> float | Tensor:
    return value[index] if isinstance(value, Tensor) and value.dim() else value


def _scatter(setting: Setting, index: Tensor, new: Setting) -> Setting:
    """`setting` with the scenarios `index` replaced by `new`."""
    return Setting(**{name: getattr(setting, name).index_put((index,), value) for name, value in vars(new).items()})
