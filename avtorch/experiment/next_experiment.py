"""The manoeuvre that best separates causes that a log does not distinguish: the gentlest of those that surely do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.display import Card, Displayed
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.experiment.manoeuvres import Limits, Manoeuvre, library
from avtorch.experiment.prediction import Information, ManoeuvrePrediction, information, responses
from avtorch.gap.result.counted_rows import grouped
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.predictive_model import PredictiveModel
from avtorch.io import atomic

_RATE_HZ = 20.0
_DRAWS = 32
_TURNS = 3  # iterations that trim a manoeuvre's net change of speed
_SURE = 12.0
"""Log odds [nats] of the worst pair that are enough: more than a real car's differing from every model can cost."""
_FAINT = 0.1  # share of the entropy


@dataclass(frozen=True, eq=False, repr=False)
class Experiment(Displayed):
    """Drive `manoeuvre` next: it `separates` those causes.

    `information`: its expected information; `entropy` [nats]: of the cause before it. `every`: the same for all
    manoeuvres within the `limits`. `unresolved`: causes that no manoeuvre distinguishes with these signals. `why`: a
    sentence.

    Example:
        >>> from avtorch.experiment import Experiment, Information, library
        >>> manoeuvre, expected = library()[0], Information(0.6, 0.95, 4.0)
        >>> experiment = Experiment(manoeuvre, ("dead_time", "rate_limit"), expected, entropy=0.69, every={})
        >>> experiment.separates, experiment.information.nats <= experiment.entropy
        (('dead_time', 'rate_limit'), True)
    """

    manoeuvre: Manoeuvre
    separates: tuple[str, ...]
    information: Information
    entropy: float
    every: Mapping[str, Information] = field(repr=False)
    unresolved: tuple[str, ...] = ()
    why: str = ""
    limits: Limits = field(default_factory=Limits)

    def overview(self) -> Card:
        """The manoeuvre, what it separates, and what it is expected to tell."""
        made, told = self.manoeuvre, self.information
        line = f"It separates {', '.join(self.separates)}: {told.nats:.2g} of {self.entropy:.2g} nats expected."
        title = f"Next experiment: {made.name}, {float(made.time[-1]):.3g} s from {float(made.speed[0]):.3g} m/s"
        return Card(title, (line, *([self.why] if self.why else [])))

    def to_dict(self) -> dict[str, Any]:
        """The object `next_experiment` of `diagnosis.json`."""
        return {
            "manoeuvre": self.manoeuvre.name,
            "separates": list(self.separates),
            "expected_information_nats": self.information.nats,
            "entropy_nats": self.entropy,
            "expected_probability_of_truth": self.information.truth_probability,
            "seconds": round(float(self.manoeuvre.time[-1]), 6),
            "metres": self.manoeuvre.metres,
            "start_speed_mps": float(self.manoeuvre.speed[0]),
            "untold": list(self.unresolved),
            "limits": asdict(self.limits),
            "why": self.why,
        }


@shows_progress
def next_experiment(
    found: Diagnosis,
    limits: Limits | None = None,
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] | bool | None = None,
) -> Experiment | None:
    """The library manoeuvre that distinguishes the diagnosis' `contenders`; None where there is nothing to distinguish.

    Start it at its first expected speed, on a level road if there is one. `limits` default to what the car did in the
    log (`Limits.of_log`). `progress(done, of)` is called with the hypotheses and manoeuvres; or True, False, None, as
    in `avtorch.diagnose`. Raises `InputError` where the limits allow no manoeuvre at all.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.experiment import next_experiment
        >>> from avtorch.gap import DeadTime, plant
        >>> late = plant([DeadTime(0.25)], sigma=0.1)
        >>> log = simulate(Leader.default(start=50.0, duration=20.0, dt=0.1), plant=late).log()
        >>> found = diagnose(log, effects=["dead_time"], pairs=False)
        >>> next_experiment(found).separates
        ('none', 'dead_time')
    """
    rivals = list(found.contenders)
    if len(rivals) < 2:
        return None
    channels = tuple(name for name in ("accel", "speed") if name in found.log.signals)
    group = grouped(found.log.rate_hz, _RATE_HZ)
    given = Limits.of_log(found.log) if limits is None else limits
    offers = _expected(rivals[0], library(given, rate_hz=found.log.rate_hz / group), given)
    if not offers:
        raise InputError(f"limits: no manoeuvre of the library keeps to {given}; needs more speed, road or time")
    weights = np.maximum([found.probability(r.name) for r in rivals], 1e-3)
    weights = weights / weights.sum()
    entropy = float(-(weights * np.log(weights)).sum())
    step, of = called(progress), len(rivals) + len(offers)
    predictions, expected = [], []
    for rival in rivals:
        predictions.append(ManoeuvrePrediction(rival, offers, channels, group, _DRAWS))
        if step is not None:
            step(len(predictions), of)
    for i in range(len(offers)):
        expected.append(information(predictions, i, weights.tolist(), seed=seed))
        if step is not None:
            step(len(rivals) + i + 1, of)
    best = _chosen(offers, expected)
    names = tuple(r.name for r in rivals)
    unresolved = tuple(n for n in found.verdict.alias_set if n not in names and n != "unknown")
    return Experiment(
        manoeuvre=offers[best],
        separates=names,
        information=expected[best],
        entropy=entropy,
        every={m.name: i for m, i in zip(offers, expected, strict=True)},
        unresolved=unresolved,
        why=_sentence(offers[best], names, expected[best], entropy, unresolved, channels),
        limits=given,
    )


def write_table(experiment: Experiment | None, folder: str | PathLike[str]) -> list[Path]:
    """Write `manoeuvre.csv`, the command table: `time` [s], `accel_cmd` [m/s²], `speed_expected` [m/s].

    A command holds until the next row's time. Where there is no experiment, an earlier table in the folder is removed.
    Raises `InputError` where the folder cannot be written.
    """
    path = Path(folder) / "manoeuvre.csv"
    if experiment is None:
        path.unlink(missing_ok=True)
        return []
    m = experiment.manoeuvre
    with atomic(path) as stream:
        header, rows = "time,accel_cmd,speed_expected", np.column_stack([m.time, m.command, m.speed])
        np.savetxt(stream, rows, "%.6g", delimiter=",", header=header, comments="")
    return [path]


def _expected(first: PredictiveModel, manoeuvres: tuple[Manoeuvre, ...], limits: Limits) -> list[Manoeuvre]:
    """Manoeuvres with the speeds that the likeliest cause predicts, trimmed to return to the start; those within
    limits."""
    offers = list(manoeuvres)
    K_L = float(np.mean(first.belief["K_L"]))
    for turn in range(_TURNS + 1):
        if not offers:
            return []
        speeds = responses(first, offers, slice(None)).speed.mean(1).numpy()
        speeds = [m.speed[0] + v - v[0] for m, v in zip(offers, speeds, strict=True)]
        if turn < _TURNS:
            # speed-dependent effects are evaluated at the speed driven once the change is compensated
            level = [v - (v[-1] - v[0]) * np.linspace(0.0, 1.0, len(v)) for v in speeds]
            offers = [m.trimmed(-float(v[-1] - v[0]) / K_L) for m, v in zip(offers, speeds, strict=True)]
            speeds = level
        offers = [replace(m, speed=v) for m, v in zip(offers, speeds, strict=True)]
    return [m for m in offers if m.within(limits)]


def _chosen(offers: list[Manoeuvre], expected: list[Information]) -> int:
    """The gentlest manoeuvre that surely distinguishes every pair, or else the most informative one."""
    sure = [i for i, j in enumerate(expected) if j.margin >= _SURE]
    if sure:
        return min(sure, key=lambda i: (round(offers[i].effort, 1), offers[i].metres))
    return max(range(len(offers)), key=lambda i: (round(expected[i].nats, 2), expected[i].margin))


def _sentence(
    m: Manoeuvre,
    names: tuple[str, ...],
    expected: Information,
    entropy: float,
    unresolved: tuple[str, ...],
    channels: tuple[str, ...],
) -> str:
    causes = ["no effect" if n == "none" else n.replace("+", " with ") for n in names]
    listing = " and ".join([", ".join(causes[:-1]), causes[-1]])
    if expected.nats < _FAINT * entropy:
        text = f"no manoeuvre within the limits separates {listing}; the closest is {m.name}"
    else:
        share = "over 0.99" if expected.truth_probability > 0.99 else f"{expected.truth_probability:.2f}"
        text = f"{m.name}, to separate {listing}; expected probability of the true hypothesis afterwards: {share}"
    if unresolved and len(channels) == 1:
        other = "speed" if channels == ("accel",) else "accel"
        text += f"; {', '.join(unresolved)} can only be separated with {other} in the log as well"
    return text[0].upper() + text[1:] + "."
