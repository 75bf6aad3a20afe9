"""The dead time of a log whose jerk is not measured, from the likelihood of its most excited stretches.

A command that acts later and a longer lag look alike at low frequencies; only the first moments after a change of the
command tell them apart. So the dead time is taken as one for the whole log, and the log likelihoods of several
stretches, each at its own best lag, gain and noise (Laplace's approximation of the evidence), are added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import BoolArray, FloatArray
from avtorch.inference.latent import LatentDensity, LatentWindow, latent_excitation
from avtorch.inference.map import Mode, find_mode
from avtorch.io.log import Log

Command = Callable[[float], tuple[FloatArray, BoolArray]]
"""A dead time [s] to the command that acts in each row's interval [m/s²], and whether the log holds it."""

GRID_S = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
"""Dead times tried first [s]; between the best of them and its neighbours five more."""
STRETCHES, STRETCH_S = 3, 8.0
"""How many stretches are taken, the most excited ones, and their length [s]: enough to hold several changes of the
command, short enough for a twentieth of the log's duration."""
CLEAR = 3.0
"""Nats of evidence over no dead time, a Bayes factor of 20, from which one is claimed."""


@dataclass(frozen=True)
class InferredDeadTime:
    """An inferred dead time.

    `seconds`: the most likely one [s], 0 where none is clear (`CLEAR`). `q05`, `q95`: the central 90 % of its posterior
    under a flat prior over the dead times tried [s]. `nats`: evidence of the most likely one over none.
    """

    seconds: float
    q05: float
    q95: float
    nats: float

    def to_dict(self) -> dict[str, float]:
        """Its attributes by name."""
        return {"seconds": self.seconds, "q05": self.q05, "q95": self.q95, "nats": self.nats}


def infer_dead_time(log: Log, command: Command) -> InferredDeadTime | None:
    """The dead time of a log with ``accel`` and/or ``speed``; None where no stretch is excited."""
    command = cache(command)  # asked for again by every stretch
    stretches = _stretches(log, command(0.0)[0], command(GRID_S[-1])[1])
    if not stretches:
        return None
    coarse = np.array(GRID_S)
    start = _modes(log, command, stretches, 0.0)
    evidence = _evidence(log, command, stretches, start, coarse)
    best = int(evidence.argmax())
    near = coarse[max(best - 1, 0)], coarse[min(best + 1, len(coarse) - 1)]
    # again with the noise of the best: that of a wrong dead time is too large, and makes all look alike
    there = start if best == 0 else _modes(log, command, stretches, float(coarse[best]), start)
    tried = np.union1d(coarse, np.round(np.linspace(*near, 11), 6))
    evidence = _evidence(log, command, stretches, there, tried)
    best = int(evidence.argmax())
    at_best = start if best == 0 else _modes(log, command, stretches, float(tried[best]), there)
    nats = float((_laplace(at_best) - _laplace(start)).sum())
    # the evidence between the points tried is interpolated
    fine = np.linspace(tried[0], tried[-1], 1001)
    density = np.exp(np.interp(fine, tried, evidence) - evidence[best])
    level = np.cumsum(density) / density.sum()
    q05, q95 = (float(fine[np.searchsorted(level, q)]) for q in (0.05, 0.95))
    return InferredDeadTime(float(tried[best]) if nats >= CLEAR else 0.0, q05, q95, nats)


def _stretches(log: Log, u: FloatArray, known: BoolArray) -> list[slice]:
    """The most excited stretches of a log, at least half as long as `STRETCH_S`."""
    rows = max(int(STRETCH_S * log.rate_hz), 20)
    found: list[tuple[float, slice]] = []
    for part in log.segments():
        for first in range(part.start, part.stop - rows // 2, rows):
            piece = slice(first, min(first + rows, part.stop))
            if not (log.usable[piece] & known[piece]).all():
                continue
            excited, bits = latent_excitation(_window(log, piece, u, known))
            if bool(excited[0]):
                found.append((float(bits[0]), piece))
    found.sort(key=lambda each: -each[0])
    return [piece for _, piece in found[:STRETCHES]]


@dataclass(frozen=True)
class _AtNoise:
    """The density of lag and gain at fixed noise: ``log(noise)`` ``(window, parameter)``."""

    density: LatentDensity
    noise: Tensor
    names = ("T_L", "K_L")

    @property
    def windows(self) -> int:
        return self.density.windows

    def log_prob(self, z: Tensor) -> Tensor:
        return self.density.log_prob(torch.cat([z, self.noise.expand(*z.shape[:-1], -1)], -1))

    def initial(self) -> Tensor:
        return self.density.initial()[:, :2]


def _modes(log: Log, command: Command, stretches: list[slice], dead_time: float, near: Mode | None = None) -> Mode:
    """Lag, gain and noise of every stretch at one dead time."""
    density = _density(log, command, stretches, [dead_time])
    begin = None if near is None else near.z
    return find_mode(density, start=begin, from_values=True, iterations=25, tolerance=1e-3)


def _laplace(mode: Mode) -> Tensor:
    """Log evidence of every window by Laplace's approximation [nats], up to a constant."""
    return mode.log_prob + mode.scale.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)


def _evidence(log: Log, command: Command, stretches: list[slice], modes: Mode, tried: FloatArray) -> FloatArray:
    """Log evidence ``(dead time,)`` [nats] over lag and gain, at the noise of the modes, summed over stretches."""
    density = _density(log, command, stretches, tried.tolist())
    start = modes.z.repeat_interleave(len(tried), 0)
    at_noise = _AtNoise(density, start[:, 2:])
    found = find_mode(at_noise, start=start[:, :2], from_values=True, iterations=25, tolerance=1e-3)
    return _laplace(found).reshape(len(stretches), -1).sum(0).numpy()


def _density(log: Log, command: Command, stretches: list[slice], tried: list[float]) -> LatentDensity:
    """Every stretch at several dead times, a window each.

    The rows that the longest dead time leaves without a known command are masked for all, so that all explain the same
    rows.
    """
    known = command(GRID_S[-1])[1]
    each = [_window(log, piece, command(x)[0], known) for piece in stretches for x in tried]
    return LatentDensity(LatentWindow.stack(each))


def _window(log: Log, piece: slice, u: FloatArray, known: BoolArray) -> LatentWindow:
    def rows(values: FloatArray | None) -> Tensor | None:
        return None if values is None else torch.from_numpy(np.ascontiguousarray(values[piece], dtype=np.float64))

    mask = torch.from_numpy(np.asarray(log.usable[piece] & known[piece]))
    time, command = torch.from_numpy(log.elapsed[piece].astype(np.float64)), rows(u)
    assert command is not None
    return LatentWindow.single(time, command, accel=rows(log.accel), speed=rows(log.speed), mask=mask)
