"""Forces on the body besides the actuator's: air, road, resistance, creep, gusts, and the driveline's mode."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from benchmarks.blindtest.car import STEP_S
from benchmarks.blindtest.command import Parameters

GRAVITY = 9.81
_GRID_M = 4.0  # of profiles over distance

Force = Callable[[float, float, float], float]
Streams = Callable[[str], np.random.Generator]
"""Random streams by effect name: an effect draws the same numbers whatever other effects the car has."""


def forces(effects: Parameters, rng: Streams, *, reach: float) -> list[Force]:
    """`force(speed, position, time)` [m/s²] of each state-dependent effect; `reach` [m]: length of the drive."""
    return [make(effects[name], rng(name), reach) for name, make in _FORCES.items() if name in effects]


def coloured(rng: np.random.Generator, steps: int, sd: float, memory: float, step: float = STEP_S) -> FloatArray:
    """A stationary Ornstein-Uhlenbeck process, (step,), of standard deviation `sd` and time constant `memory` [s]."""
    stay = math.exp(-step / memory)
    draws = rng.standard_normal(steps)
    draws[1:] *= math.sqrt(-math.expm1(-2 * step / memory))
    return sd * np.asarray(lfilter([1.0], [1.0, -stay], draws))


def profile(rng: np.random.Generator, reach: float, length: float) -> FloatArray:
    """A smooth random profile over distance, of unit variance and correlation length `length` [m], every 4 m."""
    points = int(reach / _GRID_M) + 2
    width = length / _GRID_M
    half = int(4 * width)
    kernel = np.exp(-((np.arange(-half, half + 1) / width) ** 2))
    kernel /= np.linalg.norm(kernel)
    return np.convolve(rng.standard_normal(points + 2 * half), kernel, mode="valid")


def along(values: FloatArray) -> Callable[[float], float]:
    """A profile as a function of position [m]: linear between its points, constant beyond the last."""
    table, last = values.tolist(), len(values) - 2

    def at(position: float) -> float:
        place = position / _GRID_M
        i = min(max(int(place), 0), last)
        return table[i] + (table[i + 1] - table[i]) * (place - i)

    return at


def driveline(p: Mapping[str, float]) -> Callable[[float], float]:
    """`step(change of the actuator's acceleration)`: acceleration of the shaft's torsional mode 1 ms later [m/s²].

    A lightly damped mode excited by jerk, solved exactly between impulses of jerk.
    """
    omega, zeta, amplitude = 2 * math.pi * p["frequency_hz"], p["damping_ratio"], p["amplitude"]
    damped, decay = omega * math.sqrt(1 - zeta**2), math.exp(-zeta * omega * STEP_S)
    turn = decay * complex(math.cos(damped * STEP_S), math.sin(damped * STEP_S))
    state = 0j

    def step(change: float) -> float:
        nonlocal state
        state = turn * (state + amplitude * change)
        return state.imag

    return step


def _drag(p: Mapping[str, float], rng: np.random.Generator, reach: float) -> Force:
    c, wind, swing = p["drag_per_m"], p["wind_mps"], p["wind_swing_mps"]
    pace, phase = 2 * math.pi / p["wind_period_s"], float(rng.uniform(0, 2 * math.pi))

    def drag(speed: float, position: float, time: float) -> float:
        air = speed + wind + swing * math.sin(pace * time + phase)
        return -c * air * abs(air)

    return drag


def _grade(p: Mapping[str, float], rng: np.random.Generator, reach: float) -> Force:
    slope = along(p["grade_rms"] * profile(rng, reach, p["length_m"]))

    def grade(speed: float, position: float, time: float) -> float:
        rise = slope(position)
        return -GRAVITY * rise / math.sqrt(1 + rise * rise)

    return grade


def _resistance(p: Mapping[str, float], rng: np.random.Generator, reach: float) -> Force:
    r = p["resistance_mps2"]
    return lambda speed, position, time: -r * min(1.0, speed / 0.3)


def _viscous(p: Mapping[str, float], rng: np.random.Generator, reach: float) -> Force:
    share = p["drag_per_s"]
    return lambda speed, position, time: -share * speed


def _creep(p: Mapping[str, float], rng: np.random.Generator, reach: float) -> Force:
    push, ends = p["creep_mps2"], p["ends_mps"]

    def creep(speed: float, position: float, time: float) -> float:
        # a torque converter: its push falls with the square of the speed ratio
        return push * (1 - (speed / ends) ** 2) if speed < ends else 0.0

    return creep


def _curve_drag(p: Mapping[str, float], rng: np.random.Generator, reach: float) -> Force:
    """Cornering drag: tyre forces in a curve brake with the square of the lateral acceleration."""
    share = p["drag_at_3mps2"]
    bend = along(np.maximum(np.abs(profile(rng, reach, 60.0)) - 0.8, 0.0))
    quick = p["reference_speed_mps"]

    def drag(speed: float, position: float, time: float) -> float:
        lateral = min(1.5, bend(position) * (speed / quick) ** 2)
        return -share * lateral * lateral

    return drag


def _hunting(p: Mapping[str, float], rng: np.random.Generator, reach: float) -> Force:
    size, pace, phase = p["amplitude_mps2"], 2 * math.pi * p["frequency_hz"], float(rng.uniform(0, 2 * math.pi))
    return lambda speed, position, time: size * math.sin(pace * time + phase)


_FORCES = {
    "aerodynamic_drag": _drag,
    "road_grade": _grade,
    "constant_resistance": _resistance,
    "viscous_drag": _viscous,
    "low_speed_creep": _creep,
    "curve_drag": _curve_drag,
    "hunting": _hunting,
}
