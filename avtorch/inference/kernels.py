"""The SGLD walk, and the check of its draws, as compiled loops (numba).

What a step does is that of :class:`~avtorch.inference.sgld.SGLD`; the density is an
:class:`~avtorch.inference.exponential_form.ExponentialForm`. A chain's noise is a function of seed, window, chain and
step alone (Philox 4x32-10; Salmon et al. 2011), so it depends neither on the number of threads nor on that of chains.

Everything compiled stands in this file: numba's cache on disk is renewed when the file changes, and only then. Nothing
is assumed to be finite; a product may be contracted with the sum that takes it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: Chains that move together: few enough for the processor's first cache, and a constant, without which the compiler
#: does not take several at once. Of a number of chains that is no multiple some lanes run idle.
LANES = 32
#: Numbers of a term of its own in a row of ``own``: direction (3), offset, linear and square coefficient.
OWN = 6

_OPTIONS = {"nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}
# the check's sums over points, in any order
_SUMS = {**_OPTIONS, "fastmath": {"contract", "reassoc", "nsz"}}
# a loop that calls a function is not vectorised
_INLINE = {**_OPTIONS, "forceinline": True}

_LOG2E, _LN2 = 1.4426950408889634, 0.6931471805599453
# ln 2 in two parts, the first with trailing zeros so that its product with an exponent is exact
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
# added to a number below 2^51 it leaves the nearest integer in the last bits
_ROUND = 6755399441055744.0
# bits of sqrt(1/2): mantissas are taken from there to sqrt(2), so that logarithms near 0 keep their digits
_ROOT_HALF, _ONE, _MANTISSA = 0x3FE6A09E00000000, 0x3FF0000000000000, 0x000FFFFFFFFFFFFF
_INVERSE_FACTORIALS = tuple(1 / math.factorial(k) for k in range(14))


@njit(**_INLINE)
def _bits(x):
    return np.float64(x).view(np.int64)


@njit(**_INLINE)
def _from_bits(i):
    return np.int64(i).view(np.float64)


@njit(**_INLINE)
def exp(x):
    """``e^x`` to an ulp or two, without a call or a branch, so that the compiler takes several numbers at once.

    ``x = n ln 2 + r`` with ``|r| <= ln(2)/2``, where Taylor's series to ``r^13`` has an error below 1e-17.
    """
    x = 709.0 if x > 709.0 else x  # NaN passes
    x = -708.0 if x < -708.0 else x
    shifted = x * _LOG2E + _ROUND
    n = shifted - _ROUND
    r = x - n * _LN2_HIGH - n * _LN2_LOW
    p = _INVERSE_FACTORIALS[13]
    p = p * r + _INVERSE_FACTORIALS[12]
    p = p * r + _INVERSE_FACTORIALS[11]
    p = p * r + _INVERSE_FACTORIALS[10]
    p = p * r + _INVERSE_FACTORIALS[9]
    p = p * r + _INVERSE_FACTORIALS[8]
    p = p * r + _INVERSE_FACTORIALS[7]
    p = p * r + _INVERSE_FACTORIALS[6]
    p = p * r + _INVERSE_FACTORIALS[5]
    p = p * r + _INVERSE_FACTORIALS[4]
    p = p * r + _INVERSE_FACTORIALS[3]
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return p * _from_bits((_bits(shifted) + 1023) << 52)


@njit(**_INLINE)
def _round(c0, c1, c2, c3, k0, k1):
    """One round of Philox 4x32: two products of 32 bits, their halves exchanged and mixed with the key."""
    first, second = np.uint64(0xD2511F53) * c0, np.uint64(0xCD9E8D57) * c2
    low, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    return (second >> half) ^ c1 ^ k0, second & low, (first >> half) ^ c3 ^ k1, first & low


@njit(**_INLINE)
def _next_key(k0, k1):
    low = np.uint64(0xFFFFFFFF)
    return (k0 + np.uint64(0x9E3779B9)) & low, (k1 + np.uint64(0xBB67AE85)) & low


@njit(**_INLINE)
def philox(c0, c1, c2, c3, k0, k1):
    """Philox 4x32-10: four random words of 32 bits from a counter of four and a key of two, all held as uint64."""
    # with the upper halves known to be empty the compiler takes several counters at once; so it does without a loop
    low = np.uint64(0xFFFFFFFF)
    c0, c1, c2, c3, k0, k1 = c0 & low, c1 & low, c2 & low, c3 & low, k0 & low, k1 & low
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
    k0, k1 = _next_key(k0, k1)
    return _round(c0, c1, c2, c3, k0, k1)


@njit(**_INLINE)
def _radius(word):
    """``sqrt(-2 log u)`` of a 32-bit word, at most 6.8; the series of the logarithm's inverse tangent to 1e-10."""
    u = (np.float64(np.int64(word)) + 0.5) * 2.0**-32
    i = _bits(u) + (_ONE - _ROOT_HALF)
    exponent = np.float64((i >> 52) - 1023)
    mantissa = _from_bits((i & _MANTISSA) + _ROOT_HALF)
    s = (mantissa - 1) / (mantissa + 1)
    q = s * s
    log = exponent * _LN2 + 2 * s * (1 + q * (1 / 3 + q * (1 / 5 + q * (1 / 7 + q * (1 / 9 + q * (1 / 11))))))
    return np.sqrt(max(0.0, -2 * log))


@njit(**_INLINE)
def _direction(word):
    """Sine and cosine of a uniform angle: a quarter turn by two bits, within it by the other thirty, to 1e-9."""
    quarter, rest = np.int64(word) >> 30, np.int64(word) & 0x3FFFFFFF
    t = ((np.float64(rest) + 0.5) * 2.0**-30 - 0.5) * (math.pi / 2)
    y = t * t
    sine = t * (1 + y * (-1 / 6 + y * (1 / 120 + y * (-1 / 5040 + y * (1 / 362880)))))
    cosine = 1 + y * (-0.5 + y * (1 / 24 + y * (-1 / 720 + y * (1 / 40320 + y * (-1 / 3628800)))))
    turned = (quarter & 1) != 0
    # of the angle t + quarter turns: (sin, cos), (cos, -sin), (-sin, -cos), (-cos, sin)
    first = cosine if turned else sine
    second = sine if turned else cosine
    sign_first = 1.0 - 2.0 * np.float64(quarter >> 1)
    sign_second = 1.0 - 2.0 * np.float64(((quarter + 1) >> 1) & 1)
    return first * sign_first, second * sign_second


@njit(**_OPTIONS)
def normals(out, words, chain, step, window, k0, k1):
    """Standard normal noise of the chains from ``chain`` on, three numbers each, LANES apart in ``out`` (Box-Muller).

    ``words`` is scratch; integers and floats in one loop would not be vectorised.
    """
    for c in range(LANES):
        a, b, d, e = philox(np.uint64(chain + c), np.uint64(step), np.uint64(window), np.uint64(0), k0, k1)
        words[c], words[LANES + c], words[2 * LANES + c], words[3 * LANES + c] = a, b, d, e
    for c in range(LANES):
        radius = _radius(words[c])
        sine, cosine = _direction(words[LANES + c])
        out[c], out[LANES + c] = radius * sine, radius * cosine
    for c in range(LANES):
        sine, _ = _direction(words[3 * LANES + c])
        out[2 * LANES + c] = _radius(words[2 * LANES + c]) * sine


@njit(**_OPTIONS)
def _slope(slope, w, exponents, offsets, coupling, linear, quadratic, own):
    """``dU/dw`` of LANES chains of one window."""
    a00, a01, a02 = exponents[0, 0], exponents[0, 1], exponents[0, 2]
    a10, a11, a12 = exponents[1, 0], exponents[1, 1], exponents[1, 2]
    a20, a21, a22 = exponents[2, 0], exponents[2, 1], exponents[2, 2]
    b0, b1, b2 = offsets[0], offsets[1], offsets[2]
    f00, f01, f02, f11, f12, f22 = (
        coupling[0, 0],
        coupling[0, 1],
        coupling[0, 2],
        coupling[1, 1],
        coupling[1, 2],
        coupling[2, 2],
    )
    h00, h01, h02, h11, h12, h22 = (
        quadratic[0, 0],
        quadratic[0, 1],
        quadratic[0, 2],
        quadratic[1, 1],
        quadratic[1, 2],
        quadratic[2, 2],
    )
    l0, l1, l2 = linear[0], linear[1], linear[2]
    for c in range(LANES):
        x, y, z = w[c], w[LANES + c], w[2 * LANES + c]
        e0 = exp(b0 + a00 * x + a01 * y + a02 * z)
        e1 = exp(b1 + a10 * x + a11 * y + a12 * z)
        e2 = exp(b2 + a20 * x + a21 * y + a22 * z)
        p0 = e0 * (f00 * e0 + f01 * e1 + f02 * e2)
        p1 = e1 * (f01 * e0 + f11 * e1 + f12 * e2)
        p2 = e2 * (f02 * e0 + f12 * e1 + f22 * e2)
        slope[c] = l0 + h00 * x + h01 * y + h02 * z + a00 * p0 + a10 * p1 + a20 * p2
        slope[LANES + c] = l1 + h01 * x + h11 * y + h12 * z + a01 * p0 + a11 * p1 + a21 * p2
        slope[2 * LANES + c] = l2 + h02 * x + h12 * y + h22 * z + a02 * p0 + a12 * p1 + a22 * p2
    for t in range(own.shape[0]):
        d0, d1, d2, offset, first, square = own[t, 0], own[t, 1], own[t, 2], own[t, 3], own[t, 4], own[t, 5]
        for c in range(LANES):
            e = exp(offset + d0 * w[c] + d1 * w[LANES + c] + d2 * w[2 * LANES + c])
            p = e * (first + square * e)
            slope[c] += d0 * p
            slope[LANES + c] += d1 * p
            slope[2 * LANES + c] += d2 * p


@njit(**_OPTIONS)
def _advance(w, slope, fresh, previous, h, amplitude, averaged, limit):
    """``w - h/2 slope + amplitude noise``; a finite ``limit`` cuts the slope there, and one that is no number to 0."""
    for c in range(3 * LANES):
        s = slope[c]
        s = 0.0 if s != s and limit < np.inf else s
        s = limit if s > limit else s
        s = -limit if s < -limit else s
        noise = 0.5 * (previous[c] + fresh[c]) if averaged else fresh[c]
        w[c] = (w[c] - 0.5 * h * s) + amplitude * noise


@njit(
    "void(int64, int64, float64[:,:,::1], float64[:,:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1],"
    " float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64, boolean, int64, int64, float64, uint64, uint64)",
    cache=True,
    **_OPTIONS,
)
def walk(
    first, last, start, kept, exponents, offsets, coupling, linear, quadratic, own, h, averaged, burn_in, thinning,
    limit, k0, k1,
):  # fmt: skip
    """Walk the pieces ``first`` to ``last`` of window after window, each of LANES chains, and write into ``kept``.

    Args:
        start: ``(3, window, chain)``.
        kept: ``(3, window, draw, chain)``.
        exponents, offsets, coupling, linear, quadratic, own: the potential in ``w``, one row a window.
        limit: largest slope of the burn-in; infinite for none.
        k0, k1: the seed's two words of 32 bits.
    """
    chains, draws = start.shape[2], kept.shape[2]
    pieces = (chains + LANES - 1) // LANES
    w, slope, fresh, previous = np.zeros(3 * LANES), np.zeros(3 * LANES), np.zeros(3 * LANES), np.zeros(3 * LANES)
    words = np.zeros(4 * LANES, dtype=np.uint64)
    amplitude = np.sqrt(h)
    for piece in range(first, last):
        window, chain = piece // pieces, piece % pieces * LANES
        lanes = min(LANES, chains - chain)
        for i in range(3):
            for c in range(lanes):
                w[i * LANES + c] = start[i, window, chain + c]
        if averaged:
            normals(previous, words, chain, 0, window, k0, k1)
        for step in range(burn_in + draws * thinning):
            _slope(
                slope, w, exponents[window], offsets[window], coupling[window], linear[window],
                quadratic[window], own[window],
            )  # fmt: skip
            normals(fresh, words, chain, step + 1, window, k0, k1)
            cut = limit if step < burn_in else np.inf
            _advance(w, slope, fresh, previous, h, amplitude, averaged, cut)
            fresh, previous = previous, fresh
            collected = step + 1 - burn_in
            if collected > 0 and collected % thinning == 0:
                for i in range(3):
                    for c in range(lanes):
                        kept[i, window, collected // thinning - 1, chain + c] = w[i * LANES + c]


@njit(**_SUMS)
def _moments(out, weight, axes, points, tail):
    """Weighted mean, variance and share beyond ``tail`` of one direction, and their errors; see :func:`weigh`."""
    count = points.shape[1]
    half = count // 2
    a0, a1, a2 = axes[0], axes[1], axes[2]
    mean, share = 0.0, 0.0
    for p in range(count):
        y = a0 * points[0, p] + a1 * points[1, p] + a2 * points[2, p]
        mean += weight[p] * y
        share += weight[p] if abs(y) > tail else 0.0
    variance = 0.0
    for p in range(count):
        off = a0 * points[0, p] + a1 * points[1, p] + a2 * points[2, p] - mean
        variance += weight[p] * off * off
    variance = max(variance, 1e-300)
    of_mean, of_variance, of_share = 0.0, 0.0, 0.0
    for p in range(half):  # a point and its mirror image count as one: their errors cancel in part
        y = a0 * points[0, p] + a1 * points[1, p] + a2 * points[2, p]
        beyond = 1.0 if abs(y) > tail else 0.0
        one, other = weight[p], weight[half + p]
        first = one * (y - mean) + other * (-y - mean)
        second = one * ((y - mean) ** 2 - variance) + other * ((y + mean) ** 2 - variance)
        third = (one + other) * (beyond - share)
        of_mean += first * first
        of_variance += second * second
        of_share += third * third
    out[0], out[1], out[2] = mean, variance, share
    out[3], out[4], out[5] = np.sqrt(of_mean), np.sqrt(of_variance), np.sqrt(of_share)


@njit(**_INLINE)
def _potential(out, points, exponents, offsets, coupling, linear, quadratic, own):
    """``U`` at ``points`` ``(3, point)`` in ``w`` of one window, less its value at ``w = 0`` without exponentials."""
    a, b, f, h = exponents, offsets, coupling, quadratic
    a00, a01, a02, a10, a11, a12 = a[0, 0], a[0, 1], a[0, 2], a[1, 0], a[1, 1], a[1, 2]
    a20, a21, a22, b0, b1, b2 = a[2, 0], a[2, 1], a[2, 2], b[0], b[1], b[2]
    f00, f01, f02, f11, f12, f22 = f[0, 0], f[0, 1], f[0, 2], f[1, 1], f[1, 2], f[2, 2]
    h00, h01, h02, h11, h12, h22 = h[0, 0], h[0, 1], h[0, 2], h[1, 1], h[1, 2], h[2, 2]
    g0, g1, g2 = linear[0], linear[1], linear[2]
    for p in range(points.shape[1]):
        x, y, z = points[0, p], points[1, p], points[2, p]
        e0 = exp(b0 + a00 * x + a01 * y + a02 * z)
        e1 = exp(b1 + a10 * x + a11 * y + a12 * z)
        e2 = exp(b2 + a20 * x + a21 * y + a22 * z)
        pairs = e0 * (f00 * e0 + 2 * (f01 * e1 + f02 * e2)) + e1 * (f11 * e1 + 2 * f12 * e2) + f22 * e2 * e2
        square = x * (h00 * x + 2 * (h01 * y + h02 * z)) + y * (h11 * y + 2 * h12 * z)
        out[p] = g0 * x + g1 * y + g2 * z + 0.5 * (square + h22 * z * z + pairs)
    for t in range(own.shape[0]):
        d0, d1, d2, offset, single, double = own[t, 0], own[t, 1], own[t, 2], own[t, 3], own[t, 4], own[t, 5]
        for p in range(points.shape[1]):
            e = exp(offset + d0 * points[0, p] + d1 * points[1, p] + d2 * points[2, p])
            out[p] += e * (single + 0.5 * double * e)


@njit(**_INLINE)
def _mean_log(x, b):
    """Mean of ``log(1 - b x)``; eight factors a logarithm, none of them beyond 1e30."""
    total, product = 0.0, 1.0
    for i in range(len(x)):
        product *= 1 - b * x[i]
        if i % 8 == 7:
            total += math.log(product)
            product = 1.0
    return (total + math.log(product)) / len(x)


@njit("void(float64[:,::1], float64[::1])", cache=True, **_OPTIONS)
def pareto_shapes(largest, out):
    """Of each window's largest log ratios ``(window, tail + 1)``, falling and none of them NaN, what
    :func:`avtorch.inference.importance.pareto_k` has of all."""
    tail = largest.shape[1] - 1
    count = 30 + int(math.sqrt(tail))
    x, steps, profile = np.empty(tail), np.empty(count), np.empty(count)
    for window in range(len(largest)):
        log = largest[window]
        for i in range(tail):
            x[i] = math.exp(log[tail - 1 - i] - log[0]) - math.exp(log[tail] - log[0])
        if not np.isfinite(log[0]) or x[tail - 1] < 1e-12:
            out[window] = -np.inf if np.isfinite(log[0]) else np.inf
            continue
        quarter, most, total, b = max(x[int(tail / 4 + 0.5) - 1], 1e-300), -np.inf, 0.0, 0.0
        for j in range(count):
            steps[j] = (1 - math.sqrt(count / (j + 0.5))) / (3 * quarter) + 1 / x[tail - 1]
            k = _mean_log(x, steps[j])
            inner = -steps[j] / k
            profile[j] = tail * (math.log(inner) - k - 1) if inner > 0 else -np.inf
            most = max(most, profile[j])
        for j in range(count):
            total += math.exp(profile[j] - most)
            b += math.exp(profile[j] - most) * steps[j]
        out[window] = (tail * _mean_log(x, b / total) + 5) / (tail + 10)


@njit(
    "void(int64, int64, float64[:,:,::1], float64[:,::1], float64[:,::1], float64[::1], float64[:,:,::1], float64,"
    " float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1])",
    cache=True,
    **_OPTIONS,
)
def weigh(
    first, last, out, log_ratio, points, log_proposal, axes, tail,
    exponents, offsets, coupling, linear, quadratic, own,
):  # fmt: skip
    """Log importance ratios ``(window, point)`` of the windows ``first`` to ``last``, and the moments by them.

    `out`: ``(window, 3, 6)``: mean, variance and share beyond ``tail`` of each direction, and their errors. `points`:
    ``(3, point)``, the second half mirror images of the first; in ``w`` as the potential. `axes`: ``(window, 3, 3)``: a
    direction is a row times a point.
    """
    count = points.shape[1]
    weight = np.zeros(count)
    for window in range(first, last):
        ratio = log_ratio[window]
        _potential(
            ratio, points, exponents[window], offsets[window], coupling[window], linear[window], quadratic[window],
            own[window],
        )  # fmt: skip
        largest = -np.inf
        for p in range(count):
            ratio[p] = -ratio[p] - log_proposal[p]
            ratio[p] = ratio[p] if ratio[p] < np.inf else -np.inf  # also what is no number
            largest = max(largest, ratio[p])
        total = 0.0
        if largest > -np.inf:
            for p in range(count):
                weight[p] = exp(ratio[p] - largest)
            for p in range(count):
                total += weight[p]
        for p in range(count):
            weight[p] = weight[p] / total if total > 0 else 0.0
        for i in range(3):
            _moments(out[window, i], weight, axes[window, i], points, tail)


@njit(
    "void(int64, int64, float64[:,:,::1], float64[:,::1], float64[::1], int64, float64,"
    " float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1])",
    cache=True,
    **_OPTIONS,
)
def climb(
    first, last, ends, heights, start, steps, stride, exponents, offsets, coupling, linear, quadratic, own
):  # fmt: skip
    """Ascents of the density from LANES points ``start`` ``(3 LANES,)``, each of ``steps`` no longer than ``stride``.

    `ends`: ``(window, 3, LANES)``: where they end, in ``w``; 0 for what is not finite. `heights`: ``(window, LANES)``:
    log density there, less that at ``w = 0``.
    """
    slope, origin, nought = np.zeros(3 * LANES), np.zeros(1), np.zeros((3, 1))
    for window in range(first, last):
        w = ends[window].reshape(3 * LANES)
        w[:] = start
        for _ in range(steps):
            _slope(
                slope, w, exponents[window], offsets[window], coupling[window], linear[window],
                quadratic[window], own[window],
            )  # fmt: skip
            for c in range(LANES):
                a, b, d = slope[c], slope[LANES + c], slope[2 * LANES + c]
                share = min(stride / math.sqrt(a * a + b * b + d * d), 1.0)
                w[c] -= share * a
                w[LANES + c] -= share * b
                w[2 * LANES + c] -= share * d
        for c in range(3 * LANES):
            w[c] = w[c] if np.isfinite(w[c]) else 0.0
        for out, x in ((heights[window], ends[window]), (origin, nought)):
            _potential(
                out, x, exponents[window], offsets[window], coupling[window], linear[window], quadratic[window],
                own[window],
            )  # fmt: skip
        for c in range(LANES):
            heights[window, c] = origin[0] - heights[window, c]


@njit(
    "void(int64, int64, float64[:,:,:,::1], float64[:,:,::1], int64, int64, float64, float64[:,::1], int64[::1],"
    " float64[:,::1], float64[:,:,::1], float64[:,:,::1])",
    cache=True,
    **_SUMS,
)
def summarise(first, last, kept, lower, groups, pieces, tail, rhat, furthest, mean, covariance, errors):
    """What is asked of the draws ``kept`` ``(3, window, draw, chain)`` of each window, of ``w`` and of ``lower w``.

    Args:
        rhat: ``(window, 3)``: nested R-hat of ``w`` by so many ``groups``.
        furthest: ``(window,)``: the draw furthest from ``w = 0``, ``draw * chains + chain``.
        mean, covariance: ``(window, 3)`` of ``w`` and ``(window, 3, 3)`` of ``lower w``.
        errors: ``(window, 3, 3)``: of each row of ``lower w`` the share beyond ``tail`` SDs, and the errors of mean and
            SD by the means of each chain's ``pieces``.
    """
    draws, chains = kept.shape[2], kept.shape[3]
    members, half, length = chains // groups, draws // 2, draws // pieces
    y = np.zeros((3, draws, chains))
    for window in range(first, last):
        farthest, at = -1.0, 0
        for k in range(draws):
            for c in range(chains):
                distance = kept[0, window, k, c] ** 2 + kept[1, window, k, c] ** 2 + kept[2, window, k, c] ** 2
                if not distance <= farthest:  # also what is no number
                    farthest, at = np.inf if distance != distance else distance, k * chains + c
        furthest[window] = at
        for i in range(3):
            x = kept[i, window]
            within, all_means, all_squares, total = 0.0, 0.0, 0.0, 0.0
            for g in range(groups):
                for begin in (0, half):
                    first_sum, second_sum = 0.0, 0.0
                    for k in range(begin, begin + half):
                        for c in range(g * members, (g + 1) * members):
                            off = x[k, c] - x[0, 0]
                            first_sum += off
                            second_sum += off * off
                    middle = first_sum / (members * half)
                    within += second_sum / (members * half) - middle * middle
                    all_means += middle
                    all_squares += middle * middle
            n = 2 * groups
            between = max(0.0, all_squares - all_means * all_means / n) / (n - 1)
            rhat[window, i] = np.sqrt(1 + between / max(within / n, 2.2250738585072014e-308))
            for k in range(draws):
                for c in range(chains):
                    total += x[k, c]
            mean[window, i] = total / (draws * chains)
        for i in range(3):
            l0, l1, l2 = lower[window, i, 0], lower[window, i, 1], lower[window, i, 2]
            m0, m1, m2 = mean[window, 0], mean[window, 1], mean[window, 2]
            for k in range(draws):
                for c in range(chains):
                    y[i, k, c] = (
                        l0 * (kept[0, window, k, c] - m0)
                        + l1 * (kept[1, window, k, c] - m1)
                        + l2 * (kept[2, window, k, c] - m2)
                    )
        for i in range(3):
            for j in range(i + 1):
                total = 0.0
                for k in range(draws):
                    for c in range(chains):
                        total += y[i, k, c] * y[j, k, c]
                covariance[window, i, j] = covariance[window, j, i] = total / (draws * chains - 1)
            variance, beyond = covariance[window, i, i], 0
            sum_each, sum_square, of_each, of_square = 0.0, 0.0, 0.0, 0.0
            for piece in range(pieces):
                for c in range(chains):
                    one, two = 0.0, 0.0
                    for k in range(piece * length, (piece + 1) * length):
                        one += y[i, k, c]
                        two += y[i, k, c] * y[i, k, c]
                    one, two = one / length, two / length - variance
                    sum_each, of_each = sum_each + one, of_each + one * one
                    sum_square, of_square = sum_square + two, of_square + two * two
            for k in range(draws):
                for c in range(chains):
                    beyond += 1 if y[i, k, c] * y[i, k, c] > tail * tail * variance else 0
            n = pieces * chains
            errors[window, i, 0] = beyond / (draws * chains)
            errors[window, i, 1] = np.sqrt((of_each - sum_each * sum_each / n) / (n - 1) / n / variance)
            errors[window, i, 2] = 0.5 * np.sqrt((of_square - sum_square * sum_square / n) / (n - 1) / n) / variance
