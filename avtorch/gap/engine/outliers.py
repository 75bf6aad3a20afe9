r"""Outliers of the accelerometer: readings that leave no trace in what follows, on a sensor whose noise has tails.

The error e of the modelled acceleration is an autoregression with innovations z of unit scale, pi(B) e = z. An additive
outlier of size w in row t adds w pi_k to z_{t+k}: it passes the filter as it is. A shock, which the sensor's or the
car's own dynamics carry on, is innovational and adds to z_t alone (Fox 1972; Chen and Liu 1993). Over all suspects,

    1/2 (sum_k z_{t+k} p_k)^2 - 1/2 max_k z_{t+k}^2,        p = pi / |pi|,

is the log likelihood of the first kind over the second. A filter of the recorder smears an outlier by c^k: pi is then
convolved with it, c on a grid.

Where errors are nearly white both kinds are alike, and the law of the innovations decides: a normal contaminated by a
wider one (Tukey 1960; Box and Tiao 1968) is what outliers make, Student's is what vibration makes. So do the sizes of
what is additive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.ndimage import maximum_filter1d
from scipy.special import gammaln, log_ndtr

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.engine.coordinates import INDEX
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import HALF_LOG_2PI

# suspects
SUSPECT = 4.2
"""Scales from which on a matched filter or an innovation is a suspect [-]: one row in 40,000 of normal noise."""
SUSPECT_NATS = 1.5
"""What each suspect costs [nats]: its own size is fitted, 1/2 log n for n suspects of ten to thirty."""
CLIP = 30.0
"""Innovations count up to this many scales [-]: beyond, an outlier's size says no more."""
LONGEST_S = 0.08
"""What deviates for longer is no outlier of a reading [s]."""
STEP_SHARE, STEP_MPS2 = 0.5, 0.05
"""Steps of the command, over which a model's errors are large: this share of its largest steps (99.8 %), and at least
so much [m/s²]. Where steps are everywhere, they excuse nothing."""
STEP_S = 0.8
"""How long after such a step rows are no suspects [s]: two lags of a slow actuator."""
SMEAR_GRID = (0.0, 0.2, 0.35, 0.5, 0.65, 0.8)
"""Poles of the recorder's filter [a row]."""
SMEAR_S = 0.045
"""The slowest such filter [s], see `priors.RECORDER_FILTER_S`: mean and two standard deviations."""
COLOUR = 1.5
"""Energy of pi [-] from which on both kinds differ at all; 1 for white errors."""

# laws of innovations
MIXTURE_NATS = 14.0
"""What the contaminated normal must gain over Student's [nats]: the best of 252 laws, of all rows and not of bands."""
HEAVY_NATS_PER_ROW = 0.065
"""What it must gain over a normal in each row to count beside Student's [nats]: heavier tails than any vibration's."""
ORDER = 10
"""Order of the autoregression [rows]: resonances of a body and an engine, at 20 to 100 Hz."""
QUANTUM_SCALE = 0.4
"""Least scale of innovations where readings are rounded, over the quantum [-]: sqrt(1/12 + 1/12)."""

RATE_NATS = 4.0
"""What a change of a rate costs [nats]: its time, one of some fifty."""

_REMOVALS = 20  # rounds of outliers that are taken out, each of those that do not overlap
_TAPS = 14  # of the filter pi, smeared: its order and what a filter of the recorder adds
_NORMAL_SCALES = np.linspace(0.8, 2.0, 13)
_STUDENT_SCALES, _STUDENT_DOF = np.arange(7, 13) / 10, np.array([2.5, 3, 4, 6, 9, 15, 30])
_CORE_SCALES, _WIDTHS = np.array([0.85, 0.95, 1.05, 1.2]), np.array([3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 13.0])
_SHARES = np.array([0.001, 0.002, 0.004, 0.008, 0.015, 0.03, 0.05, 0.08, 0.12])


class Outliers(NamedTuple):
    """Outliers of the accelerometer beside a hypothesis.

    `nats` of them over none; `starts` (outlier,): their first rows; `flags` (row,): all rows that they reach; `errors`
    (row,) [m/s²]: reading less response.
    """

    nats: float
    flags: BoolArray
    starts: IntArray
    errors: FloatArray


class Innovations(NamedTuple):
    """A robust autoregression: `z` (innovation,) over the robust `scale` [m/s²], at `rows` (innovation,); `pi` (order
    + 1,): the filter from errors to innovations, pi_0 = 1."""

    z: FloatArray
    rows: IntArray
    pi: FloatArray
    scale: float


def sensor_outliers(h: Hypothesis) -> Outliers:
    """Outliers of the accelerometer in the errors of a hypothesis, in the readings as they were before any replacement.

    Nats are -inf without an accelerometer, or where no stretch is long enough.
    """
    data = h.data
    raw = data.accel if data.raw_accel is None else data.raw_accel
    nothing = np.zeros(len(data.time), bool)
    if raw is None:
        return Outliers(-math.inf, nothing, np.zeros(0, np.int64), np.zeros(len(data.time)))
    # compared on the clock of the readings, not on that of the speed: a shift by parts of a row would smear outliers
    values = h.values.copy()
    values[INDEX["accel_delay"]] -= data.align_s
    errors = raw - h.rows(values)[0]
    found = robust_innovations(errors, data.bounds, data.warm_rows, raw)
    if found is None:
        return Outliers(-math.inf, nothing, np.zeros(0, np.int64), errors)
    single, places = outliers_alone(found.z, found.pi)
    ends = np.diff(found.rows, append=-1) != 1
    suspect = ~(_after_steps(data)[found.rows] | _lasting(single, places, ends, max(3, LONGEST_S / data.dt)))
    mixture, student, normal = tail_log_likelihoods(single[suspect])
    tails = max(mixture - max(student, normal) - MIXTURE_NATS, mixture - normal - HEAVY_NATS_PER_ROW * suspect.sum())
    additive, smear, at, sizes = additive_over_innovational(np.where(suspect, found.z, 0.0), found.pi, data.dt)
    if (found.pi**2).sum() <= COLOUR:
        additive = -math.inf
    additive = min(additive, contaminated_over_student(sizes))
    if tails > additive:
        smear, at = 0.0, np.flatnonzero(suspect & (np.abs(single) > SUSPECT))
    starts, flags = found.rows[at], nothing
    lasts = max(1, math.ceil(math.log(0.12) / math.log(smear))) if smear > 0 else 1
    for k in range(lasts):
        flags[np.minimum(starts + k, len(flags) - 1)] = True
    return Outliers(float(max(tails, additive)), flags, starts, errors)


def without_outliers(data: DriveData, errors: FloatArray, flags: BoolArray) -> FloatArray:
    """The accelerometer's readings (row,) with those flagged, and the row before each, replaced.

    What replaces them is the response and the error between its neighbours, `errors` (row,) [m/s²].
    """
    assert data.accel is not None
    wrong = flags.copy()
    wrong[:-1] |= flags[1:]
    between = np.interp(data.time, data.time[~wrong], errors[~wrong])
    out = data.accel.copy()
    out[wrong] += (between - errors)[wrong]
    return out


def rate_onset(times: FloatArray, first: float, last: float) -> tuple[float, float | None]:
    """Nats of a Poisson process that sets in, or becomes more frequent, over one rate from `first` to `last` [s].

    `times` (event,) [s], rising, of which one is the onset. (0, None) where there is none, or less than eight events.
    """
    n = len(times)
    if n < 8:
        return 0.0, None
    k = np.arange(n - 4)
    before, after = np.maximum(times[k] - first, 1.0), last - times[k]
    late = after >= 5.0
    k, before, after = k[late], before[late], after[late]
    rate0, rate1 = np.maximum(k, 0.5) / before, (n - k) / after
    nats = k * np.log(rate0) + (n - k) * np.log(rate1) - n * math.log(n / (last - first)) - RATE_NATS
    nats = np.where(rate1 < rate0, -np.inf, nats)
    if not len(k) or nats.max() <= 0:
        return 0.0, None
    return float(nats.max()), float(times[k[np.argmax(nats)]])


def robust_innovations(
    errors: FloatArray, bounds: IntArray, warm_rows: int, readings: FloatArray
) -> Innovations | None:
    """Autoregression of `errors` (row,) in the stretches between `bounds`, by iteratively reweighted least squares.

    Rows that see an outlier in their past weigh a hundredth, as their regressors are wrong (leverage). `readings`
    (row,) tell the quantum of rounding. None where all stretches are shorter than 50 rows after `warm_rows`.
    """
    begins = bounds[:-1] + warm_rows
    parts = [(int(i), int(j)) for i, j in zip(begins, bounds[1:], strict=True) if j - i >= 50]
    if not parts:
        return None
    windows = [np.lib.stride_tricks.sliding_window_view(errors[i : j - 1], ORDER) for i, j in parts]
    design = np.column_stack([np.concatenate(windows), np.concatenate([errors[i + ORDER : j] for i, j in parts])])
    weight = np.ones(len(design))
    coefficients, residual, scale = np.zeros(ORDER), design[:, -1], 1.0
    for _ in range(6):
        triangle = np.asarray(np.linalg.qr(design * weight[:, None], mode="r"))  # far smaller, with the same solution
        coefficients = np.linalg.lstsq(triangle[:, :ORDER], triangle[:, ORDER])[0]
        residual = design[:, ORDER] - design[:, :ORDER] @ coefficients
        size = np.abs(residual)
        scale = 1.4826 * float(np.median(size)) + 1e-9
        # Student-like weights, steeper where errors are gross
        robust = np.where(size > 5 * scale, 0.2, 1.0) / (1 + size / (2 * scale))
        past = np.convolve(size > 4 * scale, np.ones(ORDER + 1))[: len(size)] > 0
        weight = np.sqrt(robust) * np.where(past, 0.1, 1.0)
    levels = np.unique(np.round(readings, 5))
    if 2 < len(levels) < 0.05 * len(readings):
        scale = max(scale, QUANTUM_SCALE * float(np.median(np.diff(levels))))
    rows = np.concatenate([np.arange(i + ORDER, j) for i, j in parts])
    return Innovations(residual / scale, rows, np.concatenate([[1.0], -coefficients[::-1]]), scale)


def outliers_alone(z: FloatArray, pi: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Innovations `z` (innovation,) in which an additive outlier is one of them, at its place, and not all that the
    filter `pi` (order + 1,) answers it with; and those places (innovation,).

    Outliers are detected and what they add is taken out, until none is left (Chen and Liu 1993).
    """
    left, found = z.copy(), np.zeros(len(z))
    pattern, taps = pi / np.sqrt((pi**2).sum()), len(pi)
    for _ in range(_REMOVALS if len(z) > taps else 0):
        sizes = np.correlate(left, pattern, "valid")
        matched = np.abs(sizes)
        largest = np.lib.stride_tricks.sliding_window_view(np.abs(left), taps).max(1)
        additive = 0.5 * (matched**2 - largest**2) > SUSPECT_NATS
        at = np.flatnonzero(additive & (matched > SUSPECT) & (matched == maximum_filter1d(matched, 2 * taps - 1)))
        if not len(at):
            break
        found[at] += sizes[at]
        left[at[:, None] + np.arange(taps)] -= sizes[at, None] * pattern
    return np.clip(left + found, -CLIP, CLIP), found != 0


def additive_over_innovational(z: FloatArray, pi: FloatArray, dt: float) -> tuple[float, float, IntArray, FloatArray]:
    """Nats of additive over innovational outliers in innovations `z` (innovation,), the smear, their places and sizes.

    `pi` (order + 1,): the filter from errors to innovations. Suspects that are rather shocks count against it.
    """
    z = np.clip(z, -CLIP, CLIP)
    best = (-math.inf, 0.0, np.zeros(0, np.int64), np.zeros(0))
    # the largest innovation from two rows before to the end of the pattern
    largest = np.concatenate([np.zeros(2), np.abs(z)])
    largest = np.lib.stride_tricks.sliding_window_view(largest, _TAPS + 2).max(1) if len(z) > _TAPS else largest[:0]
    for smear in SMEAR_GRID:
        if smear > math.exp(-dt / SMEAR_S) or len(z) < _TAPS:
            break
        pattern = np.convolve(pi, smear ** np.arange(12))[:_TAPS]
        matched = np.abs(np.correlate(z, pattern / np.sqrt((pattern**2).sum()), "valid"))
        at = np.flatnonzero((matched > SUSPECT) & (matched == maximum_filter1d(matched, 7)))
        gains = 0.5 * (matched[at] ** 2 - largest[at] ** 2)
        total = float(gains.sum()) - SUSPECT_NATS * int((gains > 0).sum())
        if total > best[0]:
            best = (total, smear, at[gains > 0], matched[at[gains > 0]])
    return best


def contaminated_over_student(sizes: FloatArray) -> float:
    """Nats of a normal over Student's tail in what additive outliers add, `sizes` (outlier,) beyond `SUSPECT`: white
    noise with tails on a coloured error is additive, too."""
    n, wide = len(sizes), np.hypot(1.0, _WIDTHS)
    normal = -0.5 * float(sizes @ sizes) / wide**2 - n * (np.log(wide) + HALF_LOG_2PI + log_ndtr(-SUSPECT / wide))
    tail = n * np.log(_STUDENT_DOF / SUSPECT) - (_STUDENT_DOF + 1) * float(np.log(sizes / SUSPECT).sum())
    return float(normal.max() - tail.max())


def tail_log_likelihoods(z: FloatArray) -> tuple[float, float, float]:
    """Log likelihoods of innovations `z` (innovation,) under the best contaminated normal, Student's law, normal."""
    n, squares = len(z), float(z @ z)
    normal = float((-0.5 * squares / _NORMAL_SCALES**2 - n * np.log(_NORMAL_SCALES)).max()) - n * HALF_LOG_2PI
    dof, scale = _STUDENT_DOF[:, None], _STUDENT_SCALES
    peak = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * math.pi) - np.log(scale)
    tails = np.log1p(np.multiply.outer(1 / (dof * scale**2), z * z)).sum(-1)
    student = float((n * peak - (dof + 1) / 2 * tails).max())
    core, ratio = _CORE_SCALES[:, None], _WIDTHS
    wide = core * np.hypot(1.0, ratio)
    # wide over core density: b exp(a z²)
    a, b = 0.5 * (1 / core**2 - 1 / wide**2), core / wide
    odds = _SHARES / (1 - _SHARES)
    mixture = _sum_log1p_exp(z * z, a.ravel(), b.ravel(), odds).reshape(*a.shape, len(odds))
    mixture += (-0.5 * squares / core**2 - n * np.log(core))[..., None] + n * np.log1p(-_SHARES) - n * HALF_LOG_2PI
    return float(mixture.max()), student, normal


# inside ---------------------------------------------------------------------------------------------------------------
def _after_steps(data: DriveData) -> BoolArray:
    """Rows (row,) shortly after large steps of the command; none where that is nearly everywhere."""
    change = np.abs(np.diff(data.command, prepend=data.command[:1]))
    step = change > max(STEP_SHARE * float(np.percentile(change, 99.8)), STEP_MPS2)
    count = np.cumsum(np.concatenate([[0], step]))
    rows, length = np.arange(len(step)), max(int(STEP_S / data.dt), 1)
    near = count[rows + 1] > count[np.maximum(rows + 1 - length, 0)]
    return near if near.mean() <= 0.3 else np.zeros(len(step), bool)


def _lasting(z: FloatArray, places: BoolArray, ends: BoolArray, longest: float) -> BoolArray:
    """Innovations (innovation,) in runs of large ones, at most one small one between, of more than `longest`, or of
    more than one to the end of a stretch, as at `ends`, where they might have lasted; additive outliers at `places`
    (innovation,) are large."""
    large = np.flatnonzero((np.abs(z) > 3.5) | places)
    run = np.cumsum(np.diff(large, prepend=large[:1]) > 2)
    count, cut = np.bincount(run), np.bincount(run, ends[large]) > 0
    out = np.zeros(len(z), bool)
    out[large] = ((count > longest) | (cut & (count > 1)))[run]
    return out


@njit(cache=True, error_model="numpy")
def _sum_log1p_exp(x: FloatArray, a: FloatArray, b: FloatArray, odds: FloatArray) -> FloatArray:
    """Sums of log(1 + odds b exp(a x)) over x (value,) >= 0: (law, odds), `a` and `b` (law,)."""
    out, product = np.zeros((len(a), len(odds))), np.empty(len(odds))
    for i in range(len(a)):
        product[:] = 1.0
        for value in x:
            power = a[i] * value
            if power > 200:  # the exponential alone: one more is lost in rounding
                for k in range(len(odds)):
                    out[i, k] += math.log(odds[k] * b[i]) + power
                continue
            ratio = b[i] * math.exp(power)
            for k in range(len(odds)):
                product[k] *= 1 + odds[k] * ratio
                if product[k] > 1e200:
                    out[i, k] += math.log(product[k])
                    product[k] = 1.0
        for k in range(len(odds)):
            out[i, k] += math.log(product[k])
    return out
