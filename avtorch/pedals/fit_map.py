r"""The map of a drive's pedals: the force table of the diagnosis, with the lag and the dead time that follow it.

    dv/dt = lag_T[K u(t - tau) + F(u(t - tau), v)] + R(v)

u is what one constant each makes of the pedals, or the speed that a commanded one misses. F, R, their priors and the
free runs that they are fitted to are those of `avtorch.gap.result.free_form`; here no named car stands beside them, and
the dead time is fitted with them.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.engine.priors import FAINT_MAP
from avtorch.gap.result.counted_rows import HORIZON_S
from avtorch.gap.result.free_form import (
    GAIN_SD,
    SIZES,
    Car,
    Fit,
    LeftOut,
    Prior,
    Products,
    Sizes,
    best_form,
    beyond,
    fitted,
    knots_of,
    squares_of,
)
from avtorch.gap.result.output_error import Coefficients, Rows
from avtorch.io import LogSource
from avtorch.pedals.pedal_drive import PedalDrive
from avtorch.pedals.pedal_map import RATE, SIGN, PedalMap, PedalTable

FACTOR = Sizes(0.0, 0.0)
"""Of the model with one constant a pedal."""
SLOPE_SD = 0.3
"""Standard deviation of a gain's change over one of the speed [-]: motors and gears give less where they turn fast."""
LONGEST_S = 3.0
"""Of the runs that teach [s]: wind and road add up over longer ones."""
INDEPENDENT_S = 1.0
"""Taught seconds that count as one independent error of these [s]."""
LOOP_BEFORE_S = 10.0
"""How much earlier than what counts the run of a closed loop begins [s]: from a speed that wind has moved it would
seem to be led back too slowly."""
_KNOTS = 9  # of commands, beside those of the table
_LOOP_KNOTS = 10
_NEAR_ZERO = 0.12  # standard deviations of the error, within which there is one knot
_KEPT_ROUNDS = 3  # in which it is seen how long what a loop misses lasts
_SETTLED_S = 0.1  # of a stretch, before a run begins: a launch is all that a drive has of full pedals
_SIZES = tuple(size for size in SIZES if size > FAINT_MAP)  # any pedal has a map, any car a resistance
_FIRST = Sizes(0.3, 0.3)
_LAG = (float(np.log(0.3)), 1.0)  # mean and standard deviation of ln T_L
_DEAD_TIMES_S = (0.0, 0.1, 0.2, 0.35, 0.5, 0.8)
_DEAD_TIME_STEP_S = 0.02  # for its slope, and to which it is found


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Mean squared errors of speed `squares` (block,) [m²/s²] by model: `map`, and `factor`, one constant a pedal.
    `horizon_s`: the longest of the free runs [s], begun every second of a block.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import HeldOut
        >>> better = HeldOut({"map": np.array([0.1, 0.2, 0.1]), "factor": np.array([1.0, 1.3, 1.1])}, 10.0)
        >>> round(better.rmse("factor"), 2), better.better_than("factor")
        (1.06, True)
    """

    squares: Mapping[str, FloatArray]
    horizon_s: float

    def rmse(self, model: str) -> float:
        """Root of the mean squared error of speed [m/s]."""
        return float(np.sqrt(self.squares[model].mean()))

    def better_than(self, over: str) -> bool:
        """Whether the map's squared error is below that of `over`, block by block, by two standard errors or more."""
        less = self.squares[over] - self.squares["map"]
        return float(less.mean()) > 2 * float(less.std(ddof=1) / np.sqrt(len(less)))


@dataclass(frozen=True, eq=False)
class PedalFit:
    """A fitted map with what is known of its errors.

    Standard errors [s] of the lag of `map`, of its dead time and of their sum, which is known far better than its
    parts. `held_out`: how well it foretells blocks left out.
    """

    map: PedalMap
    T_L_sd: float
    dead_time_sd: float
    late_sd: float
    held_out: HeldOut


def fit_pedals(logs: LogSource | Sequence[LogSource]) -> PedalFit:
    """The map of the pedals of a drive, or of several drives of one car.

    Logs without pedals are fitted by their `speed_cmd`. Raises `InputError` for logs without speed or without a pedal
    or a `speed_cmd` that moves, and for less than three blocks of four seconds that count.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> from avtorch.pedals import fit_pedals
        >>> time = np.arange(0.0, 120.0, 0.05)
        >>> throttle = 0.25 + 0.15 * np.sin(0.4 * time) + 0.1 * np.sin(1.1 * time)
        >>> speed = np.empty(len(time))
        >>> v, a = 10.0, 0.0
        >>> for i, pedal in enumerate(throttle):  # 4 m/s² at full throttle, a lag of 0.4 s, and drag
        ...     speed[i] = v
        ...     v, a = v + 0.05 * a, a + 0.05 / 0.4 * (4.0 * pedal - 0.1 * v - a)
        >>> found = fit_pedals(Log.from_arrays(time=time, throttle=throttle, speed=speed))
        >>> made = found.map
        >>> round(float(made.accel(np.array([8.0]), throttle=np.array([0.3]))[0]), 1), round(made.T_L, 1)
        (0.4, 0.4)
    """
    drive = PedalDrive.of(logs)
    kept, independent = _whitening(drive)
    _, factor = _with_dead_time(drive, FACTOR, independent, kept)
    runs, edges = factor.car.runs_in_blocks, factor.car.edges
    left = LeftOut.of(runs, edges) if len(runs.of_run) else None
    if left is None:
        raise InputError(f"logs: found {len(edges) - 1} blocks of some seconds that count, needs 3 for a map")
    over = squares_of(Fit(factor.car, factor.x, cut=True), Prior(factor.car, FACTOR), left, independent)
    dead_time, first = _with_dead_time(drive, _FIRST, independent, kept)
    _, sizes, fit = best_form(first.car, left, over, independent, _SIZES)
    made = _map_of(drive, fit, dead_time)
    rough = Sizes(max(sizes.resistance, _FIRST.resistance), max(sizes.table, _FIRST.table))  # smoothing is no knowledge
    changes = _changes(drive, fit, Prior(fit.car, rough), dead_time, independent)
    score = _scored({"map": (fit, sizes), "factor": (factor, FACTOR)}, left, independent)
    lag, late = made.T_L * changes[:, -2], changes[:, -1]
    T_L_sd, dead_time_sd, late_sd = (float(np.sqrt((x**2).sum())) for x in (lag, late, lag + late))
    made = _with_errors(made, drive, fit, changes[:, :-1])
    return PedalFit(made, T_L_sd, dead_time_sd, late_sd, score)


def _map_of(drive: PedalDrive, fit: Fit, dead_time: float) -> PedalMap:
    """The gain, the table over commands and the resistance, by pedals; of a commanded speed by its error and slope.

    More of a pedal never slows the car: where the force turns back, the map is halfway between the least monotone one
    above it and the greatest below.
    """
    rows, at = fit.car.rows, fit.at
    spans = {name: (float(x.min()), float(x.max())) for name, x in drive.pedals.items()}
    names = [name for name in spans if name != RATE]
    ends = [SIGN[name] * drive.factors[name] * x for name in names for x in spans[name]]
    between = ends if drive.is_loop else np.linspace(min(ends), max(ends), _KNOTS)
    u = np.unique(np.concatenate([rows.knots_u, between, [0.0]]))
    force = np.stack([np.interp(u, rows.knots_u, x) for x in at.table.T], 1) + at.curve
    if not drive.is_loop:
        force += (1.0 + at.gain) * u[:, None]
    force = 0.5 * (np.maximum.accumulate(force, 0) + np.minimum.accumulate(force[::-1], 0)[::-1])
    zero = int(np.searchsorted(u, 0.0))
    pedals = {}
    for name in names:
        order = np.argsort(SIGN[name] * u)
        low, high = spans[name]
        pedal = SIGN[name] * u[order] / drive.factors[name]
        kept = (pedal >= min(low, 0.0) - 1e-9) & (pedal <= high + 1e-9)
        pedals[name] = PedalTable(pedal[kept], force[order[kept]] - force[zero])
    if RATE in spans:
        knots = np.unique([min(spans[RATE][0], 0.0), 0.0, max(spans[RATE][1], 0.0)])
        pedals[RATE] = PedalTable(knots, np.outer(max(at.gain, 0.0) * knots, np.ones(len(rows.knots_v))))
    driven = (float(drive.speed.min()), float(drive.speed.max()))
    return PedalMap(rows.knots_v, force[zero], pedals, fit.T_L, dead_time, driven=driven)


def _with_errors(made: PedalMap, drive: PedalDrive, fit: Fit, changes: FloatArray) -> PedalMap:
    """The map with standard errors, of which `changes` (draw, coefficient) square to variances."""
    rows = fit.car.rows
    each = [Coefficients.of(x[:-1], rows.shape) for x in changes]
    gains, tables = np.array([x.gain for x in each]), np.stack([x.table for x in each])

    def change(u: FloatArray) -> FloatArray:  # (draw, command, speed)
        found = np.apply_along_axis(lambda column: np.interp(u, rows.knots_u, column), 1, tables)
        return found if drive.is_loop else found + gains[:, None, None] * u[:, None]

    zero, pedals = change(np.zeros(1)), {}
    for name, table in made.pedals.items():
        u = SIGN[name] * drive.factors[name] * table.pedal
        off = change(u) - zero if name != RATE else gains[:, None, None] * np.outer(u, np.ones(len(made.speed)))
        pedals[name] = replace(table, sd=np.sqrt((off**2).sum(0)))
    coasting = np.stack([x.curve for x in each]) + zero[:, 0]
    return replace(made, pedals=pedals, coasting_sd=np.sqrt((coasting**2).sum(0)))


def car_of(
    drive: PedalDrive, dead_time: float, knots: tuple[FloatArray, FloatArray], slope: float, kept: float = 0.0
) -> Car:
    """The car of one constant a pedal, with the commands of a drive as they arrive; `slope`, `kept`: as of `Car`."""
    u, feed = drive.late(drive.command, dead_time), drive.feed
    closed = dead_time if drive.is_loop else None
    late = None if feed is None else drive.late(feed, dead_time)
    rows = Rows(drive.dt, u, drive.speed, np.arange(len(u)), drive.starts, *knots, closed, late)

    def named(log_lag: float) -> FloatArray:
        lag, out = float(np.exp(log_lag)), np.zeros(len(u))
        if drive.is_loop:
            return out
        keep, ends = np.exp(-drive.dt / lag), np.append(np.flatnonzero(drive.starts), len(u))
        for i, j in itertools.pairwise(ends):
            after = lfilter([1 - keep], [1, -keep], u[i:j], zi=[keep * u[i]])[0]
            out[i:j] = u[i:j] - lag / drive.dt * np.diff(np.append(u[i], after))
        return out

    car = Car(rows, named, _LAG, slope=slope, longest_s=LONGEST_S, settled_s=_SETTLED_S)
    return replace(car, steep=GAIN_SD, before_s=LOOP_BEFORE_S, kept=kept) if drive.is_loop else car


def _knots(drive: PedalDrive) -> tuple[FloatArray, FloatArray]:
    """Those of the free form, of pedals also at speeds beyond what was driven. A loop's limits lie where few rows are,
    so its errors' knots are even in their root."""
    u, v = knots_of(drive.command, drive.speed)
    if not drive.is_loop:
        v = beyond(v, drive.speed)
    else:
        low, high = np.sqrt(np.maximum([-u[0], u[-1]], 0.0))
        root = np.linspace(-low, high, _LOOP_KNOTS)
        u = np.sort(np.append((np.sign(root) * root**2)[root**2 > _NEAR_ZERO * drive.command.std()], 0.0))
    return u, v


def _whitening(drive: PedalDrive) -> tuple[float, float]:
    """The share of a loop's error that is left in the next one, and how many independent errors the drive has.

    Wind and road last for seconds, and a loop is told by what is new: the rest follows from its slow answer to either.
    A pedal's runs count as they are.
    """
    if not drive.is_loop:
        return 0.0, max(drive.seconds / INDEPENDENT_S, 3.0)
    kept, knots, fit = 0.0, _knots(drive), None
    for _ in range(_KEPT_ROUNDS):
        car = car_of(drive, _DEAD_TIMES_S[1], knots, SLOPE_SD, kept)
        fit = fitted(car, _FIRST, car.zero if fit is None else fit.x, len(car.runs.of_run))
        left, of_run = Fit(replace(car, kept=0.0), fit.x).errors, fit.runs.of_run
        now, then = (left[k][of_run[1:] == of_run[:-1]] for k in (slice(1, None), slice(-1)))
        kept = float(np.clip((now * then).sum() / max(float((then**2).sum()), 1e-12), 0.0, 0.99))
    return kept, float(len(of_run))


def _with_dead_time(drive: PedalDrive, sizes: Sizes, independent: float, kept: float) -> tuple[float, Fit]:
    """The dead time [s] and the fit at given sizes."""
    knots = _knots(drive)
    known: dict[float, tuple[float, Fit]] = {}

    def cost(dead_time: float) -> float:
        car = car_of(drive, dead_time, knots, 0.0 if sizes == FACTOR else SLOPE_SD, kept)
        near = min(known, key=lambda other: abs(other - dead_time), default=None)
        fit = fitted(car, sizes, car.zero if near is None else known[near][1].x, independent)
        known[dead_time] = independent * np.log(fit.mse) + Prior(car, sizes).of(fit.x), fit
        return known[dead_time][0]

    k = int(np.argmin([cost(dead_time) for dead_time in _DEAD_TIMES_S]))
    bounds = _DEAD_TIMES_S[max(k - 1, 0)], _DEAD_TIMES_S[min(k + 1, len(_DEAD_TIMES_S) - 1)]
    minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": _DEAD_TIME_STEP_S})
    best = min(known, key=lambda dead_time: known[dead_time][0])
    return best, known[best][1]


def _changes(drive: PedalDrive, fit: Fit, prior: Prior, dead_time: float, independent: float) -> FloatArray:
    """Changes (draw, coefficient) whose squares sum to variances, the dead time's last."""
    rows = fit.car.rows
    aside = car_of(drive, dead_time + _DEAD_TIME_STEP_S, (rows.knots_u, rows.knots_v), fit.car.slope, fit.car.kept)
    by_dead_time = (Fit(aside, fit.x).errors - fit.errors) / _DEAD_TIME_STEP_S
    J = np.column_stack([fit.slopes[:, prior.moves], by_dead_time])
    H = independent / max(float((fit.errors**2).sum()), 1e-12) * J.T @ J
    H[:-1, :-1] += prior.precision
    H[-1, -1] += 1.0  # 1/s²: a dead time of a second is rare
    root = np.linalg.inv(np.linalg.cholesky(H))
    out = np.zeros((len(root), len(prior.moves) + 1))
    out[:, np.append(prior.moves, True)] = root
    return out


def _scored(of: Mapping[str, tuple[Fit, Sizes]], left: LeftOut, independent: float) -> HeldOut:
    """The score of fits whose blocks are left out in turn: a fifth to a tenth of them, every so-many-th one.

    Lag, dead time and the sizes of the free form are those of the whole drive; forces are fitted without the block.
    """
    out, horizon = {}, 0.0
    for model, (fit, sizes) in of.items():
        taught = Fit(fit.car, fit.x, cut=True)
        steps = Products(taught, left).steps(Prior(fit.car, sizes), independent)
        car = replace(fit.car, longest_s=HORIZON_S, before_s=None, kept=0.0)
        runs = car.runs_in_blocks
        block, own = (np.searchsorted(car.edges, first, side="right") for first in (runs.first, taught.runs.counts))
        squares = np.full(len(block), np.nan)
        for is_told, step in zip(left.told[left.way == 0], steps[left.way == 0], strict=True):
            told = np.isin(block, own[is_told])
            mean = np.bincount(runs.of_run, Fit(car, fit.x + step, cut=True).errors ** 2, len(told))
            squares[told] = mean[told] / np.bincount(runs.of_run, minlength=len(told))[told]
        runs_told = np.isfinite(squares)
        block, squares = block[runs_told], squares[runs_told]
        out[model] = np.array([squares[block == k].mean() for k in np.unique(block)])
        horizon = float((runs.end - runs.first).max()) * car.rows.dt
    return HeldOut(out, horizon)
