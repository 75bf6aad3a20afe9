"""The SGLD walk as a compiled loop (numba).

What a step does is that of :class:`~avtorch.inference.sgld.SGLD`; the density is an
:class:`~avtorch.inference.density.ExponentialForm`. A chain's noise is a function of seed, window, chain and
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

_OPTIONS = {"nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}
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
    for k in range(12, -1, -1):
        p = p * r + _INVERSE_FACTORIALS[k]
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
    # with the upper halves known to be empty the compiler takes several counters at once
    low = np.uint64(0xFFFFFFFF)
    c0, c1, c2, c3, k0, k1 = c0 & low, c1 & low, c2 & low, c3 & low, k0 & low, k1 & low
    for _ in range(9):
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
    f00, f01, f02 = coupling[0, 0], coupling[0, 1], coupling[0, 2]
    f11, f12, f22 = coupling[1, 1], coupling[1, 2], coupling[2, 2]
    h00, h01, h02 = quadratic[0, 0], quadratic[0, 1], quadratic[0, 2]
    h11, h12, h22 = quadratic[1, 1], quadratic[1, 2], quadratic[2, 2]
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
        exponents, offsets, coupling, linear, quadratic, own: the potential in ``w``, one row a window. A row of ``own``
            holds the direction (3), offset, linear and square coefficient of a term.
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
