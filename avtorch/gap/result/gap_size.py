"""Size of the gap: errors of the fitted baseline in one step and over seconds, and those of the best hypothesis.

Where commands were given twice, preceded by equal commands for some seconds, the actuator starts from the same state.
Half the mean square difference of the responses is then noise, plus whatever does not depend on the commands (another
speed, a road grade, an onset between the two): a floor that involves no fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from avtorch.arrays import FloatArray
from avtorch.gap.quantity import Quantity, of_fields, plain, resampled
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.held_out import HeldOut

WINDOW_S = 10.0
SETTLED_S = 3.0
"""Time from a window's start after which the actuator has forgotten its earlier state [s]."""
_ALIKE = 0.02  # tolerance, relative to the spread of the commands
_LIVELY_MPS2 = 0.2
_NO_GAP = 0.1  # share of the error before that is within the floor: nothing to close
_DENSITY = "log_predictive_density"


class Simulated(NamedTuple):
    """A simulator's `errors` (channel, row, group), measured less simulated, and its `lag` [s]."""

    errors: FloatArray
    lag: float


@dataclass(frozen=True)
class Repeatability:
    """Noise floor from `pairs` pairs of windows: `seconds` [s] compared, root mean squares `floor_accel` [m/s²]
    and `floor_speed` [m/s].

    The speed's is of its change since the settling time. None where the log lacks the channel.
    """

    pairs: int
    seconds: float
    floor_accel: float | None
    floor_speed: float | None


@dataclass(frozen=True)
class GapSize:
    """Errors of the baseline, and those of the best hypothesis as `floor`; None where not measured.

    Rollouts last `horizon_s` [s]; accelerations [m/s²], speed [m/s]. `detected`: there is a gap, with p-value
    `p_value`. `repeats`: the noise floor estimated from repeated commands, None where there are none.
    """

    detected: bool
    p_value: float | None = None
    one_step_rmse: float | None = None
    one_step_floor: float | None = None
    rollout_rmse_accel: float | None = None
    rollout_floor_accel: float | None = None
    rollout_rmse_speed: float | None = None
    horizon_s: float | None = None
    repeats: Repeatability | None = None

    def to_dict(self) -> dict[str, Any]:
        return {
            "one_step": {"rmse": self.one_step_rmse, "floor": self.one_step_floor},
            "rollout": {
                "rmse_accel": self.rollout_rmse_accel,
                "floor_accel": self.rollout_floor_accel,
                "rmse_speed": self.rollout_rmse_speed,
                "horizon_s": self.horizon_s,
            },
            "detected": bool(self.detected),
            "p_value": self.p_value,
            "repeats": plain(self.repeats),
        }


def gap_size(
    rows: CountedRows,
    none: Simulated,
    best: Simulated,
    *,
    detected: bool,
    p_value: float | None = None,
) -> GapSize:
    """Root mean square errors of `none`, the fitted baseline, with those of `best` as floors where smaller.

    (An effect may improve the speed at the cost of the acceleration, and a wrong one often does.) The measures of free
    runs are those of `shrinkage`, here over all counted rows. None where the log lacks the channel.
    """
    one = [] if "accel" not in rows.channels else [_one_step(rows, x.errors[0], x.lag) for x in (none, best)]
    before, after = (rows.rms(x.errors) for x in (none, best))
    return GapSize(
        detected=detected,
        p_value=p_value,
        one_step_rmse=one[0] if one else None,
        one_step_floor=min(one, default=None),
        rollout_rmse_accel=before.get("accel"),
        rollout_floor_accel=min(before["accel"], after["accel"]) if "accel" in before else None,
        rollout_rmse_speed=before.get("speed"),
        horizon_s=rows.longest_s,
        repeats=repeatability(rows),
    )


def _one_step(record: CountedRows, errors: FloatArray, lag: float) -> float:
    """RMS error of the acceleration predicted for a row from the measurement one row earlier.

    A rollout error decays with the lag, so the one-step error is `e[k+1] - exp(-dt / T_L) e[k]`: for GLVD exactly the
    error of its zero-order hold from the measured acceleration.
    """
    keep = float(np.exp(-record.dt / record.group / lag))
    steps = [x[1:] - keep * x[:-1] for x in (errors[part].ravel() for part in record.stretches)]
    return float(np.sqrt((np.concatenate(steps) ** 2).mean()))


def repeatability(record: CountedRows) -> Repeatability | None:
    """The repeatability from windows with repeated commands; None where there are none."""
    rows, settled = round(WINDOW_S / record.dt), round(SETTLED_S / record.dt)
    found = _pairs(record.command, record.stretch, rows)
    if not found:
        return None
    floors: dict[str, float] = {}
    for name, measured in zip(record.channels, record.measured, strict=True):
        each = []
        for first, second in found:
            one, other = (measured[k + settled : k + rows].ravel() for k in (first, second))
            if name == "speed":
                one, other = one - one[0], other - other[0]
            each.append(one - other)
        floors[name] = float(np.sqrt(0.5 * np.mean(np.concatenate(each) ** 2)))
    seconds = len(found) * (rows - settled) * record.dt
    return Repeatability(len(found), seconds, floors.get("accel"), floors.get("speed"))


def _pairs(command: FloatArray, stretch: NDArray[np.intp], rows: int) -> list[tuple[int, int]]:
    """Starts of pairs of windows of `rows` rows with the same commands; no row is in two windows."""
    last = len(command) - rows
    if last < rows:
        return []
    whole = stretch[: last + 1] == stretch[rows - 1 :]
    sums = np.concatenate([[0.0], np.cumsum(command**2)])
    squares = sums[rows:] - sums[:-rows]
    free = np.ones(len(command), bool)
    found = []
    for first in range(0, last + 1, max(rows // 2, 1)):
        own = command[first : first + rows]
        if not whole[first] or not free[first : first + rows].all() or own.std() < _LIVELY_MPS2:
            continue
        away = (squares + squares[first] - 2 * fftconvolve(command, own[::-1], "valid")) / rows
        away[: first + rows] = np.inf
        away[~whole] = np.inf
        second = int(away.argmin())
        if away[second] <= (_ALIKE * own.std()) ** 2 and free[second : second + rows].all():
            free[first : first + rows] = free[second : second + rows] = False
            found.append((first, second))
    return found


# on held-out blocks ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class MetricShrinkage:
    """Errors by one measure: `before` the effect is added, `after`, and the `floor` that no model can go below.

    `closed`: (before - after) / (before - floor), None where there is almost nothing to close. Rollout errors are root
    mean squares [m/s², m/s]; densities are mean log densities per row [nats], of which higher is better.

    `horizon_s`: length of the rollouts [s], None for those of whole drives and for densities.
    """

    before: float
    after: float
    floor: float
    closed: Quantity | None
    horizon_s: float | None = None


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on held-out blocks of the drives.

    `metric`: the one of `by_metric` in which the gap is clearest. `ceiling`: error after a flexible black box is added
    to the bare baseline, by metric. `blocks`: number of held-out blocks. `by_drives`: whole drives were held out.
    """

    metric: str
    by_metric: Mapping[str, MetricShrinkage]
    ceiling: Mapping[str, float]
    blocks: int
    by_drives: bool = False

    @property
    def top(self) -> MetricShrinkage:
        return self.by_metric[self.metric]

    def to_dict(self) -> dict[str, Any]:
        """The object `shrinkage` of `diagnosis.json`."""
        out = of_fields(self) | of_fields(self.top)
        out |= {"heldout": True, "heldout_by": "drives" if out.pop("by_drives") else "blocks"}
        return out | {"placebo": {"effect": None, "closed": None}, "chosen": None}


def shrinkage_of(held: HeldOut, seed: int = 0) -> Shrinkage:
    """How far the gap shrinks on held-out blocks with all causes, by measure."""
    four = (held.steps[0], held.steps[-1], held.floor, held.ceiling)
    sizes, framed = held.blocks.sizes, np.flatnonzero(held.frame_rows)  # a block between two frames has no density
    out: dict[str, MetricShrinkage] = {}
    ceiling: dict[str, float] = {}
    for c, channel in enumerate(held.data.channels):
        name = f"rollout_rmse_{channel}"
        levels = np.sqrt(resampled(np.stack([x.squares[c] for x in four]), seed) / resampled(sizes, seed))
        out[name], ceiling[name] = _metric(levels, held.horizon_s, _NO_GAP), float(levels[3, 0])
    # the measure in which the gap shows most
    top = max(out, key=lambda k: out[k].before / max(out[k].floor, 1e-12))
    if all(x.closed is None for x in out.values()):
        top = _DENSITY
    nats = np.stack([x.nats[framed] for x in four])
    levels = resampled(nats, seed) / resampled(held.frame_rows[framed], seed)
    out[_DENSITY], ceiling[_DENSITY] = _metric(levels, None, 1e-3, better=np.maximum), float(levels[3, 0])
    return Shrinkage(top, out, ceiling, len(held.blocks.rows), held.blocks.by_drives)


def _metric(
    levels: FloatArray, horizon: float | None, nothing: float, better: Callable[..., Any] = np.minimum
) -> MetricShrinkage:
    """Of `levels` (before, after, floor and ceiling; draw) under resampled blocks; `nothing`: of a gap, relative to an
    error, or of a density [nats]."""
    before, after = levels[:2]
    bottom = better(levels[2], after)
    gap, closed = before - bottom, None
    if abs(gap[0]) >= nothing * (before[0] if better is np.minimum else 1.0):
        shares = (before - after) / np.where(gap == 0, np.inf, gap)
        closed = Quantity.of_resampled(shares[0], shares)
    return MetricShrinkage(float(before[0]), float(after[0]), float(bottom[0]), closed, horizon)
