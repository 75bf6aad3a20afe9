"""A diagnosis that reads in ten seconds: one sentence, one table, a few lines below it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import floor, log10
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from avtorch.gap.answer.diagnosis import Candidate, Diagnosis, Quantity

ROWS = 8
BAR = 8
SURE = 0.9
"""What a headline says without a perhaps."""
_FAINT = 0.01  # candidates less probable than this are only counted
_ALIASES = 4  # told by name beside the verdict
_WIDE = 30  # cells that a terminal of 80 leaves for parameters
_EIGHTHS = " ▏▎▍▌▋▊▉█"


def diagnosis_headline(found: Diagnosis) -> list[str]:
    """The verdict as one sentence, and below it the diagnosis' own reason."""
    from avtorch.gap.answer.verdict import meanings

    verdict, p = found.verdict, _share(found.winner.probability)
    if verdict.abstained:
        style, text = "bold yellow", f"The cause is none of the effects known here ({p}): nothing is blamed."
    elif verdict.name == "none":
        first = "The" if found.winner.probability >= SURE else "No effect stands out: probably the"
        style, text = "bold green", f"{first} simulator lacks nothing that this log shows ({p})."
    else:
        told = meanings(verdict.name)
        told = f": {told}." if told else "."
        share = found.winner.probability
        who = "The" if share >= SURE else "Probably the" if share >= 0.5 else "Perhaps the"
        style, text = "bold cyan", f"{who} simulator lacks {' and '.join(verdict.names)} ({p}){told}"
    return [f"[{style}]{escape(text)}[/]", f"[dim]{escape(verdict.why)}[/]"]


def diagnosis_table(found: Diagnosis) -> Table:
    """A row a candidate: probability, log evidence, parameters."""
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("candidate", no_wrap=True)
    table.add_column("probability", no_wrap=True)
    table.add_column("nats", justify="right", no_wrap=True)
    table.add_column("parameters (90 %)")
    shown, left = _shown(found.candidates)
    for c in shown:
        first = c.name == found.verdict.name
        style = "bold" if first else None if c.name in found.verdict.alias_set else "dim"
        gain = round(c.log_evidence or 0.0)
        nats = "" if c.log_evidence is None else f"{gain:+d}" if gain else "0"
        lines = [_parameter(name, c, q) for name, q in c.parameters.items()]
        name = c.name.replace("+", " +\n")
        table.add_row(
            escape(name), f"{_number(c.probability)} {bar(c.probability)}", nats, "\n".join(lines), style=style
        )
    if left:
        rest = sum(c.probability for c in left)
        table.add_row(f"{len(left)} {'others' if len(left) > 1 else 'other'}", _number(rest), "", "", style="dim")
    return table


def diagnosis_notes(found: Diagnosis) -> list[str]:
    """What else there is to say, as lines with markup: alias set, onset, size of the gap, what remains, budget."""
    lines = [escape(_aliases(found))]
    if found.onset_s is not None:
        lines.append(f"Onset: at {found.onset_s:.1f} s of the log's time.")
    elif found.winner.effects:
        lines.append("Onset: there from the start.")
    lines += _where(found)
    lines += _moved(found.baseline, found.winner.moved) + _gap(found) + _shrinkage(found)
    if found.setting is not None:
        lines.append(escape(f"To set: {found.setting['why']}"))
    if found.remaining:
        best = sorted(found.remaining, key=lambda c: -c.probability)[:3]
        told = ", ".join(f"{c.name} {_number(c.probability)}" for c in best if c.probability >= 0.005)
        lines.append(escape(f"Once dead_time is in, what remains: {told}."))
    if not found.complete:
        text = "The budget ended the search: the answer is provisional; the same command with more goes on from here."
        lines.append(f"[yellow]{text}[/]")
    lines += [f"[dim]{escape(note)}[/]" for note in found.notes if found.complete or "budget" not in note]
    return lines


def bar(share: float) -> str:
    """`share` of `BAR` cells, in eighths of a cell."""
    eighths = round(8 * BAR * min(max(share, 0.0), 1.0))
    full, part = divmod(eighths, 8)
    return ("█" * full + (_EIGHTHS[part] if part else "")).ljust(BAR)


def _shown(candidates: Iterable[Candidate]) -> tuple[list[Candidate], list[Candidate]]:
    """The first rows that are not faint, the verdict's, `none` and `unknown` always among them; and those left out."""
    ranked = list(candidates)
    always = [c for c in ranked if c.name in ("none", "unknown")]
    best = [c for c in ranked if c not in always and (c is ranked[0] or c.probability >= _FAINT)]
    best = best[: ROWS - len(always)]
    shown = [c for c in ranked if c in best or c in always]
    return shown, [c for c in ranked if c not in shown]


def _parameter(key: str, candidate: Candidate, q: Quantity) -> str:
    from avtorch.gap.answer.quantity import unit_of, words_of

    effect, _, own = key.rpartition(".")
    # a pair's parameters need the effect's name only where both have one of that name
    twice = sum(k.rpartition(".")[2] == own for k in candidate.parameters) > 1
    unit = unit_of(own)
    words = f"{effect}: {words_of(own)}" if twice else words_of(own)
    mean, interval = _interval(q, "" if unit == "-" else " " + unit)
    between = " " if len(words) + len(mean) + len(interval) + 2 <= _WIDE else "\n  "
    return escape(f"{words} {mean}{between}{interval}")


def _interval(q: Quantity, unit: str) -> tuple[str, str]:
    """Mean and 90 %, to the digit that the interval supports."""
    width = q.q95 - q.q05
    digits = min(max(1 - floor(log10(width)), 0), 7) if width > 0 else 3
    return f"{q.mean:.{digits}f}{unit}", f"({q.q05:.{digits}f} to {q.q95:.{digits}f})"


def _moved(baseline: Mapping[str, Quantity], moved: Mapping[str, Quantity]) -> list[str]:
    told = []
    for name in ("T_L", "K_L"):
        if name in moved and name in baseline:
            unit = " s" if name == "T_L" else ""
            told.append(f"{name} {baseline[name].mean:.2f} → {moved[name].mean:.2f}{unit}")
    return [f"The baseline, fitted without and with it: {', '.join(told)}."] if told else []


def _aliases(found: Diagnosis) -> str:
    from_words = {"none": "no effect at all", "unknown": "a cause outside the table"}
    others = [from_words.get(n, n.replace("+", " with ")) for n in found.verdict.alias_set if n != found.verdict.name]
    if not others:
        return "Told apart from every other candidate on this log."
    if len(others) > _ALIASES + 1:
        others = [*others[:_ALIASES], f"any of {len(others) - _ALIASES} that are less probable"]
    listing = others[0] if len(others) == 1 else f"{', '.join(others[:-1])} or {others[-1]}"
    name = from_words.get(found.verdict.name, found.verdict.name.replace("+", " with "))
    return f"Not told apart on this log: {name}, or {listing}."


def _gap(found: Diagnosis) -> list[str]:
    gap = found.gap
    parts = []
    if gap.rollout_rmse_accel is not None:
        floor = "" if gap.rollout_floor_accel is None else f" ({gap.rollout_floor_accel:.2g} is left at best)"
        if gap.rollout_floor_accel is not None and gap.rollout_floor_accel > 0.97 * gap.rollout_rmse_accel:
            floor = " (no less with the best candidate in)"
        parts.append(f"acceleration off by {gap.rollout_rmse_accel:.2g} m/s²{floor}")
    if gap.rollout_rmse_speed is not None:
        parts.append(f"speed by {gap.rollout_rmse_speed:.2g} m/s")
    if not parts:
        return []
    over = "" if gap.horizon_s is None else f", over {gap.horizon_s:.3g} s"
    return [f"Gap of the simulator as it is{over}: {', '.join(parts)}."]


def _where(found: Diagnosis) -> list[str]:
    from avtorch.gap.answer.where import UNITS

    told = []
    for part in found.where:
        if part.axis == "time" and found.onset_s is not None:
            continue  # the onset says it
        if part.axis == "signal":
            if part.share >= 0.5:
                told.append("in what the car does" if part.begin == "actuation" else "in what the accelerometer shows")
        elif not isinstance(part.begin, str) and not isinstance(part.end, str):
            at, unit = "frequencies" if part.axis == "frequency" else f"{part.axis}s", UNITS[part.axis]
            ends = f"from {part.begin:.2g} to {part.end:.2g}" if part.begin else f"below {part.end:.2g}"
            told.append(f"at {at} {ends} {unit}")
    return [f"It lies {', '.join(told)}."] if told else []


_MEASURES = {
    "rollout_rmse_accel": ("acceleration, rolled out over the drive,", "m/s²"),
    "rollout_rmse_speed": ("speed, rolled out over 10 s,", "m/s"),
}


def _shrinkage(found: Diagnosis) -> list[str]:
    told = found.shrinkage
    if told is None:
        return []
    top, few = told.top, "" if told.chosen == 1 else f"; chosen there by {100 * told.chosen:.0f} % of the parts"
    if told.metric in _MEASURES:
        words, unit = _MEASURES[told.metric]
        line = f"On blocks held out: {words} off by {top.before:.2g}, with the effect by {top.after:.2g} {unit}"
    else:
        gain = top.after - top.before
        line = f"On blocks held out: log density {gain:+.2g} nats a row with the effect; no rollout shows it"
    if top.closed is None:
        return [f"{line}; next to nothing could be closed{few}."]
    q = top.closed
    share = f"{100 * q.mean:.0f} % ({100 * q.q05:.0f} to {100 * q.q95:.0f})"
    return [f"{line}: closes {share} of what can be closed{few}."]


def _number(p: float) -> str:
    return "<.001" if 0 < p < 0.0005 else ">.999" if 0.9995 <= p < 1 else f"{p:.3f}"


def _share(p: float) -> str:
    return f"probability {p:.2f}" if p < 0.995 else "probability over 0.99"
