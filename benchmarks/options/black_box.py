"""An MPC, a small network and a table under the same monitor, and their string stability as far as it can be
determined."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.decision import Setting
from avtorch.errors import InputError
from avtorch.vehicle import (
    MPC,
    ClosedLoop,
    Controller,
    FollowerState,
    GLVDPlant,
    Leader,
    LinearController,
    Linearised,
    linearise,
    measured_gain,
    stability,
)
from benchmarks.options.watched import CHANGE_S, WORN, watched

OMEGA = (0.3, 0.5, 0.7, 0.9, 1.1, 1.4, 1.8, 2.5, 4.0)


class Network:
    """Two layers of 24 tanh units, taught to imitate the linear law on random traffic, demand limited to ±3 m/s²."""

    def __init__(self, seed: int = 0) -> None:
        generator = torch.Generator().manual_seed(seed)
        rows = torch.rand(4096, 4, generator=generator, dtype=torch.float64) * 2.0 - 1.0
        state = self._state(rows)
        wanted = LinearController(time_gap=1.1)(state).clamp(-3.0, 3.0)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.net = torch.nn.Sequential(
                torch.nn.Linear(4, 24),
                torch.nn.Tanh(),
                torch.nn.Linear(24, 24),
                torch.nn.Tanh(),
                torch.nn.Linear(24, 1),
            ).double()
        optimizer = torch.optim.Adam(self.net.parameters(), lr=0.01)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 1500)
        for _ in range(1500):
            optimizer.zero_grad()
            loss = (self._asked(state) - wanted).square().mean()
            loss.backward()
            optimizer.step()
            schedule.step()
        self.error = float(loss.detach().sqrt())

    def __call__(self, state: FollowerState) -> Tensor:
        with torch.no_grad():
            return self._asked(state)

    def _asked(self, s: FollowerState) -> Tensor:
        error = s.spacing - 1.1 * s.speed - 5.0
        inputs = torch.stack([error / 8.0, (s.lead_speed - s.speed) / 4.0, s.accel / 3.0, s.speed / 20.0 - 1.0], -1)
        return self.net(inputs)[..., 0].clamp(-3.0, 3.0)

    @staticmethod
    def _state(rows: Tensor) -> FollowerState:
        error, closing, accel, speed = (rows * torch.tensor([8.0, 4.0, 3.0, 20.0])).unbind(-1)
        speed = speed + 20.0
        return FollowerState(0.0, 1.1 * speed + 5.0 + error, speed, accel, speed + closing, torch.zeros_like(speed))


def table(state: FollowerState) -> Tensor:
    """A look-up table: errors rounded to 0.5 m and 0.25 m/s, accelerations to 0.2 m/s²."""
    rounded = [0.5 * torch.round((state.spacing - state.speed - 5.0) / 0.5)]
    rounded += [0.25 * torch.round((state.lead_speed - state.speed) / 0.25), 0.2 * torch.round(state.accel / 0.2)]
    return 1.5 * rounded[0] + 1.5 * rounded[1] - 0.8 * rounded[2]


def verdicts() -> None:
    """Slopes, their exact verdict, the measured gain, and the monitor's report on a change."""
    network = Network()
    print(f"network: RMS error against the law it imitates {network.error:.3f} m/s²")
    print(
        "| controller | k_s, k_v, k_a, gap by its slopes | bend | exact peak gain of the slopes: healthy, worn | "
        "measured worst, swing 0.3 m/s: healthy, worn | swing 3 m/s | alert after the change [s] | T_L, K_L believed |"
    )
    print("|---|---|---|---|---|---|---|---|")
    controllers: dict[str, Controller] = {
        "linear": LinearController(),
        "MPC": MPC(),
        "network": network,
        "table": table,
    }
    for name, controller in controllers.items():
        law, name = _slopes(name, controller)
        peaks = [
            float(stability.peak_gain(*v, law.time_gap, law.gains, feedforward=law.feedforward))
            for v in ((0.3, 1.0), WORN)
        ]
        swings = [
            float(
                measured_gain(
                    controller, OMEGA, speed=20.0, amplitude=a, plant=GLVDPlant(*v, 0.0), settle=40.0, cycles=2
                ).max()
            )
            for a in (0.3, 3.0)
            for v in ((0.3, 1.0), WORN)
        ]
        setting = Setting(time_gap=law.time_gap, gains=law.gains)

        def loop(leader: Leader, controller: Controller = controller) -> ClosedLoop:
            return ClosedLoop(leader, controller, scenarios=4, seeds=0)

        run = watched(loop, duration=40.0, setting=setting)
        alerts = [min((a.time_s for a in x if a.time_s > CHANGE_S), default=torch.inf) - CHANGE_S for x in run.alerts]
        early = sum(any(a.time_s <= CHANGE_S for a in x) for x in run.alerts)
        T, K = (float(x.mean()) for x in run.windows[-1].report.mean)
        gains = ", ".join(f"{k:.2f}" for k in law.gains)
        print(
            f"| {name} | {gains}, {law.time_gap:.2f} s | {law.bend:.2f} | {peaks[0]:.3f}, {peaks[1]:.3f} | "
            f"{swings[0]:.3f}, {swings[1]:.3f} | {swings[2]:.3f}, {swings[3]:.3f} | "
            f"{max(alerts):.0f} ({early} early) | {T:.2f} s, {K:.2f} |"
        )


def _slopes(name: str, controller: Controller) -> tuple[Linearised, str]:
    """The slopes at 20 m/s from small steps; where these are zero, from steps of ±1, as the name then states."""
    try:
        return linearise(controller, 20.0), name
    except InputError:
        return linearise(controller, 20.0, step=1.0), f"{name} (slopes of ±1)"
