"""The engine's posterior as the answer's hypotheses: probabilities, parameters, the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from avtorch.gap.answer.budget import LIKELY
from avtorch.gap.answer.plausibility import implausible
from avtorch.gap.answer.verdict import ALIAS_RATIO, ALWAYS, Candidate, Verdict, candidate_name
from avtorch.gap.engine.average import ModelAverage, Weight
from avtorch.gap.engine.coordinates import base_name
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.outliers import rate_onset
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.own_random import OwnRandom
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.effect import Effect
from avtorch.io import Log

_HELD = 0.9  # probability that an alias set holds
_MOST_ALIASES = 6
_LEAST = 1e-4


@dataclass(frozen=True)
class Onset:
    """A time in log number `log`: `stamp_s` on the log's own clock, `from_start_s` from its first row [s]."""

    stamp_s: float
    from_start_s: float
    log: int

    @classmethod
    def at(cls, data: DriveData, logs: Sequence[Log], time: float) -> Onset:
        """The time [s] of the data's own clock."""
        row = int(abs(data.time - time).argmin())
        number = int(data.log[row])
        stamp = float(data.stamp[row] + time - data.time[row])
        return cls(stamp, stamp - logs[number].epoch_s, number)


def onset_of(weight: Weight, name: str, logs: Sequence[Log]) -> Onset | None:
    """Since when a cause of the weight's label acts; None: from the start."""
    h = weight.examined.hypothesis
    time = next((t for e, t in h.onsets.items() if base_name(e) == name), None)
    if name == "gust" and weight.slow == "gust":
        time = weight.composition.gust_onset
    elif name == "command_hold" and h.lost:
        time = _rate_onset(h, [i for i, _ in h.lost])
    elif name == "outliers" and weight.examined.outliers is not None:
        time = _rate_onset(h, weight.examined.outliers.starts.tolist())
    return None if time is None else Onset.at(h.data, logs, time)


def first_onset(weight: Weight, names: Sequence[str], logs: Sequence[Log]) -> Onset | None:
    """The onset of the first of these causes that has one."""
    return next((x for x in (onset_of(weight, name, logs) for name in names) if x is not None), None)


def _rate_onset(h: Hypothesis, rows: Sequence[int]) -> float | None:
    data = h.data
    return rate_onset(data.time[list(rows)], float(data.time[0]), float(data.time[-1]))[1]


def verdict_names(average: ModelAverage, shares: Mapping[str, float] | None = None) -> tuple[str, ...]:
    """Causes of the most probable hypothesis that, they or their aliases, are there with a probability of a half or
    more, and others of which that holds by themselves, the largest of `shares` first; `("none",)` or `("unknown",)`,
    the more probable, where there are none."""
    names = {n for label in average.probabilities for n in label.split("+")} - set(ALWAYS)
    own = set(average.label.split("+"))
    likely = [n for n in names if (part_probability(average, n) if n in own else average.marginal(n)) >= LIKELY]
    if likely:
        return tuple(sorted(likely, key=lambda n: (-(shares or {}).get(n, 0.0), -average.marginal(n), n)))
    return (max(ALWAYS, key=lambda n: average.probabilities[n]),)


def aliases_of(average: ModelAverage, name: str) -> tuple[str, ...]:
    """Effects that stand in the place of `name` in hypotheses of some probability, `name` first."""
    out = [name]
    top = set(average.label.split("+"))
    for label, p in average.probabilities.items():
        own = set(label.split("+"))
        others = own - top
        one_other = len(others) == 1 and not others & set(ALWAYS)
        if p >= ALIAS_RATIO and name not in own and one_other and top - {name} <= own:
            out += others
    return tuple(dict.fromkeys(out))


def part_probability(average: ModelAverage, name: str) -> float:
    """That `name`, or an effect that these drives do not tell from it, is among the causes."""
    alike = set(aliases_of(average, name))
    return min(sum(p for label, p in average.probabilities.items() if alike & set(label.split("+"))), 1.0)


def best_weight(average: ModelAverage, names: Sequence[str]) -> Weight:
    """The strongest weight of these causes; where none has just these, the strongest that has them all."""
    label = candidate_name(names)
    if label in average.best:
        return average.best[label]
    holding = [w for k, w in average.best.items() if set(names) <= set(k.split("+"))]
    return max(holding or average.best.values(), key=lambda w: w.log_weight)


def alias_set(average: ModelAverage, verdict: str) -> tuple[str, ...]:
    """Hypotheses that hold nine tenths of the probability, the verdict first."""
    held, total = [verdict], 0.0
    for label, p in average.probabilities.items():
        total += p
        held.append(label)
        if total > _HELD or len(held) > _MOST_ALIASES:
            break
    return tuple(dict.fromkeys(held))


def why(average: ModelAverage, names: Sequence[str], known: str) -> str:
    """One sentence on the evidence and what comes next."""
    label = candidate_name(names)
    words = {"none": "that nothing is missing", "unknown": "a cause without a name"}
    rest = [(k, p) for k, p in average.probabilities.items() if k != label]
    rival = f"next likeliest, with {rest[0][1]:.3g}, is {words.get(rest[0][0], rest[0][0])}" if rest else "no rival"
    if label == "none":
        return f"No {known} explains the log better than the baseline does; {rival}."
    if label == "unknown":
        return f"What is missing answers to no {known}; {rival}."
    if label in average.probabilities:
        return f"{label} has probability {average.probabilities[label]:.3g}; {rival}."
    each = ", ".join(f"{n} {part_probability(average, n):.2g}" for n in names)
    return f"Each of these causes is there with a probability of a half or more ({each}); {rival}."


def candidates_of(
    average: ModelAverage,
    logs: Sequence[Log],
    kinds: Sequence[type[Effect]],
    posterior: ParameterPosterior | None,
    random: Sequence[OwnRandom] = (),
) -> tuple[list[Candidate], dict[str, ParameterPosterior]]:
    """Hypotheses of the answer, and the posteriors of their parameters by name; `posterior`: that of the verdict."""
    none = average.best["none"].evidence if "none" in average.best else 0.0
    out: list[Candidate] = []
    posteriors: dict[str, ParameterPosterior] = {}
    for label, p in average.probabilities.items():
        weight = average.best.get(label)
        if weight is None or label == "unknown":
            out.append(Candidate(label, p))
            continue
        own = (
            posterior
            if posterior is not None and posterior.weight is weight
            else ParameterPosterior(weight, own=random)
        )
        posteriors[label] = own
        parameters: dict[str, Quantity] = {} if label == "none" or p < _LEAST else own.named()
        moved = own.moved()
        odd = implausible(parameters, moved, [k for k in kinds if k.name in label.split("+")])
        onset = None if label == "none" else first_onset(weight, label.split("+"), logs)
        out.append(
            Candidate(
                label,
                p,
                float(weight.evidence - none),
                parameters,
                {} if label == "none" else moved,
                None if onset is None else onset.stamp_s,
                odd,
            )
        )
    return out, posteriors


def verdict(average: ModelAverage, names: tuple[str, ...], known: str, partial: bool) -> Verdict:
    """The verdict of these names."""
    label = candidate_name(names)
    return Verdict(names, alias_set(average, label), label == "unknown", why(average, names, known), partial)
