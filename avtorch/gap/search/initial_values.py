"""Where a search begins: a few values of each effect's parameters, for what has more than one hill to climb."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from math import prod

import numpy as np
import torch
from numpy.typing import NDArray

from avtorch.gap.likelihood.hypothesis import Hypothesis

Float = NDArray[np.float64]

GRIDS: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "dead_time": {"delay_s": (0.03, 0.07, 0.13, 0.22, 0.35, 0.55)},
    "dead_band": {"half_width_mps2": (0.03, 0.07, 0.13, 0.22, 0.35)},
    "backlash": {"half_width_mps2": (0.03, 0.07, 0.13, 0.22, 0.35)},
    "saturation": {
        "accel_max_mps2": (0.5, 0.75, 1.0, 1.25, 1.6, 2.1, 5.0),
        "accel_min_mps2": (-0.8, -1.2, -1.6, -2.1, -2.8, -8.0),
    },
    "brake_throttle_asymmetry": {"brake_gain_ratio": (0.6, 0.95, 1.2), "brake_lag_ratio": (1.0, 2.5)},
    "second_order_actuator": {"inverse_frequency_s": (0.05, 0.15, 0.4)},
    "rate_limit": {"jerk_max_mps3": (0.4, 0.7, 1.1, 1.8, 3.0, 5.0)},
    "speed_dependent_lag": {"lag_slope": (-0.4, 0.4)},
    "speed_dependent_gain": {"gain_slope": (-0.15, 0.15)},
    "gain_change": {"ramp_s": (0.3, 3.0, 30.0)},
    "gear_shift": {
        "depth": (0.5,),
        "duration_s": (0.25,),
        "first_mps": tuple(np.arange(3.2, 6.9, 0.2)),
        "gear_ratio": tuple(np.arange(1.35, 1.77, 0.035)),
    },
    "driveline_oscillation": {
        "frequency_hz": tuple(np.geomspace(0.9, 5.5, 14)),
        "amplitude": (0.1,),
        "quadrature": (0.05,),
    },
    "aerodynamic_drag": {"drag_per_m": (5e-5, 4e-4)},
    "constant_resistance": {"resistance_mps2": (0.02, 0.15)},
    "low_speed_creep": {"creep_mps2": (0.05, 0.3)},
    "sensor_lag": {"lag_s": (0.03, 0.1, 0.2, 0.4)},
    "sensor_bias": {"bias_mps2": (0.02, -0.02)},
    "sensor_scale": {"scale": (0.95, 1.05)},
}  # fmt: skip
"""Values by effect and parameter; all combinations are tried. A change of gain starts at shares of the drive."""

_CHANGES = 12
_MOMENTS = 60
_TRADES = tuple(s * k for k in (0.012, 0.025, 0.04, 0.06, 0.085, 0.12) for s in (-1, 1))
"""Of a dead time for lag [s]."""
_LEAST_S = 0.01
_MANY = 100


def effect_starts(hypothesis: Hypothesis, name: str) -> list[dict[str, float]]:
    """Starts of one effect, by key in the plant."""
    if name == "gain_change":
        first, last = float(hypothesis.record.drives[0].time[0]), float(hypothesis.record.drives[0].time[-1])
        times = first + (last - first) * (np.arange(_CHANGES) + 0.5) / _CHANGES
        grid: Mapping[str, tuple[float, ...]] = {
            "gain_ratio": (0.85, 1.15),
            "change_s": tuple(times.tolist()),
            "ramp_s": (1.0, 0.12 * (last - first)),
        }
    else:
        grid = GRIDS.get(name, {})
    if not grid:  # an effect of the user's: typical, and fainter
        sized = [c for c in hypothesis.coordinates if c.key.startswith(f"{name}.")]
        return [
            {c.key: float(c.value(np.array(at))) for c in sized if c.parameter.neutral is not None}
            for at in (-1.0, 0.0)
        ]
    keys = [f"{name}.{key}" for key in grid]
    return [dict(zip(keys, values, strict=True)) for values in product(*grid.values())]


def _moments(hypothesis: Hypothesis) -> Sequence[float]:
    """When a gain may change [s]: in a quiet drive only a few moments tell, so many are tried."""
    time = hypothesis.record.drives[0].time
    return torch.linspace(float(time[0]), float(time[-1]), _MOMENTS + 2)[1:-1].tolist()


def one_at_a_time(hypothesis: Hypothesis, z: Float) -> Float:
    """Places (start, coordinate) that differ from `z` in one parameter of an effect, put to one of its starts.

    A limit that is never reached has no slope to follow, and a hill may be climbed from its wrong side.
    """
    places = []
    for i, c in enumerate(hypothesis.coordinates):
        effect, _, key = c.key.partition(".")
        grid = GRIDS.get(effect, {})
        if prod(map(len, grid.values())) > _MANY:  # already tried closely
            continue
        values = _moments(hypothesis) if c.key == "gain_change.change_s" else grid.get(key, ())
        for value in values:
            place = z.copy()
            place[i] = c.z_of(value)
            places.append(place)
    return np.array(places).reshape(-1, len(z))


def lag_delay_starts(hypothesis: Hypothesis, z: Float) -> Float:
    """Places (start, coordinate) with more of a dead time and less lag than at `z`, or the other way round.

    Along this valley the likelihood is rough: a held command that arrives between two rows makes a kink at every row.
    """
    keys = [c.key for c in hypothesis.coordinates]
    if "dead_time.delay_s" not in keys:
        return np.zeros((0, len(z)))
    own = {key: float(x[0]) for key, x in hypothesis.values(z[None]).items()}
    lag, delay = own["T_L"], own["dead_time.delay_s"]
    shifts = [s for s in _TRADES if min(lag - s, delay + s) > _LEAST_S]
    places = [hypothesis.z_of({**own, "T_L": lag - s, "dead_time.delay_s": delay + s}) for s in shifts]
    return np.array(places).reshape(-1, len(z))


def starts(hypothesis: Hypothesis, base: Mapping[str, float]) -> Float:
    """(start, coordinate): `base` (T_L, K_L and what is known of some effects) with every effect's own starts."""
    sets: list[dict[str, float]] = [dict(base)]
    for effect in hypothesis.effects:
        known = any(key.startswith(f"{effect.name}.") for key in base)
        if known or effect.random or effect.name == "road_grade":
            continue
        sets = [{**a, **b} for a in sets for b in effect_starts(hypothesis, effect.name)]
    return np.stack([hypothesis.z_of(s) for s in _unique(sets)])


def _unique(sets: list[dict[str, float]]) -> Iterator[dict[str, float]]:
    seen = set()
    for s in sets:
        mark = tuple(sorted(s.items()))
        if mark not in seen:
            seen.add(mark)
            yield s
