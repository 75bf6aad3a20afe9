"""The tables of a diagnosis, for its page and the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from avtorch.gap.engine.family import FORMS
from avtorch.gap.quantity import Quantity, unit_behind, words_of
from avtorch.gap.result import budget as budget_parts
from avtorch.gap.result import sentences
from avtorch.gap.result.budget import UNNAMED, Budget, Part
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.gap_size import Shrinkage
from avtorch.gap.result.manoeuvres import Manoeuvre
from avtorch.report.table import Table

_METRICS = {
    "rollout_rmse_accel": "acceleration, {horizon} s [m/s²]",
    "rollout_rmse_speed": "speed, {horizon} s [m/s]",
    "log_predictive_density": "log predictive density [nats per row]",
}

BAND = 0.95
"""Share of a manoeuvre's rows within a band."""
_IMPLAUSIBLE = "physically implausible"
_FAINT = 0.01  # hypotheses less probable than this are only counted


def budget_table(budget: Budget, epoch_s: float) -> Table:
    """What each cause contributes to the gap, or without any what the error consists of; times count from `epoch_s`."""
    share = "share of the gap (90 %)" if budget.parts else "share of the error"
    several = any(len(part.alias_set) > 1 for part in (*budget.parts, *budget.chance))
    chance = "probability of it or an alias" if several else "probability"
    columns = ("effect", share, chance, "parameters (90 %)", "aliases, not told apart")
    places, rows = budget.unexplained.places(epoch_s), []
    for part in (*budget.parts, *budget.chance):
        share = percent(part.share) if isinstance(part, Part) else "by chance, part of the noise"
        parameters = _parameters(part.parameters or {}) + ([] if part.plausible else [_IMPLAUSIBLE])
        alike = ", ".join(name for name in part.alias_set if name != part.name)
        rows.append((part.name, share, sentences.number(part.probability), "; ".join(parameters), alike))
    about = {UNNAMED: "in the repaired simulator", "unexplained": places}
    others = {name: share for name, share in budget.shares.items() if name not in {part.name for part in budget.parts}}
    rows += [(name, percent(share), "", about.get(name, ""), "") for name, share in others.items()]
    return Table("The gap's budget", columns, tuple(rows), numeric=(chance,))


def family_table(budget: Budget) -> Table:
    """What acts in each place of the car, whatever its name, and what could act there unseen."""
    columns = ("family", "what", "size [m/s²] (90 %)", "takes off the gap (90 %)", "probability", "unseen up to [m/s²]")
    rows = []
    for one in budget.families:
        unnamed = "" if one.form is None else f"without a name: {FORMS[one.form][1] if one.form in FORMS else one.form}"
        size = "" if one.size_mps2 is None else interval_of(one.size_mps2)
        off = "" if one.takes_off is None else percent(one.takes_off)
        unseen = "" if one.unseen_mps2 is None else f"{one.unseen_mps2:.2g}{'' if one.excited else ', not excited'}"
        what = "; ".join(filter(None, (", ".join(one.names), unnamed)))
        rows.append((one.family, what, size, off, sentences.number(one.probability), unseen))
    soft = {i for i, one in enumerate(budget.families) if not one.present}
    caption = "The budget by families: each with everything else refitted without it, so that order changes nothing"
    return Table(caption, columns, tuple(rows), numeric=columns[2:], soft=soft)


def candidate_table(found: Diagnosis, most: int = 10) -> Table:
    """The most probable hypotheses, the alias set in bold; `none` and `unknown` always; the others are counted."""
    ranked = found.candidates
    always = [c for c in ranked if c.name in ("none", "unknown")]
    best = [c for c in ranked if c not in always and (c is ranked[0] or c.probability >= _FAINT)][: most - len(always)]
    shown = [c for c in ranked if c in best or c in always]
    rows = [_candidate(c) for c in shown]
    left = [c.probability for c in ranked if c not in shown]
    if left:
        rows.append((f"{len(left)} other{'s' * (len(left) > 1)}", sentences.number(sum(left)), "", ""))
    marked = {i for i, c in enumerate(shown) if c.name in found.verdict.alias_set}
    return Table(
        "Hypotheses",
        ("hypothesis", "probability", "nats", "parameters (90 %)"),
        tuple(rows),
        numeric=("probability", "nats"),
        marked=marked,
        soft=set(range(len(rows))) - marked,
    )


def _candidate(c: Any) -> tuple[str, str, str, str]:
    few = len(c.effects) < 3
    parameters = _parameters(c.parameters) if few else []
    parameters += [_IMPLAUSIBLE] if c.implausible and c.name != "unknown" else []
    name = c.name.replace("+", " + ") if few else f"these {len(c.effects)} effects"
    nats = "" if c.log_evidence is None else f"{round(c.log_evidence):+d}" if round(c.log_evidence) else "0"
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


def place_table(found: Diagnosis) -> Table:
    """The parts of the drive in which the gap lies."""
    columns = ("axis", "part", "share of the effect", "q-value")
    rows = []
    for part in found.where:
        q_value = "<1e-12" if part.q_value < 1e-12 else f"{part.q_value:.1g}"
        rows.append((part.axis, part.words(found.log.epochs_s[0]), f"{100 * part.share:.0f} %", q_value))
    return Table("Parts of the drive in which the gap lies", columns, tuple(rows), numeric=columns[2:])


def manoeuvre_name(found: Diagnosis, one: Manoeuvre) -> str:
    """Such as: Braking at 26.9 s."""
    of = f" of drive {one.log + 1}" if len(found.log.epochs_s) > 1 else ""
    return f"{one.kind.capitalize()} at {one.begin:.1f} s{of}"


def manoeuvre_table(found: Diagnosis, each: Sequence[Manoeuvre]) -> Table:
    """Peak, rise, lag, and the band about the measured acceleration that holds most of a manoeuvre."""
    columns = ("manoeuvre", "signal", "peak [m/s²]", "rise [s]", "lag [s]", "band [m/s²]")
    rows = []
    for one in each:
        for name, response in one.responses.items():
            times = ("" if x is None else f"{x:.2f}" for x in (response.rise, response.lag))
            band = ""
            if name not in ("command", "measured"):
                band = f"±{np.quantile(np.abs(one.lines[name] - one.lines['measured']), BAND):.2g}"
            rows.append((manoeuvre_name(found, one), name, f"{response.peak:.2f}", *times, band))
    caption = (
        "Manoeuvres in which the baseline errs most: rise from 10 to 90 %, lag behind the command, and the band that "
        f"holds {100 * BAND:.0f} % of the rows"
    )
    return Table(caption, columns, tuple(rows), numeric=columns[2:])


def setting_table(setting: Mapping[str, Any]) -> Table:
    """String stability with and without the recommended setting."""
    p, peaks = setting["p_string_stable"], setting["peak_gain"]
    simulators = (("baseline simulator", "assumed"), ("repaired simulator", "in_force"), ("with this setting", "then"))
    columns = ("simulator", "P(string stable)", "peak gain (90 %)")
    rows = tuple((words, f"{p[key]:.2f}", _peak(peaks[key])) for words, key in simulators)
    return Table("String stability", columns, rows, numeric=columns[1:])


def _peak(peak: Mapping[str, float | None]) -> str:
    middle, low, high = (f"{x:.2f}" if x is not None else "no end" for x in (peak[k] for k in ("median", "q05", "q95")))
    return f"{middle} ({low} to {high})"


def percent(q: Quantity) -> str:
    """A share and its 90 % interval, as 50 % (34 to 66); of whole per cents, as 100 %, where it has no width."""
    low, high = (round(100 * x) for x in (q.q05, q.q95))
    return budget_parts.percent(q.mean) + ("" if low == high else f" ({low} to {high})")


def interval_of(q: Quantity) -> str:
    """A number and its 90 % interval, where it has a width."""
    return f"{q.mean:.2g}" + ("" if q.q05 == q.q95 else f" ({q.q05:.2g} to {q.q95:.2g})")


def _parameters(parameters: Mapping[str, Quantity]) -> list[str]:
    words, own = [], [key.rpartition(".")[2] for key in parameters]
    for key, q in parameters.items():
        effect, _, name = key.rpartition(".")
        # a pair's parameters need the effect's name only where both have one of that name
        of = f"{effect}: " if own.count(name) > 1 else ""
        interval = f"{q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})"
        words.append(f"{of}{words_of(name)} {interval}{unit_behind(name)}")
    return words
