"""A diagnosis in words: the sentences shared by the terminal and the report, in plain text."""

from __future__ import annotations

from avtorch.gap.result.budget import listing
from avtorch.gap.result.findings import Findings
from avtorch.gap.result.hypotheses import Scope
from avtorch.gap.simulator.effect import named_cause
from avtorch.io.clock import clock_words

SURE = 0.9
"""Probability from which a headline is unqualified."""
_CHANNEL = {"speed": ("speed", "m/s"), "accel": ("acceleration", "m/s²")}
_ALIASES = 4  # hypotheses named beside the verdict
_UNTRIED = 6  # names of effects listed as not tried


def headline(found: Findings) -> str:
    """The verdict as one sentence; provisional where the budget ended the search."""
    return _verdict(found) if found.complete else f"Provisional: {_verdict(found)}"


def _verdict(found: Findings) -> str:
    verdict, p = found.verdict, _share(found.winner.probability)
    if verdict.abstained and found.winner.probability < 0.5:
        return f"No cause can be named: perhaps it is not among the {_known(found)} ({p}), perhaps too weak to tell."
    if verdict.abstained:
        return f"The cause is not among the {_known(found)} ({p}); no cause is named."
    odd = found.winner.implausible
    but = ", but as fitted it is physically implausible" if odd else ""
    if verdict.name == "none" and not _all_tried(found):
        return f"None of the {_known(found)} brings the simulator closer to this log ({p}){but}."
    if verdict.name == "none" and found.tested is not None and found.tested.wrong:
        wrong = " and ".join(str(p) for p in found.tested.wrong)
        return f"The simulator lacks nothing that this log shows ({p}), but a parameter is wrong: {wrong}."
    if verdict.name == "none":
        chance = found.winner.probability
        first = "The" if chance >= SURE else f"No effect stands out: {'probably' if chance >= 0.5 else 'perhaps'} the"
        return f"{first} simulator lacks nothing that this log shows ({p}){but}."
    if found.budget is not None and found.budget.parts and (len(verdict.names) > 1 or verdict.partial):
        return str(found.budget)
    if found.tested is not None and not found.tested.missing:
        own = [x for x in found.tested.wrong if x.own or "." in x.name]
        return f"A parameter of the simulator is wrong ({p}): {'; '.join(map(str, own))}." if own else _lacks(found, p)
    return _lacks(found, p)


def _lacks(found: Findings, p: str) -> str:
    """That the simulator lacks the verdict's effects, `p` as words."""
    verdict, winner = found.verdict, found.winner
    who = "The" if winner.probability >= SURE else "Probably the" if winner.probability >= 0.5 else "Perhaps the"
    names = " and ".join(verdict.names)
    if winner.implausible:  # the fit is not described by the effects' usual meaning
        return f"{who} simulator lacks {names} ({p}), but as fitted that is physically implausible."
    return f"{who} simulator lacks this ({p}): {', and '.join(_cause(found, name) for name in verdict.names)}."


def _cause(found: Findings, name: str) -> str:
    """One of the verdict's effects in words, at the parameters of the budget or else of the fit."""
    parts = [] if found.budget is None else [*found.budget.parts, *found.budget.chance]
    of_budget = next((part.parameters for part in parts if part.name == name), None)
    fitted = {
        key.rpartition(".")[2]: q
        for key, q in found.winner.parameters.items()
        if "." not in key or key.startswith(f"{name}.")
    }
    return named_cause(name, {key: q.mean for key, q in (of_budget or fitted).items()})


def tested(found: Findings) -> list[str]:
    """What is said of a simulator that is not avtorch's own, beyond the headline."""
    facts = found.tested
    if facts is None:
        return []
    own = list(facts.surrogate.report())
    holds = f" with {', '.join(own)}" if own else ""
    left = max(facts.left.values(), default=0.0)
    lag, gain = float(facts.surrogate.T_L), float(facts.surrogate.K_L)
    adjusted = " with the car's values" if any(x.own for x in facts.wrong) else ""
    lines = [
        f"Of the simulator itself ({facts.name}{adjusted}): it answers as a lag of {lag:.2f} s and a gain of {gain:.2f}"
        f"{holds}, but for {100 * left:.1f} % of its response, which is taken from its output."
    ]
    errors = [f"{name} {value:.2g} {_CHANNEL[name][1]}" for name, value in facts.rollout.items()]
    if errors:
        lines.append(f"Its error against the car as it is, over 10 s: {', '.join(errors)}.")
    said = headline(found)
    wrong = [str(x) for x in facts.wrong if str(x) not in said]
    if wrong:
        lines.append(f"Parameters that differ: {'; '.join(wrong)}.")
    chance = [] if found.budget is None else [p.name for p in found.budget.chance if p.name in found.verdict.names]
    if chance:
        lines.append(f"{' and '.join(chance)}, by chance, is no part of a simulator that is missing, but of the noise.")
    return lines


def budget(found: Findings) -> list[str]:
    """The sentence on the budget of the gap, and what it divides."""
    if found.budget is None:
        return []
    beside = [found.budget.rest] if found.budget.rest else []
    if not found.budget.parts:
        return beside
    verb = "cut" if all(e.left < e.before for e in found.budget.by_channel.values()) else "take"
    cut = f"this effect {verb}s" if len(found.budget.names) == 1 else f"these effects {verb}"
    if found.free_form is not None:
        cut = f"the repaired simulator {verb}s"
    told = len(found.budget.names) == 1 and found.budget.names == found.verdict.names and not found.verdict.partial
    line = [] if headline(found).endswith(str(found.budget)) else [found.budget.said(told=told)]
    rest = found.budget.unexplained.rest(found.budget.material)
    errors, floors = [], []
    for name, error in found.budget.by_channel.items():
        word, unit = _CHANNEL[name]
        errors.append(f"in {word} from {error.before:.2g} to {error.left:.2g} {unit}")
        floors.append(f"{error.floor:.2g} {unit}")
    return [
        *line,
        *beside,
        f"In simulations of {found.budget.horizon_s:.3g} s from the logged commands, on parts of the drive not used "
        f"for fitting, {cut} the error {' and '.join(errors)}"
        + (f"; noise alone makes {' and '.join(floors)}." if rest == "noise" else "."),
    ]


def onset(found: Findings) -> list[str]:
    """The sentence on the onset."""
    if found.onset_s is not None:
        return [f"The gap begins at {moment(found)}."]
    return ["The gap is there from the start."] if found.winner.effects else []


def moment(found: Findings) -> str:
    """The onset from the log's start, and in brackets on the log's own clock; one figure where both are the same."""
    assert found.onset_s is not None
    assert found.onset_from_start_s is not None
    of = "the log's" if len(found.log.epochs_s) == 1 else f"drive {found.onset_log + 1}'s"
    if abs(found.onset_s - found.onset_from_start_s) < 0.05:
        return f"{found.onset_s:.1f} s of {of} time"
    return f"{found.onset_from_start_s:.1f} s from {of} start ({clock_words(round(found.onset_s, 1))})"


def where(found: Findings) -> list[str]:
    """Where the gap lies, apart from an onset."""
    places = []
    for part in found.where:
        stated = part.axis == "time" and found.onset_s is not None  # by the sentence on the onset
        if not stated and (part.axis != "signal" or part.share >= 0.5):
            places.append(part.words(found.log.epochs_s[0]))
    return [f"The gap lies {', '.join(places)}."] if places else []


def shrinkage(found: Findings) -> list[str]:
    """How far a repaired simulator in which nothing has a name shrinks the gap on held-out data; where something has
    one, the budget's sentence says it."""
    scores = found.shrinkage
    if scores is None or budget(found):
        return []
    top = scores.top
    word, unit = _CHANNEL.get(scores.metric.removeprefix("rollout_rmse_"), ("", ""))
    line = f"{_over(top.horizon_s)}: {word} error {top.before:.2g} {unit} of the baseline, {top.after:.2g} {unit}"
    if not word:
        line = f": log predictive density {top.after - top.before:+.2g} nats per row, which rollouts do not show,"
    q = top.closed
    end = "almost none of the gap is reducible"
    if q is not None:
        end = f"that closes {100 * q.mean:.0f} % ({100 * q.q05:.0f} to {100 * q.q95:.0f}) of the reducible gap"
    parts = "drives" if scores.by_drives else "blocks"
    return [f"On held-out {parts}{line} of the repaired simulator; {end}."]


def moved(found: Findings) -> list[str]:
    """The change of the baseline's fit by the effect."""
    changes = [
        f"{name} {found.baseline[name].mean:.2f} → {q.mean:.2f}{' s' if name == 'T_L' else ''}"
        for name, q in found.winner.moved.items()
    ]
    effects = "effects" if len(found.verdict.names) > 1 else "effect"
    return [f"Baseline fitted without and with the {effects}: {', '.join(changes)}."] if changes else []


def aliases(found: Findings) -> str:
    """The hypotheses that the log cannot distinguish from the verdict."""
    tried = not found.scope.not_scored
    words = {"none": "no effect at all", "unknown": f"a cause {'outside the table' if tried else 'that was not tried'}"}
    if found.budget is not None and len(found.verdict.names) > 2:
        each = (*found.budget.parts, *found.budget.chance)
        alike = [(p.name, [n for n in p.alias_set if n != p.name]) for p in each if p.name in found.verdict.names]
        confused = [f"{name} from {' or '.join(others)}" for name, others in alike if others]
        if not confused:
            return "No other known cause explains this log as well."
        return f"This log cannot distinguish {', nor '.join(confused)}."
    others = [words.get(n, n.replace("+", " with ")) for n in found.verdict.alias_set if n != found.verdict.name]
    if not others:
        which = "known cause" if _all_tried(found) else "cause that was tried"
        return f"No {'' if found.verdict.name == 'none' else 'other '}{which} explains this log as well."
    if len(others) > _ALIASES + 1:
        others = [*others[:_ALIASES], f"any of {len(others) - _ALIASES} less probable hypotheses"]
    name = words.get(found.verdict.name, found.verdict.name.replace("+", " with "))
    return f"This log cannot distinguish {name} from {listing(others, 'or')}."


def untried(scope: Scope) -> list[str]:
    """The hypotheses that were not tried, and the resulting meaning of the probabilities."""
    few, rest = scope.not_scored[:_UNTRIED], len(scope.not_scored) - _UNTRIED
    parts = [*few, *([f"{rest} more effects"] if rest > 0 else [])]
    parts += {"some": ["some of the pairs"], "none": ["pairs"]}.get(scope.pairs, [])
    if not parts:
        return []
    return [f"Not tried: {listing(parts)}. Probabilities cover only what was tried; unknown stands for the rest."]


def _all_tried(found: Findings) -> bool:
    return found.complete and found.scope.whole


def _known(found: Findings) -> str:
    """The set of effects that the sentence excludes."""
    if _all_tried(found):
        return "effects known here"
    tried = f"effects tried, {len(found.scope.scored)} of {len(found.scope.scored + found.scope.not_scored)}"
    return f"single {tried}" if found.scope.pairs == "none" else tried


def gap(found: Findings) -> list[str]:
    """The rollout errors of the baseline simulator."""
    gap = found.gap
    parts = []
    if gap.rollout_rmse_accel is not None:
        floor = "" if gap.rollout_floor_accel is None else f" ({gap.rollout_floor_accel:.2g} with the best hypothesis)"
        parts.append(f"acceleration error {gap.rollout_rmse_accel:.2g} m/s²{floor}")
    if gap.rollout_rmse_speed is not None:
        parts.append(f"speed error {gap.rollout_rmse_speed:.2g} m/s")
    if not parts:
        return []
    lines = [f"Gap of the baseline simulator{_over(gap.horizon_s)}: {', '.join(parts)}."]
    if gap.repeats is not None:
        alike = [("accelerations", gap.repeats.floor_accel, "m/s²"), ("speeds", gap.repeats.floor_speed, "m/s")]
        spreads = " and ".join(f"{name} to {x:.2g} {unit}" for name, x, unit in alike if x is not None)
        again = f"Under repeated commands ({gap.repeats.seconds:.0f} s) the car repeats {spreads}"
        lines.append(f"{again}; this spread is noise, or does not depend on the commands.")
    return lines


def number(p: float) -> str:
    """A probability with three decimals."""
    return "<.001" if 0 < p < 0.0005 else ">.999" if 0.9995 <= p < 1 else f"{p:.3f}"


def remains(found: Findings) -> list[str]:
    """Hypotheses for what the simulator lacks besides the delay."""
    if not found.remaining:
        return []
    best = sorted(found.remaining, key=lambda c: -c.probability)[:3]
    each = ", ".join(f"{c.name} {number(c.probability)}" for c in best if c.probability >= 0.005)
    return [f"Hypotheses once the simulator has dead_time: {each}."]


def to_set(found: Findings) -> list[str]:
    """The recommended setting."""
    if found.setting is None:
        return []
    why = found.setting["why"]
    return [why if why.startswith("Nothing to set") else f"To set: {why}"]


def to_drive(found: Findings) -> list[str]:
    """The recommended next experiment."""
    experiment = found.next_experiment
    if experiment is None:
        return []
    why, begin, seconds, metres = (experiment[key] for key in ("why", "start_speed_mps", "seconds", "metres"))
    line = f"Next experiment: {why} It starts at {begin:.3g} m/s and takes {seconds:.0f} s and {metres:.0f} m."
    kept = experiment.get("limits")
    if kept is None:
        return [line]
    speeds, commands = (f"{kept[f'{k}_min']:.2g} to {kept[f'{k}_max']:.3g}" for k in ("speed", "accel"))
    return [f"{line} Limits, {kept['source']}: {speeds} m/s, {commands} m/s²."]


def _over(seconds: float | None) -> str:
    return "" if seconds is None else f", in rollouts of {seconds:.3g} s"


def _share(p: float) -> str:
    return f"probability {p:.2f}" if p < 0.995 else "probability over 0.99"
