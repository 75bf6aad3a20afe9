"""The answer of a diagnosis: candidates with their probabilities, the verdict, the gap, and the repaired simulator."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError
from avtorch.gap.quantity import Quantity, unit_of
from avtorch.gap.result import text as words
from avtorch.gap.result.predictive_model import PredictiveModel
from avtorch.gap.result.repeatability import Repeatability
from avtorch.gap.result.shrinkage import Closed, Shrinkage
from avtorch.gap.result.traces import Traces
from avtorch.gap.result.where import Location
from avtorch.gap.search.fitted_model import Scope
from avtorch.gap.selection.verdict import (
    Candidate,
    Verdict,
    candidate_name,
    listed,
    near,
    plain,
    plausibility,
    verdict_of,
)
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log, answer_set, atomic, write_json

if TYPE_CHECKING:
    from arviz import InferenceData

__all__ = [
    "DIAGNOSIS_FILES",
    "Candidate",
    "Closed",
    "Diagnosis",
    "GapSize",
    "LogFacts",
    "Quantity",
    "Shrinkage",
    "Verdict",
    "candidate_name",
    "listed",
    "near",
    "verdict_of",
]

DIAGNOSIS_FILES = (
    "diagnosis.json",
    "plant.toml",
    "plant.autoware.yaml",
    "plant.openpilot.yaml",
    "manoeuvre.csv",
    "report.html",
)
"""Every file that a diagnosis may consist of."""

SIGNALS = ("accel_cmd", "accel", "speed", "jerk", "spacing", "lead_speed", "lead_accel", "grade")


@dataclass(frozen=True)
class LogFacts:
    """What was looked at: usable or not, all `rows`; `seconds` without gaps; `signals` in any of the logs.

    `name`: the logs' own, files without their folders, which are nobody's business where an answer is read. Of rows
    that count: `speeds` [m/s], all but the slowest and the fastest hundredth, `commands` [m/s²], all; None: not there.
    `epochs_s`: when each log starts, on its own clock [s].
    """

    rows: int
    segments: int
    seconds: float
    rate_hz: float
    signals: tuple[str, ...] = ()
    name: str = "log"
    speeds: tuple[float, float] | None = None
    commands: tuple[float, float] | None = None
    epochs_s: tuple[float, ...] = (0.0,)

    @classmethod
    def of(cls, logs: Log | Sequence[Log]) -> LogFacts:
        """Of one log, or of several drives of one car; the rate is then their mean by time."""
        all_ = [logs] if isinstance(logs, Log) else list(logs)
        seconds = math.fsum(log.seconds for log in all_)
        return cls(
            rows=sum(log.rows for log in all_),
            segments=sum(len(log.segments()) for log in all_),
            seconds=seconds,
            rate_hz=math.fsum(log.rate_hz * log.seconds for log in all_) / seconds,
            signals=tuple(name for name in SIGNALS if any(getattr(log, name) is not None for log in all_)),
            name=", ".join(Path(log.name).name or log.name for log in all_),
            speeds=_driven(all_, "speed", 0.01),
            commands=_driven(all_, "accel_cmd", 0.0),
            epochs_s=tuple(log.epoch_s for log in all_),
        )

    def to_dict(self) -> dict[str, Any]:
        given = {"rows": self.rows, "segments": self.segments, "seconds": self.seconds, "rate_hz": self.rate_hz}
        driven = {"speeds_mps": self.speeds, "commands_mps2": self.commands}
        told = {name: None if ends is None else list(ends) for name, ends in driven.items()}
        return given | {"signals": list(self.signals), "name": self.name, "epochs_s": list(self.epochs_s)} | told


def _driven(logs: Sequence[Log], signal: str, apart: float) -> tuple[float, float] | None:
    """Where the usable rows of a signal lie, a share `apart` of them at either end left out."""
    rows = [values[log.usable] for log in logs if (values := getattr(log, signal)) is not None]
    joined = np.concatenate(rows) if rows else np.zeros(0)
    if not len(joined):
        return None
    low, high = np.quantile(joined, (apart, 1 - apart))
    return float(low), float(high)


@dataclass(frozen=True)
class GapSize:
    """How far the baseline is from the log, and how far noise alone would be (`floor`); None where not measured.

    Rollouts go over `horizon_s` [s]; accelerations [m/s²], speed [m/s]. `detected`: there is a gap, at `p_value`.
    `repeats`: the floor as commands that were given twice tell it, None where there are none.
    """

    detected: bool
    p_value: float | None = None
    one_step_rmse: float | None = None
    one_step_floor: float | None = None
    rollout_rmse_accel: float | None = None
    rollout_floor_accel: float | None = None
    rollout_rmse_speed: float | None = None
    horizon_s: float | None = None
    repeats: Repeatability | None = None

    def to_dict(self) -> dict[str, Any]:
        return {
            "one_step": {"rmse": self.one_step_rmse, "floor": self.one_step_floor},
            "rollout": {
                "rmse_accel": self.rollout_rmse_accel,
                "floor_accel": self.rollout_floor_accel,
                "rmse_speed": self.rollout_rmse_speed,
                "horizon_s": self.horizon_s,
            },
            "detected": bool(self.detected),
            "p_value": self.p_value,
            "repeats": None if self.repeats is None else self.repeats.to_dict(),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis:
    """What the simulator lacks, by a log; printed, it says so in a few sentences.

    - `candidates` are listed as `listed` has them, whatever was given
    - `simulator`: the user's own, `T_L` and `K_L` as fitted without any effect; `plant`: the same with the verdict's
      effects in, at the posterior mean, None where nothing was named
    - `assumed`: draws (draw,) of the simulator's `T_L` [s] and `K_L`; `belief`: draws (draw,) of the parameters of
      `plant`, or of `simulator` where there is none, by its own names; `draws`: posterior of the winner's parameters
      (chain, draw) by the table's names
    - `where`, `shrinkage`: where the gap lies, and how far it shrinks on parts that were held out; empty where there is
      no gap, None where the drives are too short to be parted or nothing was named
    - `traces`: the drives beside the rollouts of `simulator` and `plant`
    - `contenders`: the alias set as far as it was fitted, with what it takes to foretell another drive
    - `next_experiment`, `setting`: objects as in `diagnosis.json`, None where nobody asked
    - `remaining`: with the default baseline, the candidates for what is left once `dead_time` is in
    - `onset_s`: when the effect set in, on the own clock of log number `onset_log`; `onset_from_start_s`: from its
      first row, as a `gain_change` counts in `plant`
    - `complete` False: the budget ended the search; `scope`: what it tried, None where nobody says. Where that is not
      all, probabilities are over what was tried, and `unknown` is a cause that was not

    Raises `InputError` where verdict and candidates do not agree.
    """

    log: LogFacts
    baseline: Mapping[str, Quantity]
    gap: GapSize
    candidates: tuple[Candidate, ...]
    verdict: Verdict
    onset_s: float | None = None
    plant: GapPlant | None = None
    draws: Mapping[str, NDArray] | None = None
    simulator: GapPlant | None = None
    belief: Mapping[str, NDArray] | None = None
    assumed: Mapping[str, NDArray] | None = None
    traces: Traces | None = None
    remaining: tuple[Candidate, ...] | None = None
    where: tuple[Location, ...] = ()
    shrinkage: Shrinkage | None = None
    contenders: tuple[PredictiveModel, ...] = ()
    next_experiment: Mapping[str, Any] | None = None
    setting: Mapping[str, Any] | None = None
    complete: bool = True
    scope: Scope | None = None
    notes: tuple[str, ...] = ()
    onset_from_start_s: float | None = None
    onset_log: int = 0

    def __post_init__(self) -> None:
        if self.onset_s is not None and self.onset_from_start_s is None:
            object.__setattr__(self, "onset_from_start_s", self.onset_s - self.log.epochs_s[self.onset_log])
        object.__setattr__(self, "candidates", listed(self.candidates))
        said = self.verdict.name
        if self.probability(said) < self.candidates[0].probability - 1e-12:
            raise InputError(f"verdict: found {said}, needs the most probable, {self.candidates[0].name}")
        if said not in self.verdict.alias_set or self.verdict.abstained != (said == "unknown"):
            raise InputError(f"verdict: found {self.verdict}, needs itself in its alias set, and to abstain on unknown")

    def __str__(self) -> str:
        """The sentences of the terminal, one a line."""
        told = [
            words.headline(self),
            *self.winner.implausible,
            self.verdict.why,
            words.aliases(self),
            *words.onset(self),
            *words.where(self),
        ]
        told += [*words.moved(self), *words.gap(self), *words.shrinkage(self), *words.to_set(self)]
        return "\n".join([*told, *words.to_drive(self), *words.remains(self), *self.notes])

    def __repr__(self) -> str:
        return f"<Diagnosis of {self.log.name}: {words.headline(self)}>"

    @property
    def winner(self) -> Candidate:
        """The verdict's candidate."""
        return next(c for c in self.candidates if c.name == self.verdict.name)

    def probability(self, names: str | Iterable[str]) -> float:
        """Of a candidate, by name or names; 0 where it is not listed."""
        name = candidate_name(names)
        return next((c.probability for c in self.candidates if c.name == name), 0.0)

    def to_dict(self) -> dict[str, Any]:
        """The object of `diagnosis.json`; beside the schema's keys `moved`, `onset_s`, `plausible` and `plausibility`
        of each effect, the last two of the verdict, `onset_from_start_s`, `setting`, `remaining`, `complete`,
        `not_tried` (`effects` by name; `pairs`, of which "all", "some" or "none" were tried) and `notes`.
        """
        return {
            "schema": "avtorch.diagnosis/1",
            "log": self.log.to_dict(),
            "baseline": plain(self.baseline),
            "gap": self.gap.to_dict(),
            "where": [w.to_dict() for w in self.where],
            "onset_s": self.onset_s,
            "onset_from_start_s": self.onset_from_start_s,
            "effects": [c.to_dict() for c in self.candidates],
            "verdict": self.verdict.to_dict() | plausibility(self.winner.implausible),
            "shrinkage": None if self.shrinkage is None else self.shrinkage.to_dict(),
            "next_experiment": None if self.next_experiment is None else dict(self.next_experiment),
            "setting": None if self.setting is None else dict(self.setting),
            "remaining": None if self.remaining is None else [c.to_dict() for c in self.remaining],
            "complete": self.complete,
            "not_tried": None if self.scope is None else self.scope.to_dict(),
            "notes": list(self.notes),
        }

    def write(self, folder: str | PathLike[str]) -> list[Path]:
        """Publish `diagnosis.json` and, where there is a plant, `plant.toml` at the same moment; returns the files.

        The plant's effects act from the start, also where the log shows them from an onset on; a comment in
        `plant.toml` then says so (a `gain_change` has its moment among its parameters).
        All files of an earlier diagnosis in the folder go at that moment, its page, exports and manoeuvre too: write
        these after it, or all of them within one `avtorch.io.answer_set(folder, DIAGNOSIS_FILES)`. Raises `InputError`
        where the folder cannot be written or a number is not finite; the earlier diagnosis then stays.
        """
        names = ["diagnosis.json"] if self.plant is None else ["diagnosis.json", "plant.toml"]
        with answer_set(folder, DIAGNOSIS_FILES) as staged:
            if self.plant is not None:
                with atomic(staged / "plant.toml") as stream:
                    stream.write(self._late() + self.plant.to_toml())
            write_json(staged / "diagnosis.json", self.to_dict())
        return [Path(folder) / name for name in names]

    def _late(self) -> str:
        """A comment for `plant.toml` where the effects set in within the log."""
        late = " and ".join(name for name in self.verdict.names if name != "gain_change")
        if self.onset_s is None or not late:
            return ""
        return f"# In the log {late} from {words.moment(self)} on; in this plant from the start.\n"

    def to_arviz(self) -> InferenceData:
        """The winner's draws as `arviz.InferenceData`, one variable (chain, draw) a parameter, its unit in `attrs`.

        Needs `pip install 'avtorch[arviz]'`. Raises `InputError` where there are no draws.
        """
        if not self.draws:
            raise InputError(
                f"draws: the diagnosis has none of {self.verdict.name}; a posterior is kept of effects only"
            )
        with warnings.catch_warnings():
            # ArviZ 0.23 announces its successor on import
            warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
            try:
                import arviz
                import xarray
            except ImportError:
                raise InputError("arviz: not installed; to_arviz needs pip install 'avtorch[arviz]'") from None
        dims = ("chain", "draw")
        variables = {name: (dims, np.asarray(x), {"units": unit_of(name)}) for name, x in self.draws.items()}
        sizes = zip(dims, next(iter(variables.values()))[1].shape, strict=True)
        attributes = {"inference_library": "avtorch", "candidate": self.verdict.name, "log": self.log.name}
        data = xarray.Dataset(variables, coords={dim: range(size) for dim, size in sizes}, attrs=attributes)
        return arviz.InferenceData(posterior=data)
