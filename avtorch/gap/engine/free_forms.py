r"""What no named effect explains: free forms of a family, linear in their coefficients, beside a set of named effects.

    R = J delta + sum_j beta_j z_j + n,     beta ~ N(0, sd^2),     delta ~ the engine's priors,

R is the residual of a hypothesis in lapped coefficients, J its Jacobian, so that every named parameter may move again,
and z_j the response of all channels to a demand of a form: other lags (dynamics), other lags by sign, curves over
command and speed (force map), a gain or a delay that wanders as an Ornstein-Uhlenbeck process over the frames, other
lags of one reading (sensor). The noise's covariance stays free in every band, as in `likelihood`; coefficients are
integrated out by Laplace's approximation. A form's gain is the lesser of that below `claim_hz` and that of all bands,
as everywhere: a closed loop's echoes cancel over the whole band only (Ljung 1999, section 13.4).

The mirrored banks, whose lags run backwards in time, are negative controls for dynamics: no car answers before the
command, but a loop that answers the noise of sensors does, as a recorder shows it (negative
controls: Lipsitch, Tchetgen Tchetgen and Cohen 2010).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.force_map import MAP_SIZES, MapForm, map_forms, size_log_prior
from avtorch.gap.engine.gauss_newton import linear_priors, slopes_of
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import claimed, freedom, least_noise, log_likelihood, log_sum, whiten
from avtorch.gap.engine.priors import ONSET_ODDS

COEFFICIENT_SD = 0.35
"""Prior sd of a form's coefficient [of the demand]: a third of what the command asks for."""
LAG_RATIOS = (0.3, 1.0, 3.0, 10.0)
"""Lags of a linear bank over the car's own [-]: half a decade apart, and twice that at the slow end."""
SHORTEST_LAG_S = 0.03
"""Shortest lag of a bank [s]; what is faster belongs to the recorder."""
WANDER_SD = {"gain": 0.2, "braking": 0.2, "delay": 0.12}
"""Typical sd of a wandering gain [-] and of a wandering delay [s]."""
WANDER_RATIOS = (0.3, 1.0, 2.0)
"""Sizes over the typical one [-] that are tried: weaker ones are not seen, larger ones are no wandering any more."""
WANDER_S = (12.0, 30.0, 80.0)
"""Correlation times [s] of what wanders: longer than a frame, shorter than a drive."""
ONSET_SHARES = (0.2, 0.35, 0.5, 0.65, 0.8)
"""Shares of a drive's frames from which on a form may act: a sixth of a drive off costs a third of its evidence."""
_DELAY_STEP_S = 0.02  # of the finite difference in a delay: about the typical wandering
_DELAY_GRID_S = 0.05  # between delays that are simulated; responses between them are interpolated
_ROUNDS = 4  # of coefficients given the noise, noise given coefficients; the best is the answer
_COURSES = 3  # of what wanders, each under the noise that the last one left
_OF_LAGS = ("linear", "sided")  # forms in whose fit the car's own lag moves far


@dataclass(frozen=True, eq=False)
class FreeForm:
    """A linear family: `columns` (column, channel, frame, bin) are the responses to its demands of coefficient one.

    The family of a `name` is in `family.FORMS`. `sizes`: prior standard deviations of a coefficient, each with its log
    prior probability; several where there are more coefficients than any drive tells.
    """

    name: str
    columns: FloatArray = field(repr=False)
    sizes: tuple[tuple[float, float], ...] = ((COEFFICIENT_SD, 0.0),)


class FreeFormFit(NamedTuple):
    """Evidence of a free form beside a hypothesis.

    `nats` over the hypothesis without it; `residual` (channel, frame, bin) that is left, None where nothing can be
    told; `coefficients` (column,) of the form, or the course (frame,) of what wanders; `size`: likeliest of the form.
    """

    nats: float
    residual: FloatArray | None
    coefficients: FloatArray
    size: float = COEFFICIENT_SD


def linear_forms(h: Hypothesis) -> dict[str, FreeForm]:
    """The free forms of dynamics ("linear", "sided") and of the force ("map", where the speed is known and the base has
    no map of its own)."""
    u = h["K_L"] * h.command()
    short, own, long, longest = _bank(h)
    up = np.maximum(u, 0.0)
    lags = np.array([short, long, longest])
    # a gain by sign is a force map: at rest, lags by sign change nothing
    *others, car = demand_response(h, np.array([up] * 4), np.append(lags, own))
    forms = {
        "linear": FreeForm("linear", demand_response(h, np.array([u] * 3), lags)),
        "sided": FreeForm("sided", np.array(others) - car),
    }
    if h.force is None and (maps := map_forms(h.data)):
        forms["map"] = map_free_form(h, maps[-1])
    return forms


def sensor_form(h: Hypothesis) -> FreeForm:
    """Linear dynamics of each reading alone: a sensor that lags, leads, or rings."""
    short, _, long, longest = _bank(h)
    return FreeForm("sensor", _each_reading(_command_bank(h, [short, long, longest])))


def map_free_form(h: Hypothesis, form: MapForm) -> FreeForm:
    """The curves of a force map as a form beside a hypothesis without one."""
    columns = demand_response(h, form.demands, np.full(form.count, h["T_L"]))
    sizes = tuple(zip(MAP_SIZES.tolist(), size_log_prior().tolist(), strict=True))
    return FreeForm("map", columns, sizes)


def mirror_columns(h: Hypothesis, form: str = "linear") -> FreeForm:
    """The bank of a `form` ("linear", "sided", "sensor") run backwards in time: the answer to a command before it was
    given."""
    short, middle, long, longest = _bank(h)
    if form == "sensor":
        return FreeForm("mirror", _each_reading(_command_bank(h, [short, long, longest], backwards=True)))
    return FreeForm("mirror", _command_bank(h, [short, middle, long, longest], form == "sided", backwards=True))


def _command_bank(h: Hypothesis, lags: Sequence[float], driving: bool = False, backwards: bool = False) -> FloatArray:
    """Responses (column, channel, frame, bin) of first-order lags [s] to the command, or to its positive part."""
    u = h["K_L"] * h.command()
    demands = np.tile(np.maximum(u, 0.0) if driving else u, (len(lags), 1))
    return demand_response(h, demands, np.array(lags), backwards=backwards)


def _each_reading(columns: FloatArray) -> FloatArray:
    """The same columns (column, channel, frame, bin) in one channel alone, each in turn."""
    each = np.zeros((columns.shape[1], *columns.shape))
    for channel in range(columns.shape[1]):
        each[channel, :, channel] = columns[:, channel]
    return each.reshape(-1, *columns.shape[1:])


def explained(h: Hypothesis, form: FreeForm) -> FreeFormFit:
    """Evidence of a linear form beside `h`, whose parameters may move again, summed over the form's sizes.

    `h`: with its evidence evaluated (`information`).
    """
    slopes = slopes_of(h)
    precision, pull = linear_priors(h, h.free)
    known = len(slopes)
    products = band_products(h.data, np.concatenate([h.residual[None], slopes, form.columns]))
    without, _ = linear_evidence(h, products[..., : 1 + known, : 1 + known], precision, pull, 2)
    without = max(without, -0.5 * float(np.linalg.slogdet(h.information)[1]))
    count = len(form.columns)
    pull = np.concatenate([pull, np.zeros(count)])
    nats: list[float] = []
    many = len(form.sizes) > 1
    rounds = 2 * _ROUNDS if many else _ROUNDS
    best, size = np.zeros(known + count), form.sizes[0][0]
    for sd, log_prior in form.sizes:
        tight = np.concatenate([precision, np.full(count, sd**-2)])
        value, moves = linear_evidence(h, products, tight, pull, rounds, integrated=many)
        nats.append(value - count * math.log(sd) + log_prior - without)
        if nats[-1] == max(nats):
            best, size = moves, sd
    taken = np.tensordot(best[known:], form.columns, 1)
    over, residual = 0.0, h.residual - taken - np.tensordot(best[:known], slopes, 1)
    if form.name in _OF_LAGS:
        residual, over = _bent(h, best[:known], taken, residual)
    return FreeFormFit(log_sum(nats) - over, residual, best[known:], size)


def explained_or_late(h: Hypothesis, form: FreeForm) -> FreeFormFit:
    """Evidence of a linear form that acts throughout, or from one of `ONSET_SHARES` of the frames on."""
    frames, fits = h.data.frame_count, [explained(h, form)]
    for share in ONSET_SHARES:
        later = np.arange(frames)[:, None] >= share * frames
        fit = explained(h, replace(form, columns=form.columns * later))
        fits.append(fit._replace(nats=fit.nats + math.log(ONSET_ODDS / len(ONSET_SHARES))))
    return max(fits, key=lambda fit: fit.nats)


def _bent(h: Hypothesis, moves: FloatArray, taken: FloatArray, linear: FloatArray) -> tuple[FloatArray, float]:
    """The residual without what a form has `taken`, simulated anew with the unknowns of `h` at their new values, and
    how many nats more the `linear` residual had promised: a large step in a lag is not linear."""
    count = len(h.free)
    left = _moved(h, moves[:count]).residual - taken - np.tensordot(moves[count:], slopes_of(h)[count:], 1)
    return left, max(log_likelihood(h.data, linear)[0] - log_likelihood(h.data, left)[0], 0.0)


def wandering(h: Hypothesis) -> dict[str, FreeFormFit]:
    """A gain or a delay that wanders from frame to frame: the best Ornstein-Uhlenbeck course of a grid over none.

    The course has no mean: what is constant belongs to the car's or the recorder's own gain and delay, with their
    priors. Every grid point is as likely as any other, so the best of them costs the logarithm of their number.
    """
    return {kind: _wandering(h, kind, response) for kind, response in _wandering_responses(h).items()}


def demand_response(h: Hypothesis, demands: FloatArray, lags: FloatArray, *, backwards: bool = False) -> FloatArray:
    """Responses (column, channel, frame, bin) to additional demands (column, row) [m/s^2] behind lags (column,) [s].

    Demands are held between rows. Each passes the hypothesis's dead time and its recorder. `backwards`: the lags run
    backwards in time, and there is no dead time: what would answer a demand before it is given.
    """
    data, grid = h.data, h.data.grid
    seen = h.values.copy()
    if not backwards and "dead_time" not in h.onsets:
        for channel in data.channels:
            seen[INDEX[f"{channel}_delay"]] += h["dead_time"]
    rows = []
    for demand, lag in zip(demands, lags, strict=True):
        held = demand[grid.row]
        if backwards:
            accel, gained = _first_order_backwards(grid.time, grid.starts, held, float(lag))
        else:
            accel, gained = first_order(grid.time, grid.starts, held, float(lag))
        rows += h.recorded(accel, gained, seen)
    return data.transform(rows).reshape(len(demands), *h.predicted.shape)


@njit(cache=True, fastmath=True, error_model="numpy")
def first_order(time: FloatArray, starts: BoolArray, demand: FloatArray, lag: float) -> tuple[FloatArray, FloatArray]:
    """Acceleration (row,) of a lag [s] behind a held `demand` (row,), and its integral (row,), from rest at it.

    Each of `starts` (row,) begins anew: at the demand's own value, and with an integral of 0.
    """
    n = len(time)
    accel, speed = np.empty(n), np.empty(n)
    a, gained, last, keep = 0.0, 0.0, -1.0, 0.0
    for i in range(n):
        if i == 0 or starts[i]:
            a, gained = demand[i], 0.0
        accel[i], speed[i] = a, gained
        if i + 1 < n and not starts[i + 1]:
            step = time[i + 1] - time[i]
            if abs(step - last) > 1e-9:  # rows are even but for their rounding
                keep = math.exp(-step / lag)
                last = step
            after = demand[i] + keep * (a - demand[i])
            gained += step * demand[i] - lag * (after - a)
            a = after
    return accel, speed


def band_products(data: DriveData, x: FloatArray, y: FloatArray | None = None) -> FloatArray:
    """Inner products (band, channel, channel, signal, signal) over frames and bins of x and y (signal, channel, frame,
    bin), of x with itself where there is no y.

    With them, whitened inner products under any noise, and the residual's covariance for any coefficients, cost no
    pass over the coefficients of the drive.
    """
    y = x if y is None else y
    channels, frames = x.shape[1:3]
    out = np.empty((data.band_count, channels, channels, len(x), len(y)))
    for band, (low, high) in enumerate(zip(data.band_edges[:-1], data.band_edges[1:], strict=True)):
        size = (high - low) * frames
        one = x[..., low:high].reshape(len(x) * channels, size)
        other = one if y is x else y[..., low:high].reshape(len(y) * channels, size)
        out[band] = (one @ other.T).reshape(len(x), channels, len(y), channels).transpose(1, 3, 0, 2)
    return out


def gram(noise: FloatArray, products: FloatArray) -> FloatArray:
    """Inner products (signal, signal) in units of the `noise` (band, channel, channel), of `band_products`."""
    return np.asarray(np.tensordot(np.linalg.inv(noise), products, 3))


def linear_evidence(
    h: Hypothesis,
    products: FloatArray,
    precision: FloatArray,
    pull: FloatArray,
    iterations: int,
    *,
    integrated: bool = False,
) -> tuple[float, FloatArray]:
    """Gain [nats] of signals 1, 2, ... of `products` in explaining signal 0, and their coefficients.

    Coefficients have the prior exp(pull' b - b' diag(precision) b / 2), whose own normalisation is left out. The gain
    contains that of the likelihood over `h`, the prior's change, and -1/2 log det of the posterior's precision.
    `integrated`: there are so many that the noise needs what they may be wrong by (`log_likelihood`).
    """
    data, noise = h.data, h.covariance
    before = claimed(data, noise), h.log_likelihood
    best, at = -math.inf, np.zeros(len(precision))
    spread = np.zeros_like(noise) if integrated or h.force_spread is None else h.force_spread
    for _ in range(iterations):
        weighted = gram(noise, products)
        information = weighted[1:, 1:] + np.diag(precision)
        try:
            factor = cho_factor(information)
        except np.linalg.LinAlgError:  # fewer coefficients than signals: what was found so far is all
            break
        moves = cho_solve(factor, weighted[1:, 0] + pull)
        left = np.concatenate([[1.0], -moves])
        noise = (products @ left) @ left / data.band_size[:, None, None]
        if integrated:
            unsure = cho_solve(factor, np.eye(len(precision)))
            spread = np.einsum("bcdkl,kl->bcd", products[..., 1:, 1:], unsure) / data.band_size[:, None, None]
        noise += spread + least_noise(noise)
        gain = min(claimed(data, noise) - before[0], claimed(data, noise, math.inf) - before[1])
        gain += 0.5 * freedom(data, noise, spread) if integrated else 0.0
        gain += float(pull @ moves - 0.5 * precision @ moves**2) - float(np.log(np.diag(factor[0])).sum())
        if gain > best or integrated:  # the noise has to settle first
            best, at = gain, moves
    return best, at


def _moved(h: Hypothesis, moves: FloatArray) -> Hypothesis:
    """The hypothesis with its free parameters moved as far as their limits let them, evaluated."""
    there = h.copy()
    for name, move in zip(h.free, moves.tolist(), strict=True):
        low, high = h.limits(name)
        there[name] = min(max(h[name] + move, low), high)
    return there.evaluate()


def _bank(h: Hypothesis) -> tuple[float, ...]:
    """Lags [s] of a linear bank around the car's own, in the order of `LAG_RATIOS`."""
    return tuple(max(h["T_L"] * ratio, SHORTEST_LAG_S) for ratio in LAG_RATIOS)


def _first_order_backwards(
    time: FloatArray, starts: BoolArray, demand: FloatArray, lag: float
) -> tuple[FloatArray, FloatArray]:
    """`first_order` in time that runs backwards, from the end of each stretch; its integral up to a constant."""
    ends = np.append(starts[1:], True)
    held = np.where(starts, demand, np.append(demand[:1], demand[:-1]))  # before each point, as time is turned around
    accel, gained = first_order(-time[::-1], ends[::-1].copy(), held[::-1].copy(), lag)
    return accel[::-1].copy(), -gained[::-1]


def _wandering_responses(h: Hypothesis) -> dict[str, FloatArray]:
    """Derivative (channel, frame, bin) of the response by the logarithm of its gain, of that of braking alone, and by a
    delay of all channels."""
    signals = h.on_grid()
    late, early = (h.data.transform(h.recorded(*signals, _later(h, s))) for s in (_DELAY_STEP_S, -_DELAY_STEP_S))
    braking = demand_response(h, np.minimum(h["K_L"] * h.command(), 0.0)[None], np.array([h["T_L"]]))[0]
    return {"gain": h.predicted, "braking": braking, "delay": (late - early) / (2.0 * _DELAY_STEP_S)}


def _wandering(h: Hypothesis, kind: str, response: FloatArray) -> FreeFormFit:
    """Evidence of a course times `response` (channel, frame, bin) beside `h`, whose parameters may move again.

    What wanders is noise at first; once it is out, the noise is smaller: both are found in turn. The noise is larger in
    frames that still show more of it where the response is, so that one such frame is no wandering.
    """
    data, slopes = h.data, slopes_of(h)
    frames = data.frame_count
    precision, pull = linear_priors(h, h.free)
    between = np.abs(data.frame_time[:, None] - data.frame_time)
    centre = np.eye(frames) - 1.0 / frames
    sds = [ratio * WANDER_SD[kind] for ratio in WANDER_RATIOS]
    priors = [centre @ (sd**2 * np.exp(-between / s)) @ centre for sd in sds for s in WANDER_S]

    def by_frame(x: FloatArray, noise: FloatArray) -> FloatArray:
        shape = data.channel_count, frames, data.bin_count
        return np.moveaxis(whiten(data, noise, x).reshape(shape), 1, 0).reshape(frames, -1)

    def gain(moves: FloatArray, left: FloatArray) -> tuple[float, FloatArray]:
        total, after = log_likelihood(data, left, h.force_spread)
        over = min(claimed(data, after) - claimed(data, h.covariance), total - h.log_likelihood)
        return over + float(pull @ moves - 0.5 * precision @ moves**2), after

    # at a crease of the likelihood moved parameters alone gain something, which is not to the course's credit
    white = np.array([whiten(data, h.covariance, j) for j in slopes])
    score = white @ whiten(data, h.covariance, h.residual) + pull
    alone = np.asarray(np.linalg.solve(white @ white.T + np.diag(precision), score), np.float64)
    promised = max(gain(alone, h.residual - np.einsum("p,pcfk->cfk", alone, slopes))[0], 0.0)
    noise, left = h.covariance, h.residual
    best, moved = FreeFormFit(-math.inf, None, np.zeros(frames)), alone
    for _ in range(_COURSES):
        w, r, remaining = (by_frame(x, noise) for x in (response, h.residual, left))
        energy = (w * w).sum(1)
        scale = np.sqrt(np.maximum((w * w * remaining**2).sum(1) / np.maximum(energy, 1e-12), 1.0))[:, None]
        w, r = w / scale, r / scale
        jacobian = np.array([by_frame(j, noise) / scale for j in slopes])
        shared = np.einsum("fk,pfk->pf", w, jacobian)
        flat = jacobian.reshape(len(jacobian), -1)
        taken = np.linalg.solve(flat @ flat.T + np.diag(precision), np.c_[shared, flat @ r.ravel() + pull])
        information = np.diag((w * w).sum(1)) - shared.T @ taken[:, :-1]
        score = (w * r).sum(1) - shared.T @ taken[:, -1]
        course, occam = _best_course(score, 0.5 * (information + information.T), priors)
        moves = taken[:, -1] - taken[:, :-1] @ course
        left = h.residual - response * course[:, None] - np.einsum("p,pcfk->cfk", moves, slopes)
        over, after = gain(moves, left)
        over += occam - math.log(len(priors)) - promised
        if over > best.nats:
            best, moved = FreeFormFit(over, left, course), moves
        change = np.log(np.trace(after, axis1=1, axis2=2) / np.trace(noise, axis1=1, axis2=2))
        if np.abs(change).max() < 0.05:  # of a band's variance: no nat in twenty coefficients
            break
        noise = after
    if best.residual is None or best.nats <= 0:
        return best
    taken = response * best.coefficients[:, None] if kind != "delay" else _delayed(h, best.coefficients)
    left, over = _bent(h, moved, taken, best.residual)
    return FreeFormFit(best.nats - over, left, best.coefficients)


def _delayed(h: Hypothesis, delays: FloatArray) -> FloatArray:
    """Change (channel, frame, bin) of the response by a delay (frame,) [s] of all channels in each frame."""
    signals, out = h.on_grid(), np.zeros_like(h.predicted)
    steps = delays / _DELAY_GRID_S
    below = np.floor(steps)
    for step in range(int(below.min()), int(below.max()) + 2):
        weight = np.maximum(1.0 - np.abs(steps - step), 0.0)
        if weight.any():
            out += weight[:, None] * h.data.transform(h.recorded(*signals, _later(h, step * _DELAY_GRID_S)))
    return out - h.predicted


def _later(h: Hypothesis, delay: float) -> FloatArray:
    """Values (parameter,) of the hypothesis with all channels recorded later by a delay [s]."""
    values = h.values.copy()
    for channel in h.data.channels:
        values[INDEX[f"{channel}_delay"]] += delay
    return values


def _best_course(score: FloatArray, information: FloatArray, priors: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """The posterior mean (frame,) under the prior covariance of most evidence, and what that prior costs [nats].

    The cost is -m' K^-1 m / 2 - log det(1 + K P) / 2. With m = K (score - P m), it needs no inverse of K, which is
    singular without a mean.
    """
    best, course, cost = -math.inf, np.zeros(len(score)), 0.0
    unit = np.eye(len(score))
    for prior in priors:
        system = unit + prior @ information
        mean = np.asarray(np.linalg.solve(system, prior @ score), float)
        half_log_det = 0.5 * float(np.linalg.slogdet(system)[1])
        evidence = 0.5 * float(score @ mean) - half_log_det
        if evidence > best:
            best = evidence
            course, cost = mean, -0.5 * float(mean @ (score - information @ mean)) - half_log_det
    return course, cost
