"""A number with its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.display import Frame
from avtorch.errors import InputError

_UNITS = {
    "_mps2": "m/s²",
    "_mps3": "m/s³",
    "_mps": "m/s",
    "_radps": "rad/s",
    "_hz": "Hz",
    "_per_m": "1/m",
    "_per_s2": "1/s²",
    "_per_s": "1/s",
    "_s": "s",
    "_m": "m",
}


RESAMPLES = 400
"""Of blocks, with replacement."""


@dataclass(frozen=True)
class Quantity:
    """Mean, standard deviation and the central 90 % of a posterior. Raises `InputError` unless finite and in order."""

    mean: float
    sd: float
    q05: float
    q95: float

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.mean, self.sd, self.q05, self.q95))):
            raise InputError(f"quantity: found {self}, needs finite numbers")
        if self.sd < 0 or self.q05 > self.q95:
            raise InputError(f"quantity: found {self}, needs sd >= 0 and q05 <= q95")

    @classmethod
    def of_draws(cls, draws: Any) -> Quantity:
        """The quantity of draws of any shape (NumPy array, tensor or list)."""
        x = np.asarray(draws.detach() if isinstance(draws, Tensor) else draws, dtype=float).reshape(-1)
        if not len(x):
            raise InputError("draws: found none, needs 1 or more")
        q05, q95 = np.quantile(x, (0.05, 0.95))
        return cls(float(x.mean()), float(x.std(ddof=1)) if len(x) > 1 else 0.0, float(q05), float(q95))

    @classmethod
    def of_resampled(cls, value: float, draws: FloatArray) -> Quantity:
        """A `value` with the interval of `draws` (draw,) under resampled blocks (Efron and Tibshirani 1993), widened to
        hold it."""
        q05, q95 = np.quantile(draws, (0.05, 0.95))
        return cls(float(value), float(draws.std()), float(min(q05, value)), float(max(q95, value)))

    @classmethod
    def of_logarithm(cls, mean: float, variance: float, sure: float) -> Quantity:
        """exp(x) for an x of this `mean` and `variance`; `sure`: half its central 90 % in standard deviations."""
        sd, middle = math.sqrt(variance), math.exp(mean)
        return cls(middle, middle * sd, math.exp(mean - sure * sd), math.exp(mean + sure * sd))

    def scaled(self, by: float) -> Quantity:
        """`by` > 0 times the quantity."""
        return Quantity(by * self.mean, by * self.sd, by * self.q05, by * self.q95)

    def to_dict(self) -> dict[str, float]:
        """The quantity as JSON: mean, sd, q05, q95."""
        return of_fields(self)


def resampled(x: FloatArray, seed: int) -> FloatArray:
    """Means (..., draw) over resampled blocks of `x` (..., block); the first draw is the blocks themselves."""
    blocks = x.shape[-1]
    pick = np.random.default_rng(seed).integers(0, blocks, (RESAMPLES, blocks))
    pick[0] = np.arange(blocks)
    return x[..., pick].mean(-1)


def plain(x: Any) -> Any:
    """As JSON has it: objects by their `to_dict`, or else by their fields; tuples as lists."""
    if hasattr(x, "to_dict"):
        return x.to_dict()
    if is_dataclass(x):
        return of_fields(x)
    if isinstance(x, Mapping):
        return {key: plain(value) for key, value in x.items()}
    return [plain(value) for value in x] if isinstance(x, tuple | list) else x


def of_fields(x: Any, *, intervals: bool = False) -> dict[str, Any]:
    """The fields of a dataclass as JSON; quantities as `intervals`, without their standard deviation."""
    out = {f.name: plain(getattr(x, f.name)) for f in fields(x)}
    for value in out.values() if intervals else ():
        if isinstance(value, dict):
            value.pop("sd", None)
    return out


def frame_of(quantities: Mapping[str, Quantity]) -> Frame:
    """A row a parameter: its unit, mean, sd and the 5 and 95 % quantiles."""
    columns = {key: [getattr(q, key) for q in quantities.values()] for key in ("mean", "sd", "q05", "q95")}
    return Frame({"parameter": list(quantities), "unit": [unit_of(key) for key in quantities], **columns})


def unit_of(key: str) -> str:
    """The unit at the end of a parameter's key: `"delay_s"` has `"s"`; `"-"` for none."""
    if key == "T_L":
        return "s"
    return next((unit for end, unit in _UNITS.items() if key.endswith(end)), "-")


def unit_behind(key: str) -> str:
    """The same behind a number: `" s"`; empty for none."""
    unit = unit_of(key)
    return "" if unit == "-" else f" {unit}"


def words_of(key: str) -> str:
    """A parameter's key as words, its unit left out: `"half_width_mps2"` is "half width"."""
    if key in ("T_L", "K_L"):
        return key
    end = next((end for end in _UNITS if key.endswith(end)), "")
    return key.removesuffix(end).replace("_", " ")
