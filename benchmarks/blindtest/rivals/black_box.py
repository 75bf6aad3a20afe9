"""A black box: how well a flexible regression predicts the residual on held-out blocks, beyond the noise's own memory.

It detects a gap but cannot name its cause: its answers are `none` and `unknown`.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from avtorch.arrays import FloatArray
from avtorch.io import Log
from benchmarks.blindtest.reply import reply
from benchmarks.blindtest.rivals.maximum_likelihood import Fitter
from benchmarks.blindtest.rivals.residuals import Residuals

_BLOCKS = 20
_MEMORY_S, _ORDER = 0.3, 8
_LAGS_S = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
_RIDGES = (1e-4, 1e-2, 1.0)
"""Ridge penalties of the flexible part; the one that gains most on held-out blocks counts."""


def black_box(log: Log) -> dict[str, Any]:
    """The gain in held-out log likelihood over blocks of the drive, by a t-test.

    Its p-value is turned into odds by the bound of Sellke, Bayarri and Berger (2001), -e p log p, prior odds even.
    """
    fitter = Fitter(Residuals.of(log, rate_hz=log.rate_hz))
    none = fitter.fit()
    tried = [held_out_gains(fitter, none.transformed, ridge) for ridge in _RIDGES]
    gains = max(tried, key=lambda one: one.sum())
    spread = gains.std(ddof=1) / math.sqrt(len(gains))
    p_value = float(student.sf(gains.mean() / max(spread, 1e-12), len(gains) - 1))
    p_value = min(max(len(tried) * p_value, 1e-12), 1.0)  # Bonferroni: the best of this many penalties
    for_none = -math.e * p_value * math.log(p_value) if p_value < 1 / math.e else 1.001
    return reply(
        log,
        {"none": for_none / (1 + for_none), "unknown": 1 / (1 + for_none)},
        why=f"a flexible residual gains {gains.sum():.1f} nats on held-out blocks, p = {p_value:.2g}",
        baseline={name: none.values()[name] for name in ("T_L", "K_L")},
        p_value=p_value,
    )


def held_out_gains(fitter: Fitter, transformed: NDArray[np.complex128], ridge: float) -> FloatArray:
    """Gain in log likelihood (block,) of the flexible regression over autoregression, each block held out in turn."""
    drive = fitter.drive
    valid = drive.valid
    residual = np.fft.irfft(transformed, fitter.spectrum.length, 0)[: len(valid)]
    order = max(_ORDER, round(_MEMORY_S / drive.step))
    at = np.arange(len(valid))
    run = at - np.maximum.accumulate(np.where(valid, -1, at))
    rows = np.flatnonzero(run > order)
    rows = rows[rows >= round(_LAGS_S[-1] / drive.step) + 2]
    memory = np.concatenate([residual[rows - i] for i in range(1, order + 1)], 1)
    features = np.concatenate([memory, _features(drive, residual, rows)], 1)
    block = np.minimum(np.arange(len(rows)) * _BLOCKS // len(rows), _BLOCKS - 1)
    target = residual[rows]
    gains = np.zeros(_BLOCKS)
    plain, flexible = (_held_out(x, target, block, memory.shape[1], ridge) for x in (memory, features))
    for channel in range(target.shape[1]):
        for b in range(_BLOCKS):
            mine = block == b
            before, after = (np.mean(e[mine, channel] ** 2) for e in (plain, flexible))
            gains[b] += 0.5 * mine.sum() * math.log(before / after)
    return gains


def _features(drive: Residuals, residual: FloatArray, rows: NDArray[np.intp]) -> FloatArray:
    """Lagged commands and responses, also nonlinear and times speed; none depends on the row's own noise."""
    command = np.concatenate([one.command.numpy() for one in drive.drives])
    speed = np.concatenate(
        [np.zeros(len(one.time)) if one.speed is None else one.speed.numpy() for one in drive.drives]
    )
    moved = (command, drive.measured[0] - residual[:, 0])
    v = speed[rows - 1]
    columns = [np.ones(len(rows)), v, v**2, np.exp(-v / 2)]
    for x in moved:
        for lag in _LAGS_S:
            delayed = x[rows - 1 - round(lag / drive.step)]
            columns += [
                delayed,
                np.maximum(delayed, 0.0),
                np.tanh(delayed / 0.1),
                delayed * v,
                np.abs(delayed) * delayed,
            ]
    late = rows / rows[-1]
    columns += [command[rows - 1] * late, late, command[rows - 1] * (late > 0.5)]
    return np.stack(columns, 1)


def _held_out(features: FloatArray, target: FloatArray, block: NDArray[np.intp], free: int, ridge: float) -> FloatArray:
    """Errors of regressions fitted without the block; all but the first `free` columns are penalised."""
    scaled = features / np.maximum(np.sqrt(np.mean(features**2, 0)), 1e-9)
    edges = np.searchsorted(block, np.arange(_BLOCKS + 1))
    parts = [slice(a, b) for a, b in pairwise(edges.tolist())]
    grams = [scaled[p].T @ scaled[p] for p in parts]
    crosses = [scaled[p].T @ target[p] for p in parts]
    gram, cross = sum(grams), sum(crosses)
    price = len(scaled) * np.diag(np.where(np.arange(scaled.shape[1]) < free, 1e-9, ridge))
    errors = np.empty_like(target)
    for part, own, mine in zip(parts, grams, crosses, strict=True):
        errors[part] = target[part] - scaled[part] @ np.linalg.solve(gram - own + price, cross - mine)
    return errors
