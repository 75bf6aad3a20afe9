"""Powertrain and brake: torque map, limits, gears and lags.

Positive demand passes the engine path, negative demand the brake path. Each path is a first-order lag and the
acceleration is their sum, which is GLVD where the lags are equal. A first-order lag is integrated exactly over each
millisecond, a second-order one by fourth-order Runge-Kutta.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from benchmarks.blindtest.car import STEP_S, Car
from benchmarks.blindtest.command import Parameters

Step = Callable[[float, float, float], float]
Factor = Callable[[float, float, float], float]


def actuator(car: Car, effects: Parameters, start: float) -> Step:
    """Return `step(command, speed, time)`, which advances the actuator by 1 ms and returns its acceleration [m/s²].

    `start`: the initial acceleration [m/s²].
    """
    shape = [make(effects[name]) for name, make in _TARGETS.items() if name in effects]
    lags = [make(effects[name]) for name, make in _LAGS.items() if name in effects]
    dynamics = {"brake_throttle_asymmetry", "second_order_actuator", "rate_limit"} & effects.keys()
    gain, decay = car.K_L, -math.expm1(-STEP_S / car.T_L)
    if lags or dynamics:
        return _paths(car, effects, start, shape, lags)
    state = start

    def step(command: float, speed: float, time: float) -> float:
        nonlocal state
        target = gain * command
        for stage in shape:
            target = stage(target, speed, time)
        state += decay * (target - state)
        return state

    return step


def _paths(car: Car, effects: Parameters, start: float, shape: list[Factor], lags: list[Factor]) -> Step:
    """The general actuator: two paths, or one second-order servo, with a rate limit."""
    brake = effects.get("brake_throttle_asymmetry", {})
    brake_gain, brake_lag = brake.get("brake_gain_ratio", 1.0), brake.get("brake_lag_ratio", 1.0)
    limit = effects.get("rate_limit", {})
    rise = limit.get("jerk_max_mps3", math.inf) * STEP_S
    fall = rise * limit.get("fall_ratio", 1.0)
    servo = effects.get("second_order_actuator")
    engine, pads, rate = max(start, 0.0), min(start, 0.0), 0.0

    def step(command: float, speed: float, time: float) -> float:
        nonlocal engine, pads, rate
        target = car.K_L * command
        for stage in shape:
            target = stage(target, speed, time)
        stretch = 1.0
        for lag in lags:
            stretch *= lag(target, speed, time)
        # brake pressure builds up with the brake's own lag and is released as fast as the engine responds
        slow = brake_lag if target < 0 else 1.0
        if target < 0:
            target *= brake_gain
        if servo is not None:
            now = engine + pads
            new, rate = _servo(now, rate, target, servo, STEP_S / (stretch * slow))
            change = new - now
            if not -fall <= change <= rise:
                change = rise if change > 0 else -fall
                rate = change / STEP_S * stretch * slow
            engine, pads = now + change, 0.0
            return engine
        quick = -math.expm1(-STEP_S / (car.T_L * stretch))
        late = quick if slow == 1.0 else -math.expm1(-STEP_S / (car.T_L * stretch * slow))
        up = quick * (max(target, 0.0) - engine)
        down = late * (min(target, 0.0) - pads)
        if not -fall <= up + down <= rise:
            # the rate limit applies to the sum of both paths; their states are reset to match the limited sum
            now = engine + pads + (rise if up + down > 0 else -fall)
            engine, pads = max(now, 0.0), min(now, 0.0)
            return now
        engine += up
        pads += down
        return engine + pads

    return step


def _servo(a: float, rate: float, target: float, p: Mapping[str, float], h: float) -> tuple[float, float]:
    """Acceleration and its rate after `h` [s] of a second-order servo (Runge-Kutta, fourth order)."""
    square, damp = p["natural_frequency_radps"] ** 2, 2 * p["damping_ratio"] * p["natural_frequency_radps"]
    k1, l1 = rate, square * (target - a) - damp * rate
    k2 = rate + 0.5 * h * l1
    l2 = square * (target - a - 0.5 * h * k1) - damp * k2
    k3 = rate + 0.5 * h * l2
    l3 = square * (target - a - 0.5 * h * k2) - damp * k3
    k4 = rate + h * l3
    l4 = square * (target - a - h * k3) - damp * k4
    return a + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), rate + h / 6 * (l1 + 2 * l2 + 2 * l3 + l4)


# Factors on the target acceleration, in the order of the chain.


def _speed_gain(p: Mapping[str, float]) -> Factor:
    slope, middle = p["gain_slope"], p["reference_speed_mps"]
    return lambda target, speed, time: target * max(0.15, 1 + slope * _map(speed, middle))


def _map(speed: float, middle: float) -> float:
    """Position in speed on a torque map: (v - v̄)/v̄ near v̄, slightly flatter far from it, as in real maps."""
    z = (speed - middle) / middle
    return z / math.sqrt(1 + 0.15 * z * z)


def _hand_over(p: Mapping[str, float]) -> Factor:
    """Engine and brake take turns, and neither acts while the turn changes."""
    pause, side, waits = p["pause_s"], 0.0, -math.inf

    def change(target: float, speed: float, time: float) -> float:
        nonlocal side, waits
        if target * side < 0:
            waits = time + pause
        side = target or side
        return target if time >= waits else 0.0

    return change


def _gain_change(p: Mapping[str, float]) -> Factor:
    ratio, when, takes = p["gain_ratio"], p["change_s"], p["takes_s"]

    def change(target: float, speed: float, time: float) -> float:
        if time <= when:
            return target
        return target * (ratio if time >= when + takes else 1 + (ratio - 1) * (time - when) / takes)

    return change


def _saturation(p: Mapping[str, float]) -> Factor:
    high, low = p["accel_max_mps2"], p["accel_min_mps2"]

    def limit(target: float, speed: float, time: float) -> float:
        # a smooth knee of 4 % of the limit: torque saturates gradually
        if target > 0.96 * high:
            over = (target - 0.96 * high) / (0.04 * high)
            return high * (0.96 + 0.04 * (1 - math.exp(-over)))
        if target < 0.96 * low:
            over = (target - 0.96 * low) / (0.04 * low)
            return low * (0.96 + 0.04 * (1 - math.exp(-over)))
        return target

    return limit


def _gear_shift(p: Mapping[str, float]) -> Factor:
    """The drive is interrupted while the gear changes: the clutch opens and closes in a fifth of that time each."""
    depth, lasts = p["depth"], p["duration_s"]
    shifts = [p["first_shift_mps"] * p["shift_ratio"] ** i for i in range(6)]
    gear: int | None = None
    began = -math.inf

    def interrupt(target: float, speed: float, time: float) -> float:
        nonlocal gear, began
        if gear is None:
            gear = sum(speed > shift for shift in shifts)
        if gear < 6 and speed > shifts[gear]:
            gear, began = gear + 1, time
        elif gear > 0 and speed < 0.88 * shifts[gear - 1]:
            gear, began = gear - 1, time
        since = time - began
        if since >= lasts or target <= 0:
            return target
        return target * (1 - depth * min(1.0, 5 * since / lasts, 5 * (lasts - since) / lasts))

    return interrupt


def _turbo_lag(p: Mapping[str, float]) -> Factor:
    """Full torque needs boost, which builds up slowly under demand and is lost faster than it builds up."""
    share, spool, boost = p["missing_share"], p["spool_s"], 0.0

    def pull(target: float, speed: float, time: float) -> float:
        nonlocal boost
        wanted = min(1.0, max(target, 0.0))
        boost += STEP_S / (spool if wanted > boost else 0.4 * spool) * (wanted - boost)
        return target * (1 - share * (1 - boost)) if target > 0 else target

    return pull


def _brake_blending(p: Mapping[str, float]) -> Factor:
    """Regeneration brakes first and fades at low speed; friction pads do the rest, weaker and with hysteresis."""
    regen_max, width, weaker = p["regen_mps2"], p["hysteresis_mps2"], p["friction_gain"]
    held = 0.0

    def blend(target: float, speed: float, time: float) -> float:
        nonlocal held
        wanted = max(-target, 0.0)
        regen = min(wanted, regen_max * min(1.0, max(0.0, (speed - 2.0) / 5.0)))
        rest = wanted - regen
        held = min(max(held, rest - width), rest + width)
        return target if wanted == 0.0 and held <= 0.0 else max(target, 0.0) - regen - weaker * max(held, 0.0)

    return blend


def _brake_heat(p: Mapping[str, float]) -> Factor:
    """Brakes lose gain as their work heats them, and recover as they cool."""
    loss, cool, heat = p["loss_when_hot"], p["cooling_s"], 0.0

    def fade(target: float, speed: float, time: float) -> float:
        nonlocal heat
        heat += STEP_S * (max(-target, 0.0) * speed / 150.0 - heat / cool)
        return target / (1 + loss * heat) if target < 0 else target

    return fade


def _abs_cycling(p: Mapping[str, float]) -> Factor:
    """Anti-lock control releases and rebuilds pressure in a cycle while braking exceeds a threshold."""
    depth, above, hertz = p["depth"], p["threshold_mps2"], p["frequency_hz"]

    def cycle(target: float, speed: float, time: float) -> float:
        if target > -above or speed < 2.0:
            return target
        return target * (1 - depth) if (time * hertz) % 1.0 < 0.45 else target

    return cycle


def _speed_lag(p: Mapping[str, float]) -> Factor:
    slope, middle = p["lag_slope"], p["reference_speed_mps"]
    return lambda target, speed, time: max(0.12, 1 + slope * _map(speed, middle))


_TARGETS = {
    "hand_over": _hand_over,
    "speed_dependent_gain": _speed_gain,
    "gain_change": _gain_change,
    "saturation": _saturation,
    "turbo_lag": _turbo_lag,
    "brake_heat": _brake_heat,
    "brake_blending": _brake_blending,
    "abs_cycling": _abs_cycling,
    "gear_shift": _gear_shift,
}
_LAGS = {"speed_dependent_lag": _speed_lag}
