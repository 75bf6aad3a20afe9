"""What a live watch assumes of every car, checked once."""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from avtorch.decision.monitor import DEFAULT_DETECTORS, Monitor
from avtorch.decision.settings import Setting
from avtorch.decision.watch import Watch
from avtorch.errors import InputError
from avtorch.inference.form import Form, JerkForm
from avtorch.inference.latent import LatentForm
from avtorch.inference.stream import BeliefStream
from avtorch.vehicle.controllers import NOMINAL_GAINS

FormName = Literal["auto", "jerk", "latent"]
MOST_ROWS = 20_000
"""Rows of one car in a window; more are refused, so that a sender gone mad fills no memory."""


@dataclass(frozen=True)
class LiveSettings:
    """Settings of a live watch, the same for all cars.

    `window` [s]; `form` "jerk" (measured jerk and accel), "latent", or "auto": "jerk" for a car whose first row has
    both; `estimator` and `mode` as in `estimate`, "auto" being "map" for the jerk form and "importance" for the latent
    one, whose modes are dear; `time_gap` [s] and `gains` (k_s [1/s²], k_v [1/s], k_a [-]) of the controller; `accepted`
    (T_L [s], K_L [-]) of a sound car; `detectors`; `lateness` [s] by which a row may come behind newer ones; `cars` at
    most; `check_units`: refuse columns that contradict each other; `seed`.

    Raises `InputError` for numbers out of range.
    """

    window: float = 2.0
    form: FormName = "auto"
    estimator: str = "auto"
    mode: str = "lambda"
    time_gap: float = 1.0
    gains: tuple[float, float, float] = NOMINAL_GAINS
    accepted: tuple[float, float] = (0.3, 1.0)
    detectors: tuple[str, ...] = DEFAULT_DETECTORS
    lateness: float = 0.05
    cars: int = 1000
    check_units: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.window) and self.window > 0):
            raise InputError(f"window: found {self.window:g} s, needs a finite number above 0")
        if not (math.isfinite(self.lateness) and 0 <= self.lateness <= 10 * self.window):
            raise InputError(f"lateness: found {self.lateness:g} s, needs 0 or more, and at most ten windows")
        if self.cars < 1:
            raise InputError(f"cars: found {self.cars}, needs 1 or more")
        if self.form not in ("auto", "jerk", "latent"):
            raise InputError(f"form: found {self.form!r}, needs 'auto', 'jerk' or 'latent'")
        self.setting()
        self.watch("", JerkForm() if self.form != "latent" else LatentForm(accel=True, speed=True))

    def setting(self) -> Setting:
        """The controller of a car."""
        return Setting(time_gap=self.time_gap, gains=self.gains, scenarios=1)

    def form_of(self, signals: set[str]) -> Form | None:
        """The form for a car with these signals; None where they do not suffice."""
        if "accel_cmd" not in signals:
            return None
        if self.form != "latent" and {"accel", "jerk"} <= signals:
            return JerkForm()
        if self.form == "jerk" or not signals & {"accel", "speed"}:
            return None
        return LatentForm(accel="accel" in signals, speed="speed" in signals)

    def watch(self, car: str, form: Form) -> Watch:
        """A new watch of one car. Its seed follows from the car's name, and so not from the order of cars."""
        digest = hashlib.sha256(f"{self.seed}/{car}".encode()).digest()
        options: dict[str, Any] = {"seed": int.from_bytes(digest[:6], "big"), "check_units": self.check_units}
        estimator = self.estimator
        if estimator == "auto":
            estimator = "map" if isinstance(form, JerkForm) else "importance"
        if estimator in ("sgld", "map", "importance"):
            options["mode"] = self.mode
        stream = BeliefStream(window=self.window, form=form, estimator=estimator, **options)
        return Watch(stream, Monitor(accepted=self.accepted, detectors=self.detectors))

    def to_dict(self) -> dict[str, str]:
        """By name, as text: what a state belongs to. The number of cars may change."""
        return {name: str(value) for name, value in asdict(self).items() if name != "cars"}
