"""GLVD with every deterministic effect of the table at once, compiled: one pass over the rows of a drive.

The chain is that of `avtorch.gap.simulator`, and so are its equations; both are held to each other by a test. A drive
is given on a grid of steps of at most `GRID_S`, so that what a recorder delays can be read between rows:

    command      saturation, dead band, play, pause of the hand-over, dead time
    actuator     tau² a'' + T a' + a = g, a' bounded;  g = K u times gains by sign, speed, time and gear; T likewise
    body         ring of the driveline, drags, resistance, creep
    sensor       first-order filter, scale, offset; first-order filter of the speed

Each step is integrated exactly for a held target; the speed gains the actuator's integral and the forces' trapezoids.
A parameter acts from its own time on and is neutral before.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.engine.coordinates import INDEX, NEUTRAL

GRID_S = 0.0252
"""Longest step of the grid [s]: between its points, where a recorder's delay is read, a lagged acceleration of
10 m/s⁴ is straight to 1 mm/s²."""

_T_L, _K_L = INDEX["T_L"], INDEX["K_L"]
_DRIVE, _BRAKE = INDEX["drive_limit"], INDEX["brake_limit"]
_BAND, _PLAY, _PAUSE, _DELAY = (INDEX[name] for name in ("dead_band", "backlash", "hand_over", "dead_time"))
_BRAKE_GAIN, _BRAKE_LAG = INDEX["log_brake_gain"], INDEX["log_brake_lag"]
_SQUARE, _LAG_RATIO = INDEX["square_period"], INDEX["log_lag_ratio"]
_JERK, _FALL = INDEX["inverse_jerk"], INDEX["log_fall"]
_LAG_SLOPE, _GAIN_SLOPE = INDEX["lag_slope"], INDEX["gain_slope"]
_STEP, _RAMP = INDEX["gain_step"], INDEX["gain_ramp"]
_DEPTH, _DURATION, _HYSTERESIS = INDEX["shift_depth"], INDEX["shift_duration"], INDEX["shift_hysteresis"]
_RING_A, _RING_Q = INDEX["ring_amplitude"], INDEX["ring_quadrature"]
_RING_F, _RING_Z = INDEX["ring_frequency"], INDEX["ring_damping"]
_FREE, _FREE_F = INDEX["free_pole"], INDEX["free_frequency"]
_DRAG, _WIND, _VISCOUS = INDEX["drag"], INDEX["wind"], INDEX["viscous"]
_ROLL, _CREEP, _CREEP_AT = INDEX["resistance"], INDEX["creep"], INDEX["creep_fades"]
_SPEED_LAG = INDEX["speed_lag"]
_SENSOR_LAG, _SCALE, _BIAS = INDEX["sensor_lag"], INDEX["sensor_scale"], INDEX["sensor_bias"]

_LEAST_FACTOR = 0.05  # as in `effects.speed_dependent_gain`
_FREE_DAMPING = 0.5  # of the unnamed mode: no resonance, which would be a driveline's
_CREEP_OVER = 0.5  # [m/s] as in `effects.low_speed_creep`
_SAME_S = 1e-10  # rows are even but for their rounding
_NEUTRAL = NEUTRAL.copy()
_COUNT = len(NEUTRAL)


@njit(cache=True, fastmath=True, error_model="numpy")
def modes(square: float, T: float, h: float) -> tuple[float, float, float, float]:
    """Transition over `h` of (a - g, tau² a'), `square` = tau² (see `simulator.actuator.modes_over`)."""
    bend = T * T - 4.0 * square
    safe = max(square, 1e-12)
    if abs(bend) * h * h < 4e-4 * square * square:
        x = bend * h * h / (4.0 * safe * safe)
        envelope = math.exp(-h * T / (2.0 * safe))
        C = envelope * (1.0 + x / 2.0 + x * x / 24.0)
        S = envelope * h / safe * (1.0 + x / 6.0 + x * x / 120.0)
    elif bend > 0.0:
        root = math.sqrt(bend)
        slow, fast = math.exp(-2.0 * h / (T + root)), math.exp(-h * (T + root) / (2.0 * safe))
        C, S = 0.5 * (slow + fast), (slow - fast) / root
    else:
        root = math.sqrt(-bend)
        envelope, angle = math.exp(-h * T / (2.0 * safe)), h * root / (2.0 * safe)
        C, S = envelope * math.cos(angle), envelope * 2.0 * math.sin(angle) / root
    half = 0.5 * T * S
    return C + half, S, -square * S, C - half


@njit(cache=True, fastmath=True, error_model="numpy")
def _risen(since: float, ramp: float) -> float:
    """Integral of a rise over `ramp` [s], `since` [s] its begin (see `effects.gain_change`)."""
    within = min(max(since, 0.0), ramp)
    return within * within / (2.0 * ramp) + max(since - ramp, 0.0)


@njit(cache=True, fastmath=True, error_model="numpy")
def _commands(
    p: FloatArray, acts: FloatArray, time: FloatArray, command: FloatArray, starts: BoolArray, out: FloatArray
) -> None:
    """Commands behind saturation, dead band, play and hand-over; `out` (grid,)."""
    K = p[_K_L]
    play, before, since = 0.0, 0.0, -1e9
    for k in range(len(time)):
        t, c = time[k], command[k]
        drive = p[_DRIVE] if t >= acts[_DRIVE] else 0.0
        brake = p[_BRAKE] if t >= acts[_BRAKE] else 0.0
        if drive > 0.0:
            c = min(c, 1.0 / (drive * K))
        if brake > 0.0:
            c = max(c, -1.0 / (brake * K))
        band = p[_BAND] if t >= acts[_BAND] else 0.0
        if band > 0.0:
            c = max(c - band, 0.0) + min(c + band, 0.0)
        width = p[_PLAY] if t >= acts[_PLAY] else 0.0
        play = c if starts[k] or width <= 0.0 else max(c - width, min(c + width, play))
        c = play
        if starts[k]:
            before, since = 0.0, -1e9
        if c * before < 0.0:
            since = t
        if c != 0.0:
            before = c
        pause = p[_PAUSE] if t >= acts[_PAUSE] else 0.0
        if pause > 0.0 and k + 1 < len(time):
            c *= 1.0 - min(max((since + pause - t) / (time[k + 1] - t), 0.0), 1.0)
        out[k] = c


@njit(cache=True, fastmath=True, error_model="numpy")
def simulate(
    p: FloatArray,
    acts: FloatArray,
    time: FloatArray,
    command: FloatArray,
    speed: FloatArray,
    starts: BoolArray,
    accel0: FloatArray,
    shift_speeds: FloatArray,
    reference_speed: float,
    accel: FloatArray,
    gained: FloatArray,
) -> None:
    """Readings of the acceleration, `accel` (grid,) [m/s²], and of the speed `gained` (grid,) [m/s] in its stretch.

    `p` (parameter,) values, `acts` (parameter,) the times [s] from which they act; `time`, `command`, `speed`, `starts`
    (grid,): steps, held commands, the speed that effects read, and where stretches start; `accel0` (grid,): the car's
    acceleration there. `shift_speeds` (gear,) [m/s]; `reference_speed` [m/s], at which slopes are neutral.
    """
    n = len(time)
    sent = np.empty(n)
    _commands(p, acts, time, command, starts, sent)
    q = p.copy()
    gears = len(shift_speeds)
    ramp = math.exp(p[_RAMP])
    above = np.zeros(gears, np.bool_)
    since = np.full(gears, -1e9)
    a = w = slewed = ring_y = ring_r = free_y = free_r = reading = v_gained = v_reading = v_shown = 0.0
    force = before_shown = 0.0
    first = 0
    k1 = 0
    # of each part of a step: its transition, and the lag and length that it is of
    keep, m00, m01, m10, m11 = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    of_T, of_length, of_square = np.full(2, -1.0), np.full(2, -1.0), np.full(2, -1.0)
    r00 = r01 = r10 = r11 = f00 = f01 = f10 = f11 = 0.0
    ring_h = -1.0
    s_keep = s_old = s_new = s_h = s_lag = -1.0
    until = -1.0
    up_limit = down_limit = slower = brake_gain = brake_lag = 1.0
    for k in range(n):
        t, v = time[k], max(speed[k], 0.0)
        if k == 0 or starts[k] or t >= until:  # what acts changes at onsets alone
            until = 1e300
            for j in range(_COUNT):
                q[j] = p[j] if t >= acts[j] else _NEUTRAL[j]
                if acts[j] > t:
                    until = min(until, acts[j])
            up_limit = 1.0 / q[_JERK] if q[_JERK] > 1e-9 else 1e9
            down_limit = up_limit * math.exp(q[_FALL])
            slower, brake_gain, brake_lag = math.exp(q[_LAG_RATIO]), math.exp(q[_BRAKE_GAIN]), math.exp(q[_BRAKE_LAG])
        # body forces at this row
        air = v + p[_WIND]
        outer = -q[_DRAG] * air * abs(air) - q[_VISCOUS] * v
        if v > 0.0:
            outer -= q[_ROLL]
        if q[_CREEP] != 0.0:
            outer += q[_CREEP] / (1.0 + math.exp((v - p[_CREEP_AT]) / _CREEP_OVER))
        if starts[k]:
            a = accel0[k] - outer
            w = 0.0
            slewed = a
            ring_y = ring_r = free_y = free_r = 0.0
            v_gained = 0.0
            first = k
            k1 = k
            for g in range(gears):
                above[g] = v > shift_speeds[g]
                since[g] = -1e9
        total = outer
        if q[_RING_A] != 0.0 or q[_RING_Q] != 0.0:
            total += q[_RING_A] * ring_y + q[_RING_Q] * ring_r
        if p[_FREE] != 0.0:
            total += p[_FREE] * 2.0 * math.pi * p[_FREE_F] * free_r
        if not starts[k]:
            v_gained += 0.5 * (time[k] - time[k - 1]) * (force + total)
        force = total
        # sensor
        shown = a + total
        if starts[k] or q[_SENSOR_LAG] <= 1e-9:
            reading = shown
        else:
            h = time[k] - time[k - 1]
            if abs(h - s_h) > _SAME_S or q[_SENSOR_LAG] != s_lag:
                s_h, s_lag = h, q[_SENSOR_LAG]
                s_keep = math.exp(-h / s_lag)
                held = -s_lag / h * math.expm1(-h / s_lag)
                s_old, s_new = held - s_keep, 1.0 - held
            reading = s_keep * reading + s_old * before_shown + s_new * shown
        before_shown = shown
        accel[k] = (1.0 + q[_SCALE]) * reading + q[_BIAS]
        if starts[k] or q[_SPEED_LAG] <= 1e-9:
            v_reading = v_gained
        else:
            h = time[k] - time[k - 1]
            decay = math.expm1(-h / q[_SPEED_LAG])
            held = -q[_SPEED_LAG] / h * decay
            v_reading = (1.0 + decay) * v_reading + (held - 1.0 - decay) * v_shown + (1.0 - held) * v_gained
        v_shown = v_gained
        gained[k] = v_reading
        if k == n - 1 or starts[k + 1]:
            continue
        h = time[k + 1] - t
        # gears
        lost = 0.0
        if p[_DEPTH] > 0.0:  # gears change before an onset, too
            for g in range(gears):
                s = shift_speeds[g]
                if v > s and not above[g]:
                    rise = v - speed[k - 1] if k > first else 0.0
                    share = min(max((v - s) / rise, 0.0), 1.0) if rise > 0.0 else 0.0
                    since[g] = t + (1.0 - share) * h
                    above[g] = True
                above[g] = above[g] and v > s - p[_HYSTERESIS]
                covered = (min(t + h, since[g] + p[_DURATION]) - max(t, since[g])) / h
                lost = max(lost, covered)
        # commands that act in this step: the first one for `h1`, then another
        u1, u2, h1 = sent[k], sent[k], h
        if q[_DELAY] > 0.0:
            arrived = t - q[_DELAY] + 1e-12
            while k1 > first and time[k1] > arrived:
                k1 -= 1
            while k1 < k and time[k1 + 1] <= arrived:
                k1 += 1
            u1 = sent[k1]
            if time[k1] > arrived:  # before the first row
                h1 = min(max(time[k1] - arrived, 0.0), h)
                u2 = sent[k1]
            else:
                h1 = min(max(time[k1 + 1] - arrived, 0.0), h) if k1 < n - 1 else h
                rest = h - h1
                u2 = sent[min(k1 + 1, k)]
                if rest > 0.0 and k1 + 2 <= k:
                    second = min(time[k1 + 2] - time[k1 + 1], rest)
                    u2 = (second * sent[k1 + 1] + (rest - second) * sent[min(k1 + 2, k)]) / rest
        # gain and lag
        gain, lag = q[_K_L], q[_T_L]
        if q[_GAIN_SLOPE] != 0.0:
            gain *= max(1.0 + q[_GAIN_SLOPE] * (v / reference_speed - 1.0), _LEAST_FACTOR)
        if q[_LAG_SLOPE] != 0.0:
            lag *= max(1.0 + q[_LAG_SLOPE] * (v / reference_speed - 1.0), _LEAST_FACTOR)
        lag *= slower
        if p[_STEP] != 0.0 and t + h > acts[_STEP]:
            begun = max(acts[_STEP], t - 1.0 - ramp)  # long ago is whole, and keeps its digits
            gain *= 1.0 + p[_STEP] * (_risen(t + h - begun, ramp) - _risen(t - begun, ramp)) / h
        if q[_DEPTH] > 0.0 and lost > 0.0 and u2 > 0.0:
            gain *= 1.0 - q[_DEPTH] * lost
        before = a
        for part in range(2):
            c = u1 if part == 0 else u2
            length = h1 if part == 0 else h - h1
            if length <= 0.0:
                continue
            target, T = gain * c, lag
            if c < 0.0:
                target *= brake_gain
                T *= brake_lag
            other = of_T[part] != T or abs(length - of_length[part]) > _SAME_S
            if q[_SQUARE] > 0.0:
                if q[_JERK] > 1e-9:
                    d = target - slewed
                    jerk_limit = up_limit if d > 0.0 else down_limit
                    moving = min(abs(d) / jerk_limit, length)
                    after = slewed + max(min(d, jerk_limit * length), -jerk_limit * length)
                    missed = moving * 0.5 * (d + target - after) + (length - moving) * (target - after)
                    slewed = after
                    target -= missed / length
                if other or of_square[part] != q[_SQUARE]:
                    m00[part], m01[part], m10[part], m11[part] = modes(q[_SQUARE], T, length)
                    of_T[part], of_length[part], of_square[part] = T, length, q[_SQUARE]
                d = a - target
                after, swing = target + m00[part] * d + m01[part] * w, m10[part] * d + m11[part] * w
                v_gained += target * length - T * (after - a) - (swing - w)
                a, w = after, swing
            elif q[_JERK] > 1e-9:
                d = target - a
                jerk_limit = up_limit if d > 0.0 else down_limit
                at_limit = min(max(abs(d) / jerk_limit - T, 0.0), length)
                cut = math.copysign(jerk_limit * at_limit, d)
                rest = length - at_limit
                left = d - cut
                decay = math.expm1(-rest / T)
                v_gained += (a + 0.5 * cut) * at_limit + rest * target + T * decay * left
                a = target - left * (1.0 + decay)
            else:
                if other or of_square[part] != 0.0:
                    keep[part] = math.exp(-length / T)
                    of_T[part], of_length[part], of_square[part] = T, length, 0.0
                after = target + keep[part] * (a - target)
                v_gained += target * length - T * (after - a)
                a = after
        # modes that the actuator's jerk excites
        if p[_RING_A] != 0.0 or p[_RING_Q] != 0.0 or p[_FREE] != 0.0:
            if abs(h - ring_h) > _SAME_S:
                ring_h = h
                omega, damping = 2.0 * math.pi * p[_RING_F], p[_RING_Z]
                r00, r01, r10, r11 = modes(1.0 / (omega * omega), 2.0 * damping / omega, h)
                r01, r10 = r01 / omega, omega * r10
                omega = 2.0 * math.pi * p[_FREE_F]
                f00, f01, f10, f11 = modes(1.0 / (omega * omega), 2.0 * _FREE_DAMPING / omega, h)
                f01, f10 = f01 / omega, omega * f10
            j = (a - before) / h
            if q[_RING_A] != 0.0 or q[_RING_Q] != 0.0:  # at its onset a mode is at rest
                omega = 2.0 * math.pi * p[_RING_F]
                y = r00 * ring_y + r01 * ring_r + (1.0 - r00) / omega * j
                ring_r = r10 * ring_y + r11 * ring_r - r10 / omega * j
                ring_y = y
            omega = 2.0 * math.pi * p[_FREE_F]
            y = f00 * free_y + f01 * free_r + (1.0 - f00) / omega * j
            free_r = f10 * free_y + f11 * free_r - f10 / omega * j
            free_y = y


@njit(cache=True, fastmath=True, error_model="numpy")
def read_late(rows: FloatArray, time: FloatArray, values: FloatArray, delay: float, out: FloatArray) -> None:
    """`values` (grid,) of `time` read at `rows - delay` (row,), linear between grid points and held at the ends."""
    k, last = 0, len(time) - 1
    for i in range(len(rows)):
        x = rows[i] - delay
        while k + 1 < last and time[k + 1] <= x:
            k += 1
        while k > 0 and time[k] > x:
            k -= 1
        share = (x - time[k]) / (time[k + 1] - time[k])
        share = min(max(share, 0.0), 1.0)
        out[i] = values[k] + share * (values[k + 1] - values[k])
