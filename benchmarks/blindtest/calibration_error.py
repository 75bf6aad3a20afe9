"""How far probabilities are from the shares that turn out true, and how far few cases alone would put them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avtorch.arrays import FloatArray

_DRAWS = 1000


def calibration_error(probabilities: Sequence[float], true: Sequence[bool], bins: int = 10) -> float:
    """Expected calibration error: mean distance of probability and share that is true, over equal bins."""
    return float(_errors(np.array(probabilities), np.array(true, float)[None], bins)[0])


def calibration_by_chance(probabilities: Sequence[float], bins: int = 10, *, seed: int = 0) -> float:
    """The mean `calibration_error` where every one of these probabilities is exactly right.

    A bin of few cases never has its share to the digit, so the error of calibrated probabilities is not 0: what they
    say is drawn a thousand times (consistency resampling, Bröcker and Smith 2007).
    """
    stated = np.array(probabilities)
    drawn = np.random.default_rng(seed).random((_DRAWS, len(stated))) < stated
    return float(_errors(stated, drawn.astype(float), bins).mean())


def _errors(stated: FloatArray, true: FloatArray, bins: int) -> FloatArray:
    """Errors (draw,) of probabilities (case,), of which those are `true` (draw, case) that are 1 there."""
    which = np.minimum((stated * bins).astype(int), bins - 1)
    gaps = (stated - true) @ np.eye(bins)[which]  # (draw, bin)
    return np.asarray(np.abs(gaps).sum(1) / len(stated))
