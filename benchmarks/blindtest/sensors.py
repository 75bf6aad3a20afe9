"""From true to logged acceleration and speed: filters at 1 kHz, sensor faults at each row.

Noise is added elsewhere, so that the same chain also gives the readings of a noise-free car.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from benchmarks.blindtest.body import Streams, along, profile
from benchmarks.blindtest.car import STEP_S
from benchmarks.blindtest.command import Parameters

Filter = Callable[[float], float]


def filters(effects: Parameters, start: float, *, speed: bool = False) -> list[Filter]:
    """Filters of the accelerometer [m/s²], or of the `speed` [m/s], that run every millisecond: reading of reading."""
    return [make(effects[name], start) for name, make in (_OF_SPEED if speed else _FILTERS).items() if name in effects]


def _lag(p: Mapping[str, float], start: float) -> Filter:
    share, state, last = -math.expm1(-STEP_S / p["lag_s"]), start, start

    def lag(a: float) -> float:
        nonlocal state, last
        state += share * (0.5 * (a + last) - state)
        last = a
        return state

    return lag


def _pitch(p: Mapping[str, float], start: float) -> Filter:
    """Body pitch follows changes of acceleration; the sensor measures the resulting component of gravity."""
    omega, zeta = 2 * math.pi * p["frequency_hz"], 0.25
    damped, decay = omega * math.sqrt(1 - zeta**2), math.exp(-zeta * omega * STEP_S)
    turn = decay * complex(math.cos(damped * STEP_S), math.sin(damped * STEP_S))
    state, last, amplitude = 0j, start, p["amplitude"]

    def nod(a: float) -> float:
        nonlocal state, last
        state = turn * (state + amplitude * (a - last))
        last = a
        return a + state.imag

    return nod


_FILTERS = {"pitch_coupling": _pitch, "sensor_lag": _lag}
_OF_SPEED = {"speed_lag": _lag}


class Readings:
    """A row's noise-free readings from the millisecond grid.

    Args: `effects`; `rng` by name; `reach` [m] and `seconds` of the drive; `onset` [s], from which drifts grow.
    """

    def __init__(self, effects: Parameters, rng: Streams, *, reach: float, seconds: float, onset: float) -> None:
        self._scale = effects.get("sensor_scale", {}).get("scale", 1.0)
        self._bias = effects.get("sensor_bias", {}).get("bias_mps2", 0.0)
        self._clock = effects.get("clock_drift")
        self._slip = effects.get("wheel_slip")
        self._tyre = effects.get("tyre_radius")
        self._hum = effects.get("vibration_aliasing")
        self._slippery = along(profile(rng("wheel_slip"), reach, 90.0)) if self._slip else None
        self._phase = float(rng("vibration_aliasing").uniform(0, 2 * math.pi))
        self._seconds, self._onset = seconds, onset

    def lateness(self, time: float) -> float:
        """Age of the readings [s]: 0 unless the sensors' clock drifts; the drift is reset at intervals."""
        if self._clock is None:
            return 0.0
        period = self._clock["reset_s"]
        return self._clock["drift_s"] * (((time - self._onset) % period) / period)

    def accel(self, a: float, position: float, time: float) -> float:
        """Reading for the filtered acceleration `a` [m/s²]."""
        if self._hum is not None:
            # engine order: its frequency rises with speed and exceeds the log's Nyquist frequency
            turns = self._hum["turns_per_m"] * position + self._hum["idle_hz"] * time
            a += self._hum["amplitude_mps2"] * math.sin(2 * math.pi * turns + self._phase)
        return self._scale * a + self._bias

    def speed(self, v: float, a: float, position: float, time: float) -> float:
        """Reading for the true speed `v` [m/s]."""
        if self._slip is not None and self._slippery is not None:
            grip = self._slippery(position)
            v += self._slip["slip_s"] * a * min(1.0, max(0.0, grip + 0.2))
        if self._tyre is not None:
            v *= 1 + self._tyre["growth"] * (time - self._onset) / (self._seconds - self._onset)
        return v
