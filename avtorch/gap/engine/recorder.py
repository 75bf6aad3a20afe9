"""The base of every hypothesis: GLVD, or the user's baseline, behind a recorder of unknown delay and filter.

A likelihood in a delay has creases, and a lag and the recorder's lateness trade with each other, so the fit begins from
several places, and of their modes the one stands that best explains what cars do (below 10 Hz).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit, objective, penalty
from avtorch.gap.engine.hypothesis import Hypothesis, compiled, neutral_of
from avtorch.gap.engine.likelihood import claimed, log_likelihood
from avtorch.gap.simulator.plant import GapPlant

_WAYS_IN = ((0.2, 0.0, 0.01), (0.5, 0.0, 0.01), (0.35, -0.015, 0.03), (0.9, 0.0, 0.03))  # T_L, both delays [s]
_DELAYS = {  # [s] tried for each channel, with each filter
    "accel": (-0.02, -0.01, 0.0, 0.0125, 0.025, 0.04, 0.055),
    "speed": (-0.01, 0.0, 0.0125, 0.025, 0.0375, 0.05, 0.065, 0.08),
}
_FILTERS = {"accel": (0.0, 0.02), "speed": (0.0, 0.04)}
_TRADES = (-0.05, -0.02, 0.02, 0.05)  # [s] moved between delays and lag
_ALIGNED_S = 0.012  # a difference of the channels' lateness that a row hides
_MOST_ALIGN_S = 0.06


def base_fit(data: DriveData, baseline: GapPlant | None = None, *, alone: bool = False) -> Hypothesis:
    """The fitted base, a hypothesis without effects beyond those of the user's `baseline`."""
    best = None
    for lag, accel_delay, speed_delay in _WAYS_IN:
        h = Hypothesis(data, alone=alone)
        if baseline is not None:
            h.neutral = neutral_of(baseline)
            h.values = h.neutral.copy()
            h.baseline = None if compiled(baseline) else baseline
        h["T_L"] = lag
        if data.accel is not None:
            h["accel_delay"], h["accel_filter"] = accel_delay, 0.015
        if data.speed is not None:
            h["speed_delay"], h["speed_filter"] = speed_delay, 0.02
        fit(h, 12)
        if best is None or _claim(h) > _claim(best):
            best = h
    assert best is not None
    other = _scan_lateness(best)
    return traded(other if _claim(other) > _claim(best) else best)


def aligned(h: Hypothesis) -> DriveData | None:
    """The data with both channels in phase, as far as the recorder's lateness is known by now; None: they are."""
    if h.data.channel_count < 2:
        return None
    late = h["speed_delay"] + h["speed_filter"] - h["accel_delay"] - h["accel_filter"]
    late = float(np.clip(late, 0.0, _MOST_ALIGN_S))
    return h.data.with_align(late) if abs(late - h.data.align_s) > _ALIGNED_S else None


def traded(h: Hypothesis) -> Hypothesis:
    """The hypothesis after time has been traded between delays and lag, where that gains in both bands."""
    names = h.free
    best, value, claim = h, objective(h), _claim(h)
    groups = [["accel_delay", "speed_delay"], ["dead_time"], ["accel_delay"], ["speed_delay"]]
    for shift in _TRADES:
        for group in groups:
            if not set(group) <= set(names):
                continue
            for kept in (1.0, 0.0):  # the sum of delay and lag, or the lag
                new = h.copy()
                for name in group:
                    low, high = h.limits(name)
                    new[name] = min(max(h[name] + shift, low), high)
                new["T_L"] = max(h["T_L"] - kept * shift, 0.03)
                new.evaluate()
                if objective(new) > value + 0.1 and _claim(new) > claim:
                    best, value, claim = new, objective(new), _claim(new)
    return h if best is h else fit(best, 6)


def _claim(h: Hypothesis) -> float:
    return claimed(h.data, h.covariance) + penalty(h, h.free)


def _scan_lateness(h: Hypothesis) -> Hypothesis:
    """The best of a grid of delays and filters: a channel depends on its own alone, so that the grid is cheap."""
    data, value, best = h.data, objective(h), None
    for lag in (h["T_L"], 0.85 * h["T_L"], 1.15 * h["T_L"]):
        new = h.copy()
        new["T_L"] = lag
        signals = new.on_grid()
        each = [_residuals(new, signals, channel, c) for c, channel in enumerate(data.channels)]
        for first in each[0]:
            for second in each[1] if len(each) > 1 else [None]:
                tried = [first] if second is None else [first, second]
                for channel, (delay, time_constant, _) in zip(data.channels, tried, strict=True):
                    new[f"{channel}_delay"], new[f"{channel}_filter"] = delay, time_constant
                v = log_likelihood(data, np.stack([x for *_, x in tried]))[0] + penalty(new, new.free)
                if v > value + 0.1:
                    value, best = v, new.values.copy()
    if best is None:
        return h
    new = h.copy()
    new.values = best
    return fit(new, 10)


def _residuals(
    h: Hypothesis, signals: tuple[FloatArray, FloatArray], channel: str, c: int
) -> Sequence[tuple[float, float, FloatArray]]:
    """Delay, filter and residual (frame, bin) of one channel over the grid."""
    out = []
    for delay in _DELAYS[channel]:
        for time_constant in _FILTERS[channel]:
            p = h.values.copy()
            p[INDEX[f"{channel}_delay"]], p[INDEX[f"{channel}_filter"]] = delay, time_constant
            rows = h.recorded(*signals, p)[c]
            out.append((delay, time_constant, h.data.measured[c] - h.data.transform([rows])[0]))
    return out
