"""The loop closed online: plant → log → belief → monitor → action → plant, batched over scenarios."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from avtorch.decision.monitor import Monitor
from avtorch.decision.replay import History, of_scenarios
from avtorch.decision.settings import Setting
from avtorch.decision.strategist import Strategist
from avtorch.decision.watch import Action, SupervisedRun, Watch, WatchedWindow
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.inference.jerk import JerkForm
from avtorch.inference.latent import LatentForm
from avtorch.inference.stream import BeliefStream
from avtorch.io.log import STANDSTILL_MPS
from avtorch.vehicle.block import Block
from avtorch.vehicle.controllers import RAMP_RATE, LinearController
from avtorch.vehicle.loop import ClosedLoop
from avtorch.vehicle.plant import GLVDPlant

_NEVER = 2**62  # steps

HISTORY_S = 20.0
"""Length that the strategist replays [s]: ten windows, long enough for one manoeuvre of the leader."""

ALLOWED: dict[str, frozenset[int]] = {
    "auto": frozenset({1, 2, 3}),
    "1": frozenset({1}),
    "2": frozenset({1, 2}),
    "3": frozenset({1, 3}),
}
"""Strategies that each `strategy` may use: the paper always adopts Strategy 1, and 2 and 3 in addition (Section 4)."""


class Supervisor:
    """Runs a closed `loop` window by window, monitors it, and changes its setting after an alarm.

    The stability verdict is for the setting in force, with the gains of a `LinearController` or the equivalent gains
    that a controller reports (an MPC). For a controller of unknown structure, pass `setting`; its actuation is
    estimated as well, and only the lower level may be changed.

    Where the strategist asks the driver for a longer time gap, lower level and gains change at once, the gap begins to
    move after the driver's delay, and until then the verdicts are on the setting without it.

    Args:
        loop: plant and controllers; its plant may change on the way (`events` of `run`).
        window: length [s], a multiple of the loop's step.
        strategist: chooses actions; None only watches.
        monitor, stream: by default those of the paper's numbers, for the loop's scenarios.
        setting: in force at the start, by default read off the loop's controller and lower level.
        seed: of the sampler's noise.

    Raises `InputError` for a platoon, for parts that do not fit together, and for a strategist that may change what the
    controller cannot.

    Example:
        >>> from avtorch import BeliefStream, ClosedLoop, GLVDPlant, Leader, Supervisor
        >>> loop = ClosedLoop(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(1.5, 0.5))
        >>> watching = Supervisor(loop, stream=BeliefStream(estimator="map"))  # without a strategist it acts on nothing
        >>> [(alert.time_s, alert.detector) for alert in watching.run(4.0).alerts[0]]
        [(2.0, 'stability'), (2.0, 'accepted_change'), (4.0, 'stability'), (4.0, 'accepted_change')]
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
        if stream is None:
            # without a jerk from the plant only the latent form applies; no signal is differenced
            form = JerkForm() if hasattr(loop.plant, "jerk") else LatentForm(accel=True, speed=True)
            stream = BeliefStream(window=window, vehicles=n, form=form, seed=seed)
        if stream.vehicles != n or abs(stream.window - window) > 1e-9:
            raise InputError(
                f"stream: found {stream.vehicles} vehicles and windows of {stream.window:g} s, "
                f"needs the loop's {n} and {window:g} s"
            )
        if strategist is not None:
            _check_reach(strategist, loop)
        self.setting = read_setting(loop) if setting is None else setting.replace(scenarios=n)
        if self.setting.shape != (n,):
            raise InputError(f"setting: found shape {tuple(self.setting.shape)}, needs one or {n} scenarios")
        if monitor is None:
            dead_time = 0.0 if strategist is None else strategist.dead_time
            accepted = (self.setting.T_hat, self.setting.K_hat)
            monitor = Monitor(n, accepted=accepted, dead_time=dead_time, link_delay=loop.link_delay)
        self.watch = Watch(stream, monitor)
        self.default = self.setting
        self.strategist = strategist
        # the decided setting; while a driver is asked, the setting in force lags behind it until the step `_due`
        self._ordered = self.setting
        self._due = torch.full((n,), _NEVER)
        # the model in the lower level is known to be wrong from a detected change until it is updated
        self._model_wrong = torch.zeros(n, dtype=torch.bool)
        self._acted = torch.zeros(n, dtype=torch.bool)
        self._first = loop.steps_done
        self._recent: list[Block] = []
        self._unanswered: list[WatchedWindow] = []

    @shows_progress
    def run(
        self,
        duration: float,
        *,
        events: Sequence[tuple[float, Callable[[ClosedLoop], None]]] = (),
        progress: Callable[[float, float], None] | bool | None = None,
    ) -> SupervisedRun:
        """Advance by `duration` [s]. `events` are `(time [s], change)`: `change(loop)` is called at that time.

        `progress(done, of)` [s] is called after each window; or True, False, None, as in `avtorch.diagnose`. Raises
        `InputError` for less than one step.
        """
        step, loop, n, begun = called(progress), self.loop, self.loop.scenarios, self.loop.time
        if not 0.5 * loop.dt < duration < float("inf"):
            raise InputError(f"duration: found {duration:g} s, needs at least one step of {loop.dt:g} s")
        end = loop.steps_done + round(duration / loop.dt)
        pending = sorted(((round(t / loop.dt), change) for t, change in events), key=lambda event: event[0])
        blocks: list[Block] = []
        windows: list[WatchedWindow] = []
        actions: list[list[Action]] = [[] for _ in range(n)]
        while loop.steps_done < end:
            for watched in self._unanswered:
                self._act(watched, actions)
            self._unanswered = []
            while pending and pending[0][0] <= loop.steps_done:
                pending.pop(0)[1](loop)
            self._comply()
            into = (loop.steps_done - self._first) % self.steps
            until = min(end, loop.steps_done + self.steps - into, int(self._due.min()))
            if pending:
                until = min(until, pending[0][0])
            block = loop.advance(until - loop.steps_done)
            blocks.append(block)
            self._remember(block)
            # an alarm at the run's last step is acted on when the run continues
            self._unanswered = self._feed(block)
            windows += self._unanswered
            if step is not None:
                step(loop.time - begun, duration)
        return SupervisedRun(Block.concatenate(blocks), windows, actions)

    def _feed(self, block: Block) -> list[WatchedWindow]:
        columns = {"accel_cmd": block.accel_cmd, "accel": block.accel, "speed": block.speed, "jerk": block.jerk}
        # a crashed car's rows mean nothing; standstill is not GLVD
        usable = (block.speed >= STANDSTILL_MPS) & ~self.loop.collided[:, None]
        return self.watch.feed(block.time, columns, self.setting, usable=usable, until=self.loop.time)

    def _remember(self, block: Block) -> None:
        """Keep only the rows that the strategist replays."""
        self._recent.append(block)
        enough = round(HISTORY_S / self.loop.dt) + 1
        while sum(len(b.time) for b in self._recent[1:]) >= enough:
            self._recent.pop(0)

    def _act(self, watched: WatchedWindow, actions: list[list[Action]]) -> None:
        if self.strategist is None:
            return
        report, loop = watched.report, self.loop
        # a chosen setting that is still sufficient stays: the paper warns against changing the controller often
        content = self._acted & (self._verdict(watched) >= self.strategist.required)
        self.watch.monitor.accept(report.any & content)
        self._model_wrong |= report.actuation_changed & ~content
        asked = torch.nonzero(report.any & ~content).squeeze(-1)
        if len(asked) == 0:
            return
        T_L, K_L = (watched.window.belief.draws[:, asked, i].mT for i in range(2))
        # the time gap may be on its way to the setting's
        at = getattr(loop.controller, "time_gap_at", None)
        gap_now = self.setting.time_gap if at is None else at(loop.time).expand(loop.scenarios)
        lower = loop.lower_level
        decision = self.strategist.decide(
            T_L,
            K_L,
            History.of_blocks(self._recent, seconds=HISTORY_S)[asked],
            current=self._ordered[asked],
            default=self.default[asked],
            time_gap_now=gap_now[asked],
            model_wrong=self._model_wrong[asked],
            accel_min=of_scenarios(lower.accel_min, asked),
            accel_max=of_scenarios(lower.accel_max, asked),
        )
        changed = decision.changes
        where = torch.zeros(loop.scenarios, dtype=torch.bool).index_put((asked,), changed)
        if bool(changed.any()):
            new = decision.setting
            self._order(self._ordered.map(lambda name, old: old.index_put((asked,), getattr(new, name))))
        gains: list[float | None] = [None] * len(asked)
        if isinstance(loop.plant, GLVDPlant):
            truth = (
                torch.as_tensor(x, dtype=torch.float64).expand(loop.scenarios)[asked]
                for x in (loop.plant.T_L, loop.plant.K_L)
            )
            gains = decision.setting.peak_gain(*truth, link_delay=loop.link_delay).tolist()
        for j, i in enumerate(asked.tolist()):
            if not bool(changed[j]):
                continue
            waits = int(self._due[i]) - loop.steps_done if int(self._due[i]) < _NEVER else 0
            actions[i].append(
                Action(
                    loop.time,
                    sorted(decision.strategies[j]),
                    decision.setting[j : j + 1],
                    decision.why[j],
                    bool(decision.sufficient[j]),
                    float(decision.p_string_stable[j]),
                    gains[j],
                    waits * loop.dt,
                )
            )
        # a state that was acted on, or found sufficient, is the new baseline; where none is sufficient the alarm
        # continues
        sufficient = torch.zeros_like(where).index_put((asked,), decision.sufficient)
        self.watch.monitor.accept(where | sufficient)
        self._model_wrong &= ~where
        self._acted |= where

    def _verdict(self, watched: WatchedWindow) -> Tensor:
        """P(string stable) (scenario,) of the decided setting, which may be in force only once the driver has set the
        time gap."""
        waiting = self._due < _NEVER
        if not bool(waiting.any()):
            return watched.report.p_string_stable
        T_L, K_L = (watched.window.belief.draws[..., i].mT for i in range(2))
        dead_time = self.watch.monitor.dead_time
        soon = self._ordered.p_string_stable(T_L, K_L, dead_time=dead_time, link_delay=self.loop.link_delay)
        return torch.where(waiting, soon, watched.report.p_string_stable)

    def _order(self, setting: Setting) -> None:
        """Put `setting` in force, but for the longer time gaps that a driver is asked for."""
        assert self.strategist is not None
        loop, delay = self.loop, round(self.strategist.driver_delay / self.loop.dt)
        longer = setting.time_gap > self.setting.time_gap + 1e-9
        # the driver has already been asked for this time gap
        asked = (self._due < _NEVER) & ((setting.time_gap - self._ordered.time_gap).abs() <= 1e-9)
        afresh = torch.full_like(self._due, loop.steps_done + delay)
        wait = longer & (delay > 0)
        self._due = torch.where(wait, torch.where(asked, self._due, afresh), _NEVER)
        self._ordered = setting
        self._put_in_force()

    def _comply(self) -> None:
        """Drivers who have had their time set the gap they were asked for."""
        due = self._due <= self.loop.steps_done
        if bool(due.any()):
            self._due = self._due.masked_fill(due, _NEVER)
            self._put_in_force()

    def _put_in_force(self) -> None:
        loop, lower = self.loop, self.loop.lower_level
        gap = torch.where(self._due < _NEVER, self.setting.time_gap, self._ordered.time_gap)
        setting = self._ordered.replace(time_gap=gap)
        if hasattr(loop.controller, "retargeted"):
            rate = RAMP_RATE if self.strategist is None else self.strategist.ramp_rate
            loop.controller = setting.retarget(loop.controller, at=loop.time, rate=rate)
            if not isinstance(loop.controller, LinearController):  # its gains follow from the gap
                setting = setting.replace(gains=read_setting(loop).gains)
        loop.lower_level = setting.lower_level(accel_min=lower.accel_min, accel_max=lower.accel_max)
        self.setting = setting


def read_setting(loop: ClosedLoop) -> Setting:
    """The setting a loop runs with, (scenario,).

    Raises `InputError` for a controller that reports neither gains nor a time gap.
    """
    controller, lower = loop.controller, loop.lower_level
    gains: Any = getattr(controller, "gains", None)
    if gains is None or not hasattr(controller, "time_gap"):
        raise InputError("controller: has no gains and time_gap; give the setting to assume")
    gap = controller.time_gap  # type: ignore[attr-defined]
    k_f = getattr(controller, "feedforward", 0.0)
    return Setting(lower.T_hat, lower.K_hat, lower.T_d, lower.K_d, gap, gains, k_f, scenarios=loop.scenarios)


def _check_reach(strategist: Strategist, loop: ClosedLoop) -> None:
    """Refuse a strategist that may choose what the controller cannot do: the choice would be reported but not
    applied."""
    controller, grid = loop.controller, strategist.grid
    if 4 in grid.allowed and grid.feedforward and abs(strategist.link_delay - loop.link_delay) > 1e-9:
        raise InputError(
            f"strategist: found link_delay {strategist.link_delay:g} s, but the loop's link takes {loop.link_delay:g} s"
        )
    if isinstance(controller, LinearController) or grid.allowed <= {1}:
        return
    if 4 in grid.allowed and grid.feedforward:
        raise InputError("strategist: may feed the leader's acceleration forward, which this controller does not take")
    if not hasattr(controller, "retargeted"):
        raise InputError("strategist: may change time gap or gains, which this controller does not take; allow only 1")
    if grid.gains_of_gap is None:
        raise InputError(
            "strategist: the gains of this controller follow from its time gap; give the grid gains_of_gap"
        )
    if loop.scenarios > 1:
        raise InputError(f"scenarios: found {loop.scenarios}, but this controller has one time gap for all of them")
