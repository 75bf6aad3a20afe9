"""The latent log likelihood as a compiled loop over rows (numba), even and uneven alike.

The law and the recursion are those of :mod:`~avtorch.inference.latent_model`, written out for the state ``(v, a, c,
e)`` whose two halves move apart: of the covariance's ten numbers and the mean's four none is computed that is zero.

Everything compiled of this form stands in this file: numba's cache on disk is renewed when the file changes, and only
then. Nothing is assumed to be finite; a product may be contracted with the sum that takes it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: Parameters that are filtered together: few enough for the processor's first cache, and a constant, without which the
#: compiler does not take several at once. Of a number that is no multiple some lanes run idle.
LANES = 8
#: Rows whose innovations' variances are multiplied before one logarithm is taken: 32 of 1e-9 to 1e9 are within range.
TOGETHER = 16

_OPTIONS = {"nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}
_ROOT3 = math.sqrt(3.0)
_INVERSE_FACTORIALS = tuple(1.0 / math.factorial(k) for k in range(24))
# of x - 2(1 - e^-x) + (1 - e^-2x)/2 from x³ on
_SERIES = tuple((-1.0) ** (k + 1) * (2.0 ** (k - 1) - 2.0) / math.factorial(k) for k in range(3, 21))

# where the numbers of a step stand in its flat array, LANES apart
_REACH, _DECAY, _PUSH_V, _PUSH_A, _VV, _VA, _AA = 0, 1, 2, 3, 4, 5, 6
_C_C, _C_E, _E_C, _E_E, _CC, _CE, _EE = 7, 8, 9, 10, 11, 12, 13
_STEP = 14
# and those of the belief: mean, then the covariance's upper triangle
_BELIEF = 14
# the same, LANES apart, for a state in the order (v, a, c, e) and (a, v, e, c): speed and acceleration are what is
# measured of the first and the third
_SPEED_FIRST = tuple(LANES * i for i in (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13))
_ACCEL_FIRST = tuple(LANES * i for i in (1, 0, 3, 2, 8, 5, 10, 9, 4, 7, 6, 13, 12, 11))


@njit(**_OPTIONS)
def _integrated(x):
    """``x - 2(1 - e^-x) + (1 - e^-2x)/2``; ~x³/3. See ``latent_model``."""
    if x >= 0.5:
        return x + 2.0 * math.expm1(-x) - 0.5 * math.expm1(-2.0 * x)
    total = 0.0
    for k in range(17, -1, -1):
        total = total * x + _SERIES[k]
    return total * x**3


@njit(**_OPTIONS)
def _lower_gamma(y):
    """``1 - e^-y (1 + y + y²/2)``; ~y³/6. See ``latent_model``."""
    if y >= 1.0:
        return 1.0 - math.exp(-y) * (1.0 + y + 0.5 * y * y)
    total = 0.0
    for k in range(23, 2, -1):
        total = total * y + _INVERSE_FACTORIALS[k]
    return math.exp(-y) * total * y**3


@njit(**_OPTIONS)
def _discretise(step, p, first, dt):
    """The numbers of one exact step of ``dt`` [s], for the LANES parameters from ``first`` on."""
    for c in range(LANES):
        d = min(first + c, p.shape[1] - 1)
        lag, gain, rough, shaken, sd, length = p[0, d], p[1, d], p[2, d], p[3, d], p[4, d], p[5, d]
        x = dt / lag
        lost = -math.expm1(-x)
        density, reach = rough * rough, lag * lost
        step[_REACH * LANES + c], step[_DECAY * LANES + c] = reach, math.exp(-x)
        step[_PUSH_V * LANES + c], step[_PUSH_A * LANES + c] = gain * (dt - reach), gain * lost
        step[_VV * LANES + c] = density * lag**3 * _integrated(x) + shaken * shaken * dt
        step[_VA * LANES + c] = 0.5 * density * reach * reach
        step[_AA * LANES + c] = -0.5 * density * lag * math.expm1(-2.0 * x)
        rate = _ROOT3 / length
        x = rate * dt
        decay, variance = math.exp(-x), (sd / rate) ** 2
        step[_C_C * LANES + c], step[_C_E * LANES + c] = decay * (1.0 + x), decay * dt
        step[_E_C * LANES + c], step[_E_E * LANES + c] = -decay * rate * x, decay * (1.0 - x)
        step[_CC * LANES + c] = variance * _lower_gamma(2.0 * x)
        step[_CE * LANES + c] = 2.0 * variance * rate * (decay * x) ** 2
        step[_EE * LANES + c] = sd * sd * (-math.expm1(-2.0 * x) + 2.0 * decay * decay * x * (1.0 - x))


@njit(**_OPTIONS)
def _sum_seen(one, other, R, seen):
    """Two independent numbers of mean 0 and these variances, of which the sum is `seen` with noise of variance `R`.

    Their means, variances and covariance afterwards, and the sum's variance before.
    """
    S = one + other + R
    return one / S * seen, other / S * seen, one * (other + R) / S, other * (one + R) / S, -one * other / S, S


@njit(**_OPTIONS)
def _begin(b, total, product, p, first, variances, speed_sd, accel_sd, speed, accel, has_speed, has_accel):
    """The belief after the first row: its start is diagonal, so nothing large is taken from anything large."""
    for i in range(_BELIEF * LANES):
        b[i] = 0.0
    for c in range(LANES):
        d = min(first + c, p.shape[1] - 1)
        sd, length = p[4, d], p[5, d]
        v, a, slow, e = speed_sd**2, accel_sd**2, (sd * length) ** 2 / 3.0, sd * sd
        total[c], product[c] = 0.0, 1.0
        mean_v, mean_a, mean_c, mean_e, vc, ae = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if has_speed:
            mean_v, mean_c, v, slow, vc, S = _sum_seen(v, slow, variances[0, d], speed)
            total[c] += speed * speed / S
            product[c] *= S
        if has_accel:
            mean_a, mean_e, a, e, ae, S = _sum_seen(a, e, variances[1, d], accel)
            total[c] += accel * accel / S
            product[c] *= S
        b[0 * LANES + c], b[1 * LANES + c], b[2 * LANES + c], b[3 * LANES + c] = mean_v, mean_a, mean_c, mean_e
        b[4 * LANES + c], b[6 * LANES + c], b[8 * LANES + c] = v, vc, a
        b[10 * LANES + c], b[11 * LANES + c], b[13 * LANES + c] = ae, slow, e


@njit(**_OPTIONS)
def _predict(b, step, command):
    for c in range(LANES):
        v, a, slow, e = b[c], b[LANES + c], b[2 * LANES + c], b[3 * LANES + c]
        vv, va, vc, ve = b[4 * LANES + c], b[5 * LANES + c], b[6 * LANES + c], b[7 * LANES + c]
        aa, ac, ae = b[8 * LANES + c], b[9 * LANES + c], b[10 * LANES + c]
        cc, ce, ee = b[11 * LANES + c], b[12 * LANES + c], b[13 * LANES + c]
        reach, decay = step[_REACH * LANES + c], step[_DECAY * LANES + c]
        f, g = step[_C_C * LANES + c], step[_C_E * LANES + c]
        h, k = step[_E_C * LANES + c], step[_E_E * LANES + c]
        b[c] = v + reach * a + step[_PUSH_V * LANES + c] * command
        b[LANES + c] = decay * a + step[_PUSH_A * LANES + c] * command
        b[2 * LANES + c] = f * slow + g * e
        b[3 * LANES + c] = h * slow + k * e
        b[4 * LANES + c] = vv + reach * (2.0 * va + reach * aa) + step[_VV * LANES + c]
        b[5 * LANES + c] = decay * (va + reach * aa) + step[_VA * LANES + c]
        b[8 * LANES + c] = decay * decay * aa + step[_AA * LANES + c]
        along_c, along_e = vc + reach * ac, ve + reach * ae
        b[6 * LANES + c] = f * along_c + g * along_e
        b[7 * LANES + c] = h * along_c + k * along_e
        b[9 * LANES + c] = decay * (f * ac + g * ae)
        b[10 * LANES + c] = decay * (h * ac + k * ae)
        b[11 * LANES + c] = f * (f * cc + 2.0 * g * ce) + g * g * ee + step[_CC * LANES + c]
        b[12 * LANES + c] = f * (h * cc + k * ce) + g * (h * ce + k * ee) + step[_CE * LANES + c]
        b[13 * LANES + c] = h * (h * cc + 2.0 * k * ce) + k * k * ee + step[_EE * LANES + c]


@njit(**_OPTIONS)
def _see(b, total, product, R, seen, order):
    """Takes in ``seen``, the sum of the first and the third number of the belief in this ``order``."""
    one, two, three, four, aa, ab, ac, ad, bb, bc, bd, cc, cd, dd = order
    turned = two < one  # products are taken in one order, of which the last digit depends
    for c in range(LANES):
        s1, s2 = b[aa + c] + b[ac + c], b[ab + c] + b[bc + c]
        s3, s4 = b[ac + c] + b[cc + c], b[ad + c] + b[cd + c]
        S = s1 + s3 + R[c]
        S = S if S > 0.0 else np.nan
        w = 1.0 / S
        missed = seen - b[one + c] - b[three + c]
        total[c] += missed * missed * w
        product[c] *= S
        k1, k2, k3, k4 = w * s1, w * s2, w * s3, w * s4
        b[one + c] += k1 * missed
        b[two + c] += k2 * missed
        b[three + c] += k3 * missed
        b[four + c] += k4 * missed
        b[aa + c] -= k1 * s1
        b[ab + c] -= k2 * s1 if turned else k1 * s2
        b[ac + c] -= k1 * s3
        b[ad + c] -= k1 * s4
        b[bb + c] -= k2 * s2
        b[bc + c] -= k2 * s3
        b[bd + c] -= k2 * s4
        b[cc + c] -= k3 * s3
        b[cd + c] -= k4 * s3 if turned else k3 * s4
        b[dd + c] -= k4 * s4


@njit(
    "void(float64[::1], float64[:,::1], float64[:,::1], float64, float64, float64[::1], boolean, float64[::1],"
    " float64[::1], float64[::1])",
    cache=True,
    **_OPTIONS,
)
def filtered(out, p, variances, speed_sd, accel_sd, steps, even, u, speed, accel):
    """Log likelihood ``(draw,)`` [nats] of one run of rows, into ``out``; NaN where digits are lost.

    Args:
        p: ``(6, draw)``: T_L, K_L, process noise, road noise, coloured SD and time.
        variances: ``(2, draw)`` of speed and acceleration per row; that of a signal without rows is not read.
        speed_sd, accel_sd: of the start [m/s, m/s²].
        steps: ``(row - 1,)`` [s]; ``even``: all as the first.
        u, speed, accel: ``(row,)``, the speed beyond the first one; a signal that is not measured has no rows.
    """
    rows, draws = len(u), p.shape[1]
    has_speed, has_accel = len(speed) > 0, len(accel) > 0
    b, step = np.zeros(_BELIEF * LANES), np.zeros(_STEP * LANES)
    total, product = np.zeros(LANES), np.zeros(LANES)
    R = np.zeros((2, LANES))
    constant = rows * (has_speed + has_accel) * math.log(2.0 * math.pi)
    for first in range(0, draws, LANES):
        for c in range(LANES):
            d = min(first + c, draws - 1)
            R[0, c], R[1, c] = variances[0, d], variances[1, d]
        one, other = speed[0] if has_speed else 0.0, accel[0] if has_accel else 0.0
        _begin(b, total, product, p, first, variances, speed_sd, accel_sd, one, other, has_speed, has_accel)
        if rows > 1:
            _discretise(step, p, first, steps[0])
        for k in range(1, rows):
            if not even and k > 1:
                _discretise(step, p, first, steps[k - 1])
            _predict(b, step, u[k - 1])
            if has_speed:
                _see(b, total, product, R[0], speed[k], _SPEED_FIRST)
            if has_accel:
                _see(b, total, product, R[1], accel[k], _ACCEL_FIRST)
            if k % TOGETHER == 0:
                for c in range(LANES):
                    total[c] += math.log(product[c])
                    product[c] = 1.0
        for c in range(min(LANES, draws - first)):
            out[first + c] = -0.5 * (total[c] + math.log(product[c]) + constant)
