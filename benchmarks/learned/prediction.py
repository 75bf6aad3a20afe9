"""Predictive networks of the acceleration beside GLVD with a dead time: one step and ten seconds ahead.

All see commands and speeds at 20 Hz. GLVD (lag, gain, dead time, a constant) and the recurrent network minimise the
same loss, the error of speed over rollouts of 5 s; the feed-forward network learns one step from half a second of the
past. Rollouts get the measured past of 2 s, then the commands alone.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor, nn

from avtorch.io import Log
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader

DT, WARM, AHEAD, LEARNT = 0.05, 40, 200, 100  # [s], rows of the past, of a rollout, of a rollout that is learnt from
BACK = 10  # rows that the feed-forward network sees
UNITS = 24  # of the recurrent network
SLOPE = 6  # rows over which a speed's slope is taken at the start
NOISE_MPS = 0.002
Drive = Tensor
"""Commands [m/s²] and speeds [m/s], ``(time, 2)``."""


class Model(Protocol):
    def rollout(self, past: Tensor, u: Tensor) -> Tensor:
        """Speeds ``(drive, row)`` after the last row of ``past`` ``(drive, row, 2)``, under commands ``u``
        ``(drive, row)``; the first of them acts with the last past row."""
        ...


class Persistence:
    """The acceleration stays what it was."""

    def rollout(self, past: Tensor, u: Tensor) -> Tensor:
        return past[:, -1:, 1] + _slope(past)[:, None] * DT * torch.arange(1, u.shape[1] + 1)


class DelayedGLVD:
    """Eq. 1 behind a dead time, with a constant for a slope or an offset of the command.

    The acceleration at the start is that of the past's commands, moved by as much as the slope of the last 0.3 s of
    speed differs from it.
    """

    def __init__(self, lag: float, gain: float, dead: float, constant: float) -> None:
        self.lag, self.gain, self.dead, self.constant = max(lag, 0.01), gain, dead, constant

    def rollout(self, past: Tensor, u: Tensor) -> Tensor:
        late = min(max(self.dead, 0.0) / DT, WARM - SLOPE - 4.0)
        whole, part = int(late), late - int(late)
        sent = torch.cat([past[:, :-1, 0], u], 1)
        first, keep = past.shape[1] - 1, float(np.exp(-DT / self.lag))
        wish = self.gain * ((1 - part) * sent[:, 1:] + part * sent[:, :-1]) + self.constant
        a, v, speeds = wish[:, 0], torch.zeros_like(u[:, 0]), []
        for k in range(whole + 1, sent.shape[1]):
            if k == first:
                a = a + _slope(past) - (v - speeds[-SLOPE - 1]) / (SLOPE * DT)
                v, speeds = past[:, -1, 1], []
            target = wish[:, k - whole - 1]
            v = v + DT * target + (a - target) * self.lag * (1 - keep)
            a = target + (a - target) * keep
            speeds.append(v)
        return torch.stack(speeds, 1)

    @classmethod
    def fit(cls, drives: Sequence[Drive]) -> DelayedGLVD:
        past, u, v = pieces(drives, LEARNT, 20)

        def model(x: np.ndarray) -> DelayedGLVD:
            return cls(float(np.exp(x[0])), float(np.exp(x[1])), float(x[2]), float(x[3]))

        def loss(x: np.ndarray) -> float:
            return float((model(x).rollout(past, u) - v).square().mean())

        start = np.array([np.log(0.3), 0.0, 0.1, 0.0])
        # a car's: 10 ms to 4 s, a tenth to thrice the command, at most a second late
        bounds = [(np.log(0.01), np.log(4.0)), (np.log(0.1), np.log(3.0)), (0.0, 1.0), (-1.0, 1.0)]
        found = minimize(loss, start, method="Nelder-Mead", bounds=bounds, options={"maxiter": 300, "xatol": 1e-3})
        return model(found.x)


class OneStep(nn.Module):
    """Two layers of 32 units: the slope of the next step from the last rows of command, slope and speed."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(2 * BACK + 1, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 1))

    def forward(self, u: Tensor, a: Tensor, v: Tensor) -> Tensor:
        """`u`, `a` ``(drive, BACK)``, `v` ``(drive,)``; the next slope ``(drive,)``."""
        return self.net(torch.cat([u, a, v[:, None] / 10 - 1], -1))[:, 0]

    def rollout(self, past: Tensor, u: Tensor) -> Tensor:
        sent = torch.cat([past[:, -BACK:-1, 0], u], 1)
        slopes = list((past[:, 1:, 1] - past[:, :-1, 1]).div(DT)[:, -BACK:].unbind(1))
        v, speeds = past[:, -1, 1], []
        for k in range(u.shape[1]):
            slopes.append(self(sent[:, k : k + BACK], torch.stack(slopes[-BACK:], 1), v))
            v = v + DT * slopes[-1]
            speeds.append(v)
        return torch.stack(speeds, 1)

    def fit(self, drives: Sequence[Drive], *, steps: int, seed: int) -> OneStep:
        past, u, v = pieces(drives, 1, 1)
        return _fitted(self, past, u, v, steps=4 * steps, batch=256, seed=seed)


class Recurrent(nn.Module):
    """A GRU cell of 24 units: the past warms it up with measured speeds, then its own come back.

    `dt` [s] of its rows; `middle` and `spread` of commands, slopes and speeds, by which they are scaled.
    """

    def __init__(
        self, dt: float = DT, middle: Sequence[float] = (0.0, 0.0, 10.0), spread: Sequence[float] = (1.0, 1.0, 10.0)
    ) -> None:
        super().__init__()
        self.cell, self.out = nn.GRUCell(3, UNITS), nn.Linear(UNITS, 1)
        self.dt, self.middle, self.spread = dt, torch.tensor(middle), torch.tensor(spread)

    def forward(self, u: Tensor, a: Tensor, v: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """The next slope ``(drive,)`` and state, from command, last slope and speed ``(drive,)``."""
        h = self.cell((torch.stack([u, a, v], -1) - self.middle) / self.spread, h)
        return self.spread[1] * self.out(h)[:, 0], h

    def rollout(self, past: Tensor, u: Tensor) -> Tensor:
        h = past.new_zeros(len(past), UNITS)
        slope = (past[:, 1:, 1] - past[:, :-1, 1]) / self.dt
        for k in range(1, past.shape[1] - 1):
            _, h = self(past[:, k, 0], slope[:, k - 1], past[:, k, 1], h)
        v, a, speeds = past[:, -1, 1], slope[:, -1], []
        for k in range(u.shape[1]):
            a, h = self(u[:, k], a, v, h)
            v = v + self.dt * a
            speeds.append(v)
        return torch.stack(speeds, 1)

    def fit(self, drives: Sequence[Drive], *, steps: int, seed: int) -> Recurrent:
        past, u, v = pieces(drives, LEARNT, 5)
        return _fitted(self, past, u, v, steps=steps, batch=32, seed=seed)


def _fitted(net, past: Tensor, u: Tensor, v: Tensor, *, steps: int, batch: int, seed: int):
    g = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        some = torch.randint(len(past), (batch,), generator=g)
        loss = (net.rollout(past[some], u[some]) - v[some]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return net


def _slope(past: Tensor) -> Tensor:
    """Slope of the last 0.3 s of speed [m/s²]."""
    return (past[:, -1, 1] - past[:, -SLOPE - 1, 1]) / (SLOPE * DT)


def pieces(drives: Sequence[Drive], ahead: int, every: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pasts, commands and speeds of rollouts of `ahead` rows that begin every so many rows."""
    past, u, v = [], [], []
    for drive in drives:
        for k in range(WARM, len(drive) - ahead, every):
            past.append(drive[k - WARM + 1 : k + 1])
            u.append(drive[k : k + ahead, 0])
            v.append(drive[k + 1 : k + ahead + 1, 1])
    return torch.stack(past), torch.stack(u), torch.stack(v)


def errors(model: Model, drives: Sequence[Drive]) -> tuple[float, float]:
    """RMS error of the acceleration [m/s²] of the next step, and of that over 0.2 s anywhere in the next 10 s."""
    found = []
    with torch.no_grad():
        for ahead in (1, AHEAD):
            past, u, v = pieces(drives, ahead, 7)
            off = model.rollout(past, u) - v
            wide = 1 if ahead == 1 else 4
            off = torch.cat([torch.zeros_like(off[:, :1]), off], 1)
            found.append(float(((off[:, wide:] - off[:, :-wide]) / (wide * DT)).square().mean().sqrt()))
    return found[0], found[1]


def thinned(u: Tensor, v: Tensor, step: int) -> Drive:
    """Means of `step` commands that act until the speed of their end."""
    rows = (len(u) - 1) // step
    mean = u[: rows * step].reshape(rows, step).mean(-1)
    return torch.stack([mean, v[: rows * step : step]], -1).float()


class GearedPlant:
    """A car that GLVD does not describe: drag, a lag that halves under braking, a gain that falls with speed.

    The constants are such that at 15 m/s under power it is GLVD of 0.3 s and 0.85.
    """

    sigma = 0.1

    def step(self, a: Tensor, v: Tensor, u: Tensor, dt: float, eps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lag = torch.where(u < 0, 0.15, 0.3)
        wish = torch.where(u < 0, 1.0, 1.0 - 0.01 * v) * u - 6e-4 * v.square()
        moved = wish + (a - wish) * torch.exp(-dt / lag) + dt * eps
        ahead = v + 0.5 * dt * (a + moved)
        return moved, ahead, 0.5 * dt * (v + ahead)


def simulated(plant, begin: float, seconds: float, seed: int) -> Drive:
    """A drive behind US06 from `begin` [s] on."""
    leader = Leader.default(start=begin, duration=seconds + 1.0)
    block = ClosedLoop(leader, plant=plant, seeds=seed).advance(round(seconds / leader.dt))
    g = torch.Generator().manual_seed(seed)
    read = block.speed[0] + NOISE_MPS * torch.randn(block.speed[0].shape, generator=g, dtype=torch.float64)
    return thinned(block.accel_cmd[0], read, round(DT / leader.dt))


def cases() -> dict[str, tuple[list[Drive], list[Drive], list[Drive]]]:
    """Drives to learn from, more of another car that a network may have learnt from before, drives to predict."""
    healthy, worn, geared = GLVDPlant(0.3, 1.0, sigma=0.1), GLVDPlant(1.5, 0.5, sigma=0.1), GearedPlant()
    long = [simulated(healthy, 40.0, 280.0, 1)]
    found = {
        "simulated GLVD, 60 s": ([simulated(healthy, 40.0, 60.0, 0)], [], [simulated(healthy, 340.0, 200.0, 9)]),
        "drag, gain and lag that vary, 60 s": (
            [simulated(geared, 40.0, 60.0, 0)],
            [],
            [simulated(geared, 340.0, 200.0, 9)],
        ),
        "drag, gain and lag that vary, 280 s": (
            [simulated(geared, 40.0, 280.0, 1)],
            [],
            [simulated(geared, 340.0, 200.0, 9)],
        ),
        "20 s of a worn car, 280 s of the healthy one": (
            [simulated(worn, 180.0, 20.0, 2)],
            long,
            [simulated(worn, 340.0, 200.0, 9)],
        ),
    }
    folder = os.environ.get("AVTORCH_DATA")
    if folder:
        laps = []
        for lap in (1, 2, 3):
            log = Log.read(Path(folder) / "genesis" / f"lap{lap}.csv")
            laps.append(thinned(torch.as_tensor(log.accel_cmd), torch.as_tensor(log.speed), round(DT * 100)))
        found["Genesis, laps 1 and 2 for lap 3"] = (laps[:2], [], laps[2:])
    return found


def compare(*, steps: int = 200, seeds: int = 2) -> None:
    """Print one table: errors of each model, one step / 10 s, means over the networks' seeds."""
    torch.set_num_threads(1)
    nets: dict[str, Callable[[], OneStep | Recurrent]] = {"one-step network": OneStep, "GRU": Recurrent}
    print("| learnt from | persistence | GLVD | " + " | ".join(nets) + " | T_L, K_L, dead time | s: GLVD, networks |")
    print("|---|" + "---:|" * (4 + len(nets)))
    for name, (own, before, test) in cases().items():
        begun = time.process_time()
        glvd = DelayedGLVD.fit(own)
        spent = [time.process_time() - begun]
        cells = [errors(Persistence(), test), errors(glvd, test)]
        for make in nets.values():
            begun, tries = time.process_time(), []
            for seed in range(seeds):
                torch.manual_seed(seed)
                net = make()
                if before:
                    net.fit(before, steps=steps, seed=seed)
                tries.append(errors(net.fit(own, steps=steps // 4 if before else steps, seed=seed), test))
            spent.append((time.process_time() - begun) / seeds)
            cells.append(tuple(statistics.fmean(x) for x in zip(*tries, strict=True)))
        figures = " | ".join(f"{one:.3f} / {far:.3f}" for one, far in cells)
        car = f"{glvd.lag:.2f} s, {glvd.gain:.2f}, {glvd.dead:.2f} s"
        print(f"| {name} | {figures} | {car} | {', '.join(f'{x:.0f}' for x in spent)} |", flush=True)
