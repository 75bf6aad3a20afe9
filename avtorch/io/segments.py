"""Where a drive is interrupted: gaps, and the unbroken runs of rows between them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.io.clock import ROUNDING_S

GAP_STEPS = 3.0
GAP_SECONDS = 0.1
"""A step longer than both GAP_STEPS median steps and GAP_SECONDS is a gap: what is shorter is jitter or a lost row."""


def stretches(mask: BoolArray, segment: IntArray) -> list[slice]:
    """Unbroken runs of rows, within one segment each, where ``mask`` holds."""
    key = np.where(mask, segment, -1)
    cuts = np.flatnonzero(np.diff(key)) + 1
    edges = [0, *cuts.tolist(), len(key)]
    return [slice(a, b) for a, b in pairwise(edges) if mask[a]]


def median_step(time: FloatArray, same_drive: BoolArray) -> float:
    """Median time between rows [s], steps across drives left out."""
    steps = np.diff(time)
    return float(np.median(steps[same_drive] if same_drive.any() else np.abs(steps)))


def gap_limit(step: float) -> float:
    """The longest time between two rows [s] that is not a gap, at a median ``step`` [s].

    A little more than the bound: two rows lost at 30 Hz make 0.1 s, give or take the rounding of the stamps.
    """
    return max(GAP_STEPS * step, GAP_SECONDS) + ROUNDING_S
