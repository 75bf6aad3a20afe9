"""A car-following policy learnt by reinforcement (`stable-baselines3`'s PPO) in avtorch's own batched closed loop,
monitored, adjusted, and judged.

The policy is a network of 2 x 32 tanh units on what a `LinearController` sees. It is trained on the healthy actuator of
the paper's Table 1 behind random leaders; nothing in its reward says string stability. Then the actuator becomes (1.5
s, 0.5), as in Sec. 4, and Strategy 1 puts the monitor's estimate into the lower level.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from avtorch.decision import Setting, Strategist
from avtorch.decision.grid import Grid
from avtorch.decision.supervisor import Supervisor
from avtorch.errors import InputError
from avtorch.paper.drive import CHANGE_S, CHANGED, HEALTHY, NOISE, change, rows_from
from avtorch.vehicle import (
    ClosedLoop,
    Controller,
    FollowerState,
    GLVDPlant,
    Leader,
    LinearController,
    LowerLevel,
    linearise,
    measured_gain,
    stability,
)
from avtorch.vehicle.performance import rms, rms_about_mean

try:
    import gymnasium as gym
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise InputError("stable-baselines3: not installed; needs pip install 'avtorch[bench]'") from error

DT, TICKS, EPISODE_S = 0.05, 2, 40.0
"""Step of the loop [s], steps that an action is held in training, length of an episode [s]."""
TIME_GAP, STANDSTILL = 1.0, 5.0
SPEEDS, OMEGA = (10.0, 20.0, 30.0), (0.3, 0.5, 0.7, 0.9, 1.1, 1.4, 1.8, 2.5, 4.0)
LIMIT = 3.0  # of a demand [m/s²]
WEIGHTS = (0.02, 0.05, 0.05, 0.02)  # of spacing error², speed difference², demand², change of demand²


def observed(s: FollowerState) -> Tensor:
    """Spacing error, speed difference, acceleration and speed on scales of their own, ``(..., 4)``."""
    error = (s.spacing - TIME_GAP * s.speed - STANDSTILL) / 10.0
    parts = torch.broadcast_tensors(error, (s.lead_speed - s.speed) / 5.0, s.accel / 3.0, s.speed / 20.0 - 1.0)
    return torch.stack(parts, -1).clamp(-3.0, 3.0)


def leaders(count: int, g: torch.Generator) -> Leader:
    """Speeds of 3 to 35 m/s that accelerate by a filtered noise of 0.3 to 1.2 m/s², ``(scenario, time)``."""
    rows = round(EPISODE_S / DT) + 2
    noise = torch.randn(count, rows, generator=g, dtype=torch.float64)
    accel, keep = torch.zeros_like(noise), np.exp(-DT / 2.0)
    for k in range(1, rows):
        accel[:, k] = keep * accel[:, k - 1] + np.sqrt(1 - keep**2) * noise[:, k]
    accel *= 0.3 + 0.9 * torch.rand(count, 1, generator=g, dtype=torch.float64)
    speed = 5.0 + 25.0 * torch.rand(count, 1, generator=g, dtype=torch.float64) + DT * accel.cumsum(-1)
    speed = speed.clamp(3.0, 35.0)
    accel = torch.diff(speed, append=speed[:, -1:]) / DT
    position = DT * (speed + 0.5 * DT * accel).cumsum(-1)
    return Leader(DT * torch.arange(rows, dtype=torch.float64), position, speed, accel, DT, "random leaders")


class Following(VecEnv):
    """`num_envs` cars behind leaders of their own, in one closed loop; an episode ends for all together."""

    def __init__(self, cars: int, seed: int) -> None:
        seen = gym.spaces.Box(-3.0, 3.0, (4,), np.float32)
        super().__init__(cars, seen, gym.spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.generator, self.episodes = torch.Generator().manual_seed(seed), 0
        self.returns: list[float] = []

    def reset(self) -> Any:
        self.episodes += 1
        leader = leaders(self.num_envs, self.generator)
        gap = TIME_GAP * leader.speed[:, 0] + STANDSTILL
        start = gap * (1 + 0.2 * (torch.rand(self.num_envs, generator=self.generator, dtype=torch.float64) - 0.5))
        self.held = torch.zeros(self.num_envs, dtype=torch.float64)
        self.loop = ClosedLoop(
            leader,
            self._act,
            plant=GLVDPlant(*HEALTHY, sigma=NOISE),
            scenarios=self.num_envs,
            seeds=self.episodes * self.num_envs,
            spacing0=start,
        )
        self.asked = torch.zeros_like(self.held)
        self.total = torch.zeros_like(self.held)
        self.loop.advance(1)  # the state is seen by the controller
        return observed(self.state).numpy().astype(np.float32)

    def _act(self, state: FollowerState) -> Tensor:
        self.state = state
        return self.held

    def step_async(self, actions: np.ndarray) -> None:
        self.held = LIMIT * torch.from_numpy(actions[:, 0]).double().clamp(-1.0, 1.0)

    def step_wait(self) -> Any:
        block = self.loop.advance(TICKS)
        seen = observed(self.state)
        error, closing = 10.0 * seen[:, 0], 5.0 * seen[:, 1]
        w = WEIGHTS
        reward = -(w[0] * error.square() + w[1] * closing.square() + w[2] * self.held.square())
        reward = reward - w[3] * (self.held - self.asked).square() / (TICKS * DT)
        reward = (reward - 5.0 * (block.spacing[:, -1] <= 2.0)).clamp_min(-10.0) * 0.1
        self.asked, self.total = self.held, self.total + reward
        out, over = seen.numpy().astype(np.float32), self.loop.time >= EPISODE_S - DT * TICKS
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if over:
            self.returns.append(float(self.total.mean()))
            for i, info in enumerate(infos):
                info |= {"terminal_observation": out[i], "TimeLimit.truncated": True}
            out = self.reset()
        return out, reward.numpy().astype(np.float32), np.full(self.num_envs, over), infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self, method_name)(*args, **kwargs)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Policy:
    """The mean of a trained policy as a controller of the loop."""

    time_gap, standstill = TIME_GAP, STANDSTILL  # where a loop puts the car at the start

    def __init__(self, net: nn.Module) -> None:
        self.net = net

    def __call__(self, state: FollowerState) -> Tensor:
        with torch.no_grad():
            return LIMIT * self.net(observed(state))[..., 0].clamp(-1.0, 1.0)


def learn(*, steps: int, seed: int, cars: int = 128) -> tuple[Policy, list[float], float]:
    """The policy, the mean return of every episode, and the processor seconds of the training."""
    env = Following(cars, seed)
    torch.manual_seed(seed)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=100,
        batch_size=3200,
        n_epochs=8,
        learning_rate=lambda left: 1e-3 * left + 1e-5,
        gamma=0.98,
        ent_coef=0.0,
        policy_kwargs={"net_arch": [32, 32], "log_std_init": -1.0},
        seed=seed,
        device="cpu",
    )
    begun = time.process_time()
    model.learn(steps)
    spent = time.process_time() - begun
    own = model.policy
    net = nn.Sequential(own.mlp_extractor.policy_net, own.action_net).double()
    return Policy(net), env.returns, spent


def judge(controllers: dict[str, Controller], believed: LowerLevel) -> None:
    """Slopes at three speeds with the exact verdict on them; measured swings at 20 m/s, small and large."""
    worn, passed = torch.tensor(CHANGED, dtype=torch.float64), LowerLevel()
    corrected = believed.effective(*worn)
    plants = {"healthy": HEALTHY, "worn": CHANGED, "worn, Strategy 1": tuple(float(x) for x in corrected)}
    print(
        "| controller, speed | k_s, k_v, k_a, time gap by its slopes | bend | exact peak gain of the slopes: "
        + ", ".join(plants)
        + " |\n|---|---|---:|---:|"
    )
    for name, controller in controllers.items():
        for speed in SPEEDS:
            law = linearise(controller, speed)
            peaks = ", ".join(f"{float(stability.peak_gain(*v, law.time_gap, law.gains)):.3f}" for v in plants.values())
            gains = ", ".join(f"{k:.2f}" for k in law.gains)
            print(f"| {name}, {speed:g} m/s | {gains}, {law.time_gap:.2f} s | {law.bend:.2f} | {peaks} |", flush=True)
    print("\n| controller, swing at 20 m/s | measured worst gain: " + ", ".join(plants) + " |\n|---|---:|")
    for name, controller in controllers.items():
        for swing in (0.3, 3.0):
            cells = []
            for car, lower in ((HEALTHY, passed), (CHANGED, passed), (CHANGED, believed)):
                gain = measured_gain(
                    controller,
                    OMEGA,
                    speed=20.0,
                    amplitude=swing,
                    plant=GLVDPlant(*car, 0.0),
                    lower_level=lower,
                    settle=40.0,
                    cycles=2,
                    dt=0.02,
                )
                cells.append(f"{float(gain.max()):.3f}")
            print(f"| {name}, {swing:g} m/s | {', '.join(cells)} |", flush=True)


def supervised(name: str, controller: Controller, *, runs: int = 10) -> tuple[Any, Any, LowerLevel]:
    """80 s behind US06 with the change at 26 s, watched alone and with Strategy 1 allowed; the last lower level."""
    law = linearise(controller, 20.0)
    setting = Setting(time_gap=law.time_gap, gains=law.gains)
    found = []
    for strategist in (None, Strategist(Grid(allowed=frozenset({1})))):
        plant = GLVDPlant(*HEALTHY, sigma=NOISE)
        loop = ClosedLoop(Leader.default(), controller, plant=plant, scenarios=runs, seeds=0)
        supervisor = Supervisor(loop, strategist=strategist, setting=setting, seed=0)
        found.append(supervisor.run(80.0, events=[(CHANGE_S, change)]))
    alone, acted = found
    first = [min((a.time_s for a in x if a.time_s > CHANGE_S), default=np.inf) - CHANGE_S for x in alone.alerts]
    soon = [{a.detector for a in x if a.time_s <= CHANGE_S} for x in alone.alerts]
    early = f"{sum(bool(x) for x in soon)} of {runs}" + "".join(f", {name}" for name in sorted(set().union(*soon)))
    T, K = (float(x.mean()) for x in alone.windows[-1].report.mean)
    before, after = (rows_from(r.rows, 30.0) for r in found)
    calm = [
        float((rms(after.accel) / rms(before.accel)).median()),
        float((rms_about_mean(after.speed) / rms_about_mean(before.speed)).median()),
    ]
    count = sum(bool(x) for x in acted.actions)
    spacing = [float(r.rows.spacing.amin(-1).median()) for r in found]
    hits = [int((r.rows.spacing <= 0).any(-1).sum()) for r in found]
    clipped = [float(r.clipped.double().mean()) for r in (before, after)]
    print(
        f"| {name} | {np.median(first):.0f} to {max(first):.0f} | {early} | {T:.2f} s, {K:.2f} | {count} of {runs} | "
        f"{calm[0]:.3f}, {calm[1]:.3f} | {spacing[0]:.1f} ({hits[0]}), {spacing[1]:.1f} ({hits[1]}) | "
        f"{100 * clipped[0]:.0f}, {100 * clipped[1]:.0f} |",
        flush=True,
    )
    last = [x[-1].setting for x in acted.actions if x]
    return alone, acted, last[0].lower_level() if last else LowerLevel(T, K)


def platoon(controller: Controller, lower: LowerLevel, *, worn: bool) -> tuple[float, float, bool]:
    """Ten cars behind one braking from 22 to 16 m/s and back, 160 s without noise: the energy of the tenth car's speed
    about 22 m/s over the first's, as a ratio of RMS; the least spacing; whether one collided."""
    leader = Leader.from_speed([0, 10, 14, 22, 28, 160], [22, 22, 16, 16, 22, 22], dt=DT, name="one braking")
    loop = ClosedLoop(
        leader,
        controller,
        lower_level=lower,
        plant=GLVDPlant(*(CHANGED if worn else HEALTHY), sigma=0.0),
        vehicles=10,
        spacing0=linearise(controller, 22.0).spacing,
    )
    run = loop.advance(round(160.0 / DT))
    away = rms(run.speed[0] - 22.0)
    return float(away[-1] / away[0]), float(run.spacing.min()), bool(loop.collided.any())


def show(returns: Sequence[float], seconds: float, runs: tuple[Any, Any], path: Path) -> None:
    """The learning curve beside the drive with and without Strategy 1."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplot_mosaic([["learnt", "accel"], ["learnt", "spacing"]], width_ratios=(1, 2))
    axes["learnt"].plot(np.linspace(0, seconds, len(returns)), returns, color="C0")
    axes["learnt"].set(xlabel="processor time of training [s]", ylabel="mean return of an episode")
    axes["learnt"].set_title("Learning, seed 0")
    for run, label, colour in zip(runs, ("no action", "Strategy 1"), ("C3", "C0"), strict=True):
        hit = torch.nonzero(run.rows.spacing[0] <= 0).squeeze(-1)
        end = int(hit[0]) if len(hit) else len(run.rows.time)  # what follows a collision is not physical
        for what in ("accel", "spacing"):
            axes[what].plot(run.rows.time[:end], getattr(run.rows, what)[0, :end], color=colour, lw=1.2, label=label)
        if len(hit):
            axes["spacing"].annotate("collides", (float(run.rows.time[end]), 0.0), (0, 4), textcoords="offset points")
    for what, label in (("accel", "acceleration [m/s²]"), ("spacing", "spacing [m]")):
        axes[what].axvline(CHANGE_S, color="0.5", ls=":", lw=1.0)
        axes[what].set_ylabel(label)
    axes["accel"].set_title("Behind US06; the car changes at the dotted line")
    axes["accel"].legend(loc="lower right", frameon=False)
    axes["spacing"].axhline(0.0, color="0.8", lw=1.0)
    axes["spacing"].set_xlabel("time [s]")
    for ax in axes.values():
        ax.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def compare(*, steps: int = 1_500_000, seed: int = 0, out: Path | None = None) -> None:
    """Train, then print what monitor, slopes, swings and a platoon say of the policy and of the linear law."""
    torch.set_num_threads(1)
    policy, returns, seconds = learn(steps=steps, seed=seed)
    print(
        f"{steps} steps, {len(returns)} episodes of 128 cars, {seconds:.0f} s of one core; mean return "
        f"{returns[0]:.1f} in the first, {returns[-1]:.1f} in the last\n",
        flush=True,
    )
    controllers: dict[str, Controller] = {"learnt policy": policy, "linear law": LinearController()}
    print(
        "| controller | alert after the change [s] | alarms before it | T_L, K_L believed | Strategy 1 taken | "
        "RMS with it / without from 30 s: acceleration, speed | "
        "least spacing [m] (drives that collide): without, with it | clipped without, with it [%] |"
    )
    print("|---|---:|---|---|---|---:|---:|---:|")
    drives = {name: supervised(name, controller) for name, controller in controllers.items()}
    print()
    judge(controllers, drives["learnt policy"][2])
    print(
        "\n| ten cars, one braking | RMS of speed about 22 m/s, car 10 over car 1 | least spacing [m] | collision |\n"
        "|---|---:|---:|---|"
    )
    for name, controller in controllers.items():
        believed = drives[name][2]
        for car, lower, worn in (
            ("healthy", LowerLevel(), False),
            ("worn", LowerLevel(), True),
            ("worn, Strategy 1", believed, True),
        ):
            ratio, least, hit = platoon(controller, lower, worn=worn)
            print(f"| {name}, {car} | {ratio:.3f} | {least:.1f} | {'yes' if hit else 'no'} |", flush=True)
    if out is not None:
        show(returns, seconds, drives["learnt policy"][:2], out)
