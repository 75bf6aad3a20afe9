"""The pages of the commands beside `diagnose`, each of a small answer with every section."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

import avtorch
from avtorch.external.compare_simulators import Difference, ErrorsOfTwo, SimulatorComparison
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.comparison import Change, ChangeCause, ChangePart, Comparison
from avtorch.gap.result.log_facts import LogFacts
from avtorch.inference import SamplerSettings
from avtorch.report import Origin
from avtorch.report.comparison import comparison_html
from avtorch.report.estimates import estimates_html
from avtorch.report.run import run_html
from avtorch.report.validation import validation_html
from avtorch.results import estimates_answer
from avtorch.validation import NutsSettings, synthetic_windows, validate
from tests.report.conftest import HOSTILE

ORIGIN = Origin("avtorch estimate lap.csv", {"lap.csv": "0" * 64}, "1" * 64)
DRIVE: Mapping[str, Any] = {"start": 30.0, "duration": 40.0, "dt": 0.05}


def log() -> avtorch.Log:
    """Of a car with a lag of 0.9 s, by a name that would be markup."""
    drive = avtorch.simulate(avtorch.Leader.default(**DRIVE), plant=avtorch.GLVDPlant(0.9, 0.7, sigma=0.1)).log()
    return replace(drive, name=HOSTILE)


def estimates() -> str:
    drive = log()
    return estimates_html(avtorch.estimate(drive, 4.0, estimator="map"), drive, notes=["2 rows masked"], origin=ORIGIN)


def run() -> str:
    """Alerts of every window, of which two were acted upon."""
    drive = log()
    answer = estimates_answer(avtorch.estimate(drive, 4.0, estimator="map"))
    windows = answer["windows"]
    alerts = [{"time_s": w["end_s"], "detector": "stability", "why": "P(string stable) is 0.02"} for w in windows[2:]]
    settings = [avtorch.Setting(time_gap=gap).as_dict() for gap in (1.0, 1.6, 2.5)]
    actions = [
        {
            "time_s": windows[i]["end_s"],
            "strategies": strategies,
            "settings": setting,
            "why": "the best one",
            "p_string_stable": 0.98,
            "peak_gain_true": 1.01,
        }
        for i, strategies, setting in ((3, [1], settings[1]), (5, [1, 2, 3], settings[2]))
    ]
    measures = {"speed_rms_ratio": 0.97, "min_spacing_m": 4.5, "min_ttc_s": None, "throughput_vph": 1113.0}
    both = {"without_action": measures | {"speed_rms_ratio": 1.08, "min_spacing_m": -0.1}, "with_action": measures}
    answer |= {"alerts": alerts, "actions": actions, "performance": both}
    answer["change"] = {"time_s": 10.0, "T_L": 0.9, "K_L": 0.7}
    truth = {"T_L": [(0.0, 0.3), (10.0, 0.9)], "K_L": [(0.0, 1.0), (10.0, 0.7)]}
    assert drive.lead_accel is not None
    assert drive.accel is not None
    lines = {"leader": drive.lead_accel, "without action": drive.accel, "with action": 0.9 * drive.accel}
    some = np.random.default_rng(0).normal([[0.3], [1.0]], 0.02, (2, 100))
    now = np.random.default_rng(1).normal([[0.9], [0.7]], 0.05, (2, 100))
    clouds = {"belief before the change": (some[0], some[1]), "belief at the end": (now[0], now[1])}
    named = [("as built", settings[0]), ("after the action at 24 s", settings[2])]
    return run_html(
        answer,
        drive.elapsed,
        {"speed": lines, "accel": lines},
        truth=truth,
        bounds={"T_L": (0.1, 0.4), "K_L": (0.7, 1.0)},
        regions=(named, clouds),
        origin=ORIGIN,
    )


def about(mean: float, share: float = 0.1) -> Quantity:
    return Quantity(mean, 0.5 * share * mean, (1 - share) * mean, (1 + share) * mean)


def compared(**more: Any) -> Comparison:
    """A car that has changed by several things, with aliases."""
    moved = lambda before, after: Change(about(before), about(after), about(after / before))  # noqa: E731
    parts = (
        ChangePart(
            "T_L", ("T_L", "dead_time"), 0.97, {side: about(0.5) for side in ("before_s", "after_s", "change_s")}
        ),
        ChangePart("sensor_bias", ("sensor_bias",), 0.9, {"accel_mps2": about(0.2)}, less=True),
    )
    facts = LogFacts(rows=3000, segments=1, seconds=300.0, rate_hz=10.0, name=HOSTILE)
    found = Comparison(
        before=facts,
        after=replace(facts, name="after.csv"),
        car={"T_L": moved(0.3, 1.0), "K_L": moved(1.0, 0.98)},
        gap={"rollout_rmse_accel": moved(0.01, 0.6), "rollout_rmse_speed": moved(0.02, 2.2)},
        p_value=1e-9,
        changed=True,
        simulator="farther",
        why="The car has changed: T_L 0.30 to 1.00 s (p = 1e-09).",
        cause=ChangeCause(parts, "ambiguous", {"T_L": 0.1, "dead_time": float("inf")}, "What explains it: T_L."),
    )
    return replace(found, **more)


def comparison() -> str:
    return comparison_html(compared(), notes=[f"{HOSTILE}: 3000 rows"], origin=ORIGIN)


def simulators() -> str:
    names: Any = [SimpleNamespace(name=name, notes=("Its output is late.",)) for name in (HOSTILE, "car.fmu")]
    errors = {
        metric: ErrorsOfTwo(about(0.5), about(0.5 * x), about(x))
        for metric, x in (("rollout_rmse_accel", 1.3), ("rollout_rmse_speed", 1.2))
    }
    differences = (
        Difference("dead_time", None, {"delay_s": 0.2}, about(0.8), ("dead_time",)),
        Difference("others", None, None, about(0.99), ("gust", "rate_limit")),
    )
    found = SimulatorComparison(
        log=LogFacts(rows=900, segments=1, seconds=90.0, rate_hz=10.0, name=HOSTILE),
        first=names[0],
        second=names[1],
        errors=errors,
        ratio=about(1.25),
        p_first=0.999,
        p_second=0.0,
        level=0.04,
        blocks=9,
        horizon_s=10.0,
        differences=differences,
    )
    return comparison_html(found, notes=["900 rows"], origin=ORIGIN)


def validation() -> str:
    """Of two windows, one of which NUTS was run on."""
    quick: Any = {"settings": SamplerSettings(chains=64), "nuts": NutsSettings(1, 20, 10), "nuts_windows": 1}
    return validation_html(validate(replace(synthetic_windows(2, seed=1), name=HOSTILE), **quick), origin=ORIGIN)


PAGES: Mapping[str, Callable[[], str]] = {
    "estimates": estimates,
    "run": run,
    "comparison": comparison,
    "simulators": simulators,
    "validation": validation,
}
