"""Answers for machines: the results of a command, as plain objects ready for JSON."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from avtorch.vehicle import performance, stability

if TYPE_CHECKING:
    from torch import Tensor

    from avtorch.decision.estimation import Estimates
    from avtorch.decision.watch import SupervisedRun, WatchedWindow
    from avtorch.inference import Posterior, Quadrature
    from avtorch.validation import Validation
    from avtorch.vehicle import Block


__all__ = [
    "MEASURES",
    "alert_entries",
    "estimates_answer",
    "finite",
    "run_answer",
    "stability_answer",
    "validation_answer",
    "window_entry",
]

MEASURES = {
    "speed_rms_ratio": "speed RMS, follower / leader [-]",
    "accel_rms_ratio": "acceleration RMS, follower / leader [-]",
    "min_spacing_m": "least spacing [m]",
    "min_ttc_s": "least time to collision [s]",
    "jerk_rms_mps3": "jerk RMS [m/s³]",
    "clipped_share": "share of commands clipped [-]",
    "throughput_vph": "throughput at equilibrium [1/h]",
}
"""What is told of a drive, in words, by its key in `performance` of `run.json`."""


def window_entry(watched: WatchedWindow) -> dict[str, Any]:
    """One window of `estimates.json` and `run.json`, of a single vehicle.

    `excited` is the result of the fixed rule; `used` is also false where an excited window's chains did not settle, and
    the belief was carried over. The jerk form has `sigma` [m/s³], the latent form `noise` with its own parameters.
    """
    window, belief = watched.window, watched.window.belief
    excited, converged = bool(belief.excited[0]), bool(belief.converged[0])
    return {
        "start_s": _seconds(window.start_s),
        "end_s": _seconds(window.end_s),
        "n": int(window.n[0]),
        "excited": excited,
        "used": excited and converged,
        **_by_kind({name: belief.stat(name, 0) for name in belief.names}),
        "alerts": watched.report.names(0),
        "p_string_stable": float(watched.report.p_string_stable[0]),
    }


def _by_kind(stats: Mapping[str, Any]) -> dict[str, Any]:
    """Lag and gain, then sigma, or in the latent form `noise` with its own parameters."""
    if "sigma" in stats:
        return dict(stats)
    actuation = {name: stats[name] for name in ("T_L", "K_L")}
    return {**actuation, "noise": {name: stat for name, stat in stats.items() if name not in actuation}}


def alert_entries(watched: Sequence[WatchedWindow]) -> list[dict[str, Any]]:
    """The alerts of a drive, each at the end of the window that raised it: the moment it could be known."""
    return [
        {"time_s": _seconds(w.window.end_s), "detector": name, "why": w.report.why(name, 0)}
        for w in watched
        for name in w.report.names(0)
    ]


def estimates_answer(estimates: Estimates) -> dict[str, Any]:
    """`estimates.json`: the windows of a log, the results of the quality check, and the assumptions.

    Times are on the log's own clock; `epoch_s` is its first row's.
    """
    # imported here: no other answer needs the estimators, which take a tenth of a second
    from avtorch.inference.estimators.other_posteriors import AGAINST_SGLD

    setting = estimates.setting
    return {
        "schema": "avtorch.estimates/1",
        "epoch_s": estimates.quality.epoch_s,
        "windows": [window_entry(w) for w in estimates.windows],
        "seconds_per_window": estimates.seconds_per_window,
        "form": estimates.form,
        "estimator": estimates.estimator,
        "estimator_note": AGAINST_SGLD if estimates.estimator == "importance" else None,
        "excited_share": estimates.excited_share,
        "spread_over_sd": {name: estimates.spread_ratio(name) for name in ("T_L", "K_L")},
        "alerts": alert_entries(estimates.windows),
        "assumed": {
            "time_gap_s": float(setting.time_gap[0]),
            "gains": setting.gains[0].tolist(),
            "dead_time_s": estimates.dead_time,
            "dead_time_inferred": None if estimates.inferred is None else estimates.inferred.to_dict(),
            "late_channel": None if estimates.late is None else estimates.late.to_dict(),
            "accepted": dict(zip(("T_L", "K_L"), estimates.accepted, strict=True)),
        },
        "quality": estimates.quality.to_dict(),
    }


def run_answer(
    run: SupervisedRun,
    without_action: Block,
    *,
    change: tuple[float, float, float],
    time_gap: float,
) -> dict[str, Any]:
    """`run.json` of a single vehicle; `change` is (time [s], T_L [s], K_L) of the vehicle from then on.

    `without_action` is the same drive under the same noise and the setting it began with, of `time_gap` [s].
    """
    actions = run.actions[0]
    last_gap = float(actions[-1].setting.time_gap[0]) if actions else time_gap
    return {
        "schema": "avtorch.run/1",
        "change": dict(zip(("time_s", "T_L", "K_L"), change, strict=True)),
        "windows": [window_entry(w) for w in run.windows],
        "alerts": [{"time_s": _seconds(a.time_s), "detector": a.detector, "why": a.why} for a in run.alerts[0]],
        "actions": [
            {
                "time_s": _seconds(a.time_s),
                "strategies": a.strategies,
                "settings": a.setting.as_dict(),
                "why": a.why,
                "sufficient": a.sufficient,
                "p_string_stable": a.p_string_stable,
                "peak_gain_true": finite(a.peak_gain_true),
                "driver_delay_s": a.driver_delay_s,
            }
            for a in actions
        ],
        "performance": {
            "without_action": _performance(without_action, time_gap),
            "with_action": _performance(run.rows, last_gap),
        },
    }


def _seconds(time: float) -> float:
    """A time without the round-off of the sum it came from: 35.7, not 35.699999999999996."""
    return round(time, 9)


def _performance(rows: Block, time_gap: float) -> dict[str, Any]:
    """The measures of a drive, and whether it ended in a collision, after which they mean little."""
    return {
        **performance(rows, time_gap=time_gap).row(0),
        "collided": bool(rows.collided[0]),
    }


def finite(value: float | None) -> float | None:
    """JSON has no infinity (the peak gain of an unstable loop, say), so it becomes null."""
    return value if value is not None and math.isfinite(value) else None


def stability_answer(
    T_L: float, K_L: float, time_gap: float, gains: Sequence[float], *, dead_time: float = 0.0
) -> dict[str, Any]:
    """`stability.json`: Eqs. 2 and 3 at one point, the exact verdicts and the peak gain (null where unstable).

    The conditions ignore dead time; the verdicts, the peak and the margin include it.
    """
    setting = (T_L, K_L, time_gap, gains)
    peak = float(stability.peak_gain(*setting, dead_time=dead_time))
    return {
        "schema": "avtorch.stability/1",
        "setting": {"T_L": T_L, "K_L": K_L, "time_gap_s": time_gap, "gains": list(gains), "dead_time_s": dead_time},
        "conditions": {
            "local (Eq. 2)": _at_one_point(stability.local_conditions(*setting)),
            "string, sufficient (Eq. 3)": _at_one_point(stability.string_conditions(*setting)),
        },
        "locally_stable": bool(stability.local_stable(*setting, dead_time=dead_time)),
        "string_stable": bool(stability.string_stable(*setting, dead_time=dead_time)),
        "peak_gain": finite(peak),
        "peak_frequency_radps": float(stability.peak_frequency(*setting, dead_time=dead_time)),
        "dead_time_margin_s": max(0.0, float(stability.dead_time_margin(*setting)) - dead_time),
    }


def _at_one_point(conditions: stability.Conditions) -> dict[str, float]:
    """The conditions of a box shrunk to a point: upper and lower bounds coincide, and so do some of the lines."""
    names = [re.sub(r"\^[ul](?=\b|\s)|^min ", "", name) for name in conditions.names]
    return dict(zip(names, conditions.values.tolist(), strict=True))


def validation_answer(validation: Validation) -> dict[str, Any]:
    """`validation.json`: every window by every method, how far SGLD lies from the reference, and the verdict.

    `summary` holds quantiles over the windows compared: of the absolute difference of means [SD of the reference] and
    of the ratio of SDs. `coverage_90` is the share of windows whose 90 % interval of SGLD covers the truth, with
    quadrature's on the same windows beside it; where the truth is unknown, the mean mass of the reference inside SGLD's
    90 % interval. The latent form has no `sigma`: the summary's is then that of the noise parameter named by
    `sigma_is`, the one that differs most. Seconds of a method that was not run are 0, and `not_run` names it.
    """
    found, windows = validation, validation.windows
    role = {"T_L": "T_L", "K_L": "K_L", "sigma": _noise_shown(found)}
    column = {key: found.names.index(name) for key, name in role.items()}
    coverage = found.coverage()
    share = found.verdict

    def over_windows(values: Tensor, q: float) -> dict[str, float]:
        return {key: float(values[:, i].nanquantile(q).nan_to_num(nan=0.0)) for key, i in column.items()}

    def covered(method: str) -> dict[str, float]:
        return {key: float(coverage[method][i]) for key, i in column.items()}

    agreement = found.agreement
    answer: dict[str, Any] = {
        "schema": "avtorch.validation/1",
        "windows": [
            *_method_entries("sgld", found.sgld, range(len(windows)), found.seconds),
            *_method_entries("quadrature", found.quadrature, range(len(windows)), found.seconds),
            *_method_entries("nuts", found.nuts, found.nuts_index.tolist(), found.seconds),
        ],
        "summary": {
            "windows": len(windows),
            "compared": len(found.compared),
            "excited": int(windows.excited.sum()),
            "settled": int(found.sgld.converged.sum()),
            "mean_difference_sd_p95": over_windows(agreement.mean_difference.abs(), 0.95),
            "sd_ratio_p025": over_windows(agreement.sd_ratio, 0.025),
            "sd_ratio_p975": over_windows(agreement.sd_ratio, 0.975),
            "w1_sd_p95": over_windows(agreement.w1, 0.95),
            "rhat_max": float(agreement.rhat.nan_to_num(nan=-math.inf).amax().clamp_min(1.0)),
            "ess_bulk_median": over_windows(agreement.ess_bulk, 0.5),
            "ess_tail_median": over_windows(agreement.ess_tail, 0.5),
            "coverage_90": covered("sgld"),
            "coverage_is": "truth" if windows.truth is not None else f"mass of {found.reference}",
            "seconds_per_window": found.seconds,
            "not_run": [] if found.quadrature is not None else ["quadrature"],
            "sigma_is": role["sigma"],
            "share_agreeing": share.share,
            "share_interval_95": [share.low, share.high],
            "share_if_exact": share.share_if_exact,
            "nuts_p": share.nuts_p,
        },
        "verdict": "agree" if share.agree else "disagree",
        "why": share.why,
        "source": windows.name,
        "form": windows.form,
        "reference": found.reference,
        "seed": found.seed,
        "settings": {f.name: _setting(getattr(found.settings, f.name)) for f in fields(found.settings)},
        "agreement": [_agreement_entry(found, row, number) for row, number in enumerate(found.compared.tolist())],
    }
    if "quadrature" in coverage:
        answer["summary"]["coverage_90_quadrature"] = covered("quadrature")
    return answer


def _noise_shown(found: Validation) -> str:
    """`sigma`, or in the latent form the noise parameter whose mean lies furthest from the reference's."""
    if "sigma" in found.names:
        return "sigma"
    off = found.agreement.mean_difference[:, 2:].abs().nanquantile(0.95, 0)
    return found.names[2 + int(off.nan_to_num(nan=math.inf).argmax())]


def _method_entries(
    method: str, found: Posterior | Quadrature | None, numbers: Sequence[int], seconds: Mapping[str, float]
) -> list[dict[str, Any]]:
    """One entry a window: T_L [s], K_L [-] and sigma [m/s³], or in the latent form `noise` with its parameters."""
    if found is None:
        return []
    columns = {"mean": found.mean, "sd": found.sd, "q05": found.quantile(0.05), "q95": found.quantile(0.95)}
    table = {key: value.tolist() for key, value in columns.items()}
    entries = []
    for row, number in enumerate(numbers):
        stats = {name: {key: finite(table[key][row][i]) for key in table} for i, name in enumerate(found.names)}
        more = {"seconds": seconds[method], "settled": bool(found.converged[row])}
        entries.append({"window": number, "method": method, **_by_kind(stats), **more})
    return entries


def _agreement_entry(found: Validation, row: int, number: int) -> dict[str, Any]:
    """The measures of one window; differences in SDs of the reference."""
    windows, table = found.windows, found.agreement
    measures = [f.name for f in fields(table) if f.name != "names"]
    truth = windows.truth
    return {
        "window": number,
        "start_s": _seconds(float(windows.start_s[number])),
        "end_s": _seconds(float(windows.end_s[number])),
        "n": int(windows.n[number]),
        "excited": bool(windows.excited[number]),
        "settled": bool(found.sgld.converged[number]),
        "truth": None if truth is None else dict(zip(found.names, truth[number].tolist(), strict=True)),
        "ksd": finite(float(found.stein.value[number])),
        "ksd_expected": finite(float(found.stein.expected[number])),
        "ksd_p": float(found.stein.p_value[number]),
        **{
            name: {measure: finite(float(getattr(table, measure)[row, i])) for measure in measures}
            for i, name in enumerate(found.names)
        },
    }


def _setting(value: Any) -> Any:
    """A setting as JSON can hold it: functions by their names."""
    return value if value is None or isinstance(value, (bool, int, float, str)) else getattr(value, "__name__", "given")
