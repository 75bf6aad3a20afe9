"""The tables of a diagnosis: budget, hypotheses, errors held out, places of the gap, the setting."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from avtorch.gap.answer import budget as budget_parts
from avtorch.gap.answer.budget import Budget
from avtorch.gap.answer.location import UNITS
from avtorch.gap.quantity import unit_of, words_of
from avtorch.gap.result import sentences
from avtorch.gap.result.diagnosis import Diagnosis, Quantity, Shrinkage
from avtorch.report.table import Table

_METRICS = {
    "rollout_rmse_accel": "acceleration, {horizon} s [m/s²]",
    "rollout_rmse_speed": "speed, {horizon} s [m/s]",
    "log_predictive_density": "log predictive density [nats per row]",
}

_IMPLAUSIBLE = "physically implausible"


def budget_table(budget: Budget, epoch_s: float = 0.0) -> Table:
    """What each cause contributes to the gap, or without any what the error consists of; times count from `epoch_s`."""
    share = "share of the gap (90 %)" if budget.parts else "share of the error"
    columns = ("effect", share, "probability", "parameters (90 %)", "cannot be told from")
    rows = []
    for part in budget.parts:
        parameters = _parameters(part.parameters) + ([] if part.plausible else [_IMPLAUSIBLE])
        alike = ", ".join(name for name in part.alias_set if name != part.name)
        rows.append((part.name, percent(part.share), sentences.number(part.probability), "; ".join(parameters), alike))
    for part in budget.chance:
        parameters = _parameters(part.parameters or {}) + ([] if part.plausible else [_IMPLAUSIBLE])
        share = "by chance, part of the noise"
        alike = ", ".join(name for name in part.alias_set if name != part.name)
        rows.append((part.name, share, sentences.number(part.probability), "; ".join(parameters), alike))
    places, rest = budget.unexplained.places(epoch_s), budget.left_above_noise
    if budget.parts:
        rows.append(("unexplained", percent(budget.unexplained.share), "", places, ""))
    else:
        rows += [
            ("unexplained", budget_parts.percent(rest), "", places, ""),
            ("noise", budget_parts.percent(1.0 - rest), "", "", ""),
        ]
    return Table("The gap's budget", columns, tuple(rows), numeric=("probability",))


def candidate_table(found: Diagnosis, most: int = 10) -> Table:
    """The most probable hypotheses, the alias set in bold."""
    some = found.candidates[:most]
    return Table(
        "Hypotheses",
        ("hypothesis", "probability", "nats over none", "parameters (90 %)"),
        tuple(_candidate(c) for c in some),
        numeric=("probability", "nats over none"),
        marked={i for i, c in enumerate(some) if c.name in found.verdict.alias_set},
    )


def _candidate(c: Any) -> tuple[str, str, str, str]:
    few = len(c.effects) < 3
    parameters = _parameters(c.parameters) if few else []
    parameters += [_IMPLAUSIBLE] if c.implausible and c.name != "unknown" else []
    name = c.name.replace("+", " + ") if few else f"these {len(c.effects)} effects"
    nats = "" if c.log_evidence is None else f"{c.log_evidence:+.0f}"
    return name, sentences.number(c.probability), nats, "; ".join(parameters)


def measure_table(shrinkage: Shrinkage) -> Table:
    """Errors on held-out blocks, the measure that decides in bold."""
    columns = ("measure", "baseline", "with the effect", "noise floor", "black box", "closed (90 %)")
    rows = [
        (
            _METRICS.get(name, name).format(horizon=f"{c.horizon_s or 0:.3g}"),
            *(f"{x:.3g}" for x in (c.before, c.after, c.floor, shrinkage.ceiling[name])),
            "" if c.closed is None else percent(c.closed),
        )
        for name, c in shrinkage.by_metric.items()
    ]
    top = {i for i, name in enumerate(shrinkage.by_metric) if name == shrinkage.metric}
    return Table("Errors on held-out blocks", columns, tuple(rows), numeric=columns[1:], marked=top)


def place_table(found: Diagnosis) -> Table | None:
    """The parts of the drive in which the gap lies; None where none stands out."""
    columns = ("axis", "part", "share of the effect", "q-value")
    rows = tuple(_place(found, part) for part in found.where)
    return Table("Parts of the drive in which the gap lies", columns, rows, numeric=columns[2:]) if rows else None


def _place(found: Diagnosis, part: Any) -> tuple[str, str, str, str]:
    if part.axis == "time":
        begin, end = (t - found.log.epochs_s[0] for t in (part.begin, part.end))
        ends = f"{begin:.1f} to {end:.1f} s from the log's start"
    elif part.axis == "signal":
        ends = part.begin
    else:
        ends = f"{part.begin:.3g} to {part.end:.3g} {UNITS[part.axis]}"
    return part.axis, ends, f"{100 * part.share:.0f} %", "<1e-12" if part.q_value < 1e-12 else f"{part.q_value:.1g}"


def setting_table(found: Diagnosis) -> Table | None:
    """String stability with and without the recommended setting; None where there is none."""
    if found.setting is None:
        return None
    p, peaks = found.setting["p_string_stable"], found.setting["peak_gain"]
    simulators = (("baseline simulator", "assumed"), ("repaired simulator", "in_force"), ("with this setting", "then"))
    columns = ("simulator", "P(string stable)", "peak gain (90 %)")
    rows = tuple((words, f"{p[key]:.2f}", _peak(peaks[key])) for words, key in simulators)
    return Table("String stability", columns, rows, numeric=columns[1:])


def _peak(peak: Mapping[str, float | None]) -> str:
    middle, low, high = (f"{x:.2f}" if x is not None else "no end" for x in (peak[k] for k in ("median", "q05", "q95")))
    return f"{middle} ({low} to {high})"


def percent(q: Quantity) -> str:
    """A share and its 90 % interval.

    Example:
        >>> from avtorch.gap.quantity import Quantity
        >>> from avtorch.report.entries import percent
        >>> percent(Quantity.of_normal(0.5, 0.1))
        '50 % (34 to 66)'
    """
    low, high = (round(100 * x) for x in (q.q05, q.q95))
    return f"{budget_parts.percent(q.mean)} ({low} to {high})"


def _parameters(parameters: Mapping[str, Quantity]) -> list[str]:
    words = []
    for key, q in parameters.items():
        unit = unit_of(key)
        words.append(f"{words_of(key.rpartition('.')[2])} {_number(q)}{'' if unit == '-' else ' ' + unit}")
    return words


def _number(q: Quantity, digits: int = 3) -> str:
    return f"{q.mean:.{digits}g} ({q.q05:.{digits}g} to {q.q95:.{digits}g})"
