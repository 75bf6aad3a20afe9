"""The answer of a diagnosis: hypotheses with probabilities, the verdict, the gap, and the repaired simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch

from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.gap.quantity import Quantity, frame_of, plain, unit_of
from avtorch.gap.result import sentences
from avtorch.gap.result.findings import Findings
from avtorch.gap.result.hypotheses import plausibility
from avtorch.gap.simulator.effect import EFFECTS
from avtorch.gap.simulator.plant import GapPlant
from avtorch.inference.chains import effective_sample_size, nested_rhat, normal_scores
from avtorch.io import Log, answer_set, atomic, write_json

if TYPE_CHECKING:
    import pandas
    from arviz import InferenceData

DIAGNOSIS_FILES = (
    "diagnosis.json",
    "plant.toml",
    "plant.autoware.yaml",
    "plant.autoware.csv",
    "plant.openpilot.yaml",
    "plant.sumo.xml",
    "plant.carla.yaml",
    "manoeuvre.csv",
    "report.html",
    "credibility.html",
    "credibility.md",
)
"""Every file that a written diagnosis may contain."""


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Displayed, Findings):
    """What the simulator lacks, according to a log; `str()` states it in a few sentences.

    - `candidates`: the hypotheses as `listed_candidates` orders them, whatever the order given
    - `simulator`: the user's own, with `T_L` and `K_L` fitted without any effect; `plant`: the same with the verdict's
      effects, at the posterior mode, and a `free_form` where that foretells more; None where there is neither
    - `free_form`: its effects, none where `plant` only has the gain of free runs; None where it has neither
    - `assumed`: draws (draw,) of the simulator's `T_L` [s] and `K_L`; `belief`: draws (draw,) of the parameters of
      `plant`, or of `simulator` where there is none, by its own names; `draws`: posterior of the winner's parameters
      (chain, draw) by the table's names
    - `where`, `shrinkage`: where the gap lies, and how far it shrinks on held-out folds; empty where there is no gap,
      None where the drives are too short to split or nothing was named
    - `budget`: what each cause contributes to the gap; None where the drives are too short to hold out blocks
    - `parts`: the named effects, and beside them the force map of the car, a part without a name
    - `traces`: the drives beside the rollouts of `simulator` and `plant`
    - `contenders`: predictive models of the alias set, as far as it was fitted; where held-out blocks selected effects,
      of the repaired simulator and what could take its place
    - `next_experiment`, `setting`: objects as in `diagnosis.json`, None where they were not requested
    - `remaining`: with the default baseline, the hypotheses given that `dead_time` is in the simulator
    - `onset_s`: onset of the effect, on the own clock of log number `onset_log`; `onset_from_start_s`: from its first
      row, the time scale of `gain_change` in `plant`
    - `complete` False: the budget ended the search; `scope`: what was tried. Where that is not everything,
      probabilities cover what was tried, and `unknown` includes the causes that were not
    - `alarms`: what `avtorch estimate` raised on these drives, where that was given; it is drawn and changes nothing

    The verdict is the budget's where there is one, else the most probable hypothesis.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=late).log()
        >>> found = diagnose(log, effects=["dead_time"], pairs=False)
        >>> print(str(found).split(". ")[0].splitlines()[0])
        The simulator lacks this (probability over 0.99): commands act 0.39 s late (dead_time).
        >>> [path.name for path in found.write("out")]
        ['diagnosis.json', 'plant.toml']
    """

    def __str__(self) -> str:
        """The sentences of the terminal, one per line."""
        lines = [
            sentences.headline(self),
            *sentences.tested(self),
            *sentences.budget(self),
            *self.winner.implausible,
            self.verdict.why,
            sentences.aliases(self),
            *sentences.onset(self),
            *sentences.where(self),
        ]
        lines += [*sentences.moved(self), *sentences.gap(self), *sentences.shrinkage(self), *sentences.to_set(self)]
        return "\n".join([*lines, *sentences.to_drive(self), *sentences.remains(self), *self.notes])

    def overview(self) -> Card:
        """The verdict, what the gap is, and the parameters of the car as diagnosed; `str()` has all sentences."""
        gap = sentences.gap(self)[:1]
        return Card(f"Diagnosis of {self.log.name}: {sentences.headline(self)}", tuple(gap), self.summary())

    def summary(self) -> Frame:
        """Parameters of `plant`, or of `simulator` where nothing was named: unit, mean, sd, 5 and 95 % quantiles.

        Where `posterior="sgld"` made draws: their nested R-hat and effective numbers, too.
        """
        draws = self.belief if self.belief else self.assumed
        values = {name: Quantity.of_draws(x) for name, x in (draws or {}).items()} or dict(self.baseline)
        columns = dict(frame_of(values).columns)
        if self.draws:
            chains = [self.draws.get(name, self.draws.get(name.rpartition(".")[2])) for name in values]
            tensors = [None if x is None else torch.as_tensor(np.asarray(x, float)) for x in chains]
            columns["rhat"] = [None if x is None else float(nested_rhat(x)) for x in tensors]
            columns["ess_bulk"] = [
                None if x is None else float(effective_sample_size(normal_scores(x))) for x in tensors
            ]
        return Frame(columns)

    def to_dataframe(self) -> pandas.DataFrame:
        """A row a hypothesis, the most probable first: its probability, log evidence over none, whether it is the
        verdict or an alias of it. Needs ``pip install 'avtorch[pandas]'``."""
        rows = [
            {
                "hypothesis": c.name,
                "probability": c.probability,
                "log_evidence": c.log_evidence,
                "verdict": c.name == self.verdict.name,
                "alias": c.name in self.verdict.alias_set,
            }
            for c in self.candidates
        ]
        return Frame.of_rows(rows).to_dataframe()

    def to_dict(self) -> dict[str, Any]:
        """The object of `diagnosis.json`, schema `avtorch.diagnosis/2`, or `/1` where there is no budget.

        Beyond the schema's keys it has `parts` (name or null, family, form, size and probability), `moved`, `onset_s`,
        `plausible` and `plausibility` of each effect, the last two of the verdict, `onset_from_start_s`, `setting`,
        `remaining`, `complete`, `not_tried` (`effects` by name; `pairs`, of which "all", "some", "none" were tried) and
        `notes`.
        """
        own = ("log", "budget", "baseline", "gap", "where", "onset_s", "onset_from_start_s", "parts", "shrinkage")
        own += ("next_experiment", "setting", "remaining", "complete", "notes")
        out = {
            "schema": f"avtorch.diagnosis/{1 if self.budget is None else 2}",
            "effects": self.candidates,
            "verdict": plain(self.verdict) | plausibility(self.winner.implausible),
            "not_tried": self.scope,
        }
        out |= {key: getattr(self, key) for key in own} | ({} if self.tested is None else {"simulator": self.tested})
        return plain(out)

    def write(self, folder: str | PathLike[str]) -> list[Path]:
        """Write `diagnosis.json` and, where there is a plant, `plant.toml`; returns the files.

        The plant's effects act from the start, even where the log has an onset; a comment in `plant.toml` then states
        this (an effect with an onset of its own has it among its parameters). Another names the random effects. All
        files of an earlier diagnosis in the folder are removed, including its page, exports and manoeuvre: write these
        afterwards, or all of them within one `avtorch.io.answer_set(folder, DIAGNOSIS_FILES)`.
        Raises `InputError` where the folder cannot be written or a number is not finite; the earlier diagnosis is then
        kept.
        """
        names = ["diagnosis.json"] if self.plant is None else ["diagnosis.json", "plant.toml"]
        with answer_set(folder, DIAGNOSIS_FILES) as staged:
            if self.plant is not None:
                with atomic(staged / "plant.toml") as stream:
                    stream.write(self._comments(self.plant) + self.plant.to_toml())
            write_json(staged / "diagnosis.json", self.to_dict())
        return [Path(folder) / name for name in names]

    def _comments(self, plant: GapPlant) -> str:
        """Of `plant.toml`: on effects with an onset within the log, and on those that chance decides."""
        own = {e.name for e in (*EFFECTS.values(), *plant.effects) if e.own_onset is not None}
        late = " and ".join(name for name in self.verdict.names if name not in own)
        random = ", ".join(e.name for e in plant.effects if e.random)
        out = ""
        if self.onset_s is not None and late:
            out += f"# In the log {late} from {sentences.moment(self)} on; in this plant from the start.\n"
        if random:
            out += f"# By chance, drawn anew in every drive and not part of `closed`: {random}.\n"
        return out

    def to_arviz(self) -> InferenceData:
        """The winner's draws as `arviz.InferenceData`, one variable (chain, draw) per parameter, its unit in `attrs`.

        Needs `pip install 'avtorch[arviz]'`. Raises `InputError` where there are no draws.
        """
        from avtorch.inference.arviz_export import inference_data

        if not self.draws:
            raise InputError(
                f"draws: the diagnosis has none for {self.verdict.name}; only effects have posterior draws"
            )
        draws = {name: np.asarray(x) for name, x in self.draws.items()}
        units = {name: unit_of(name) for name in draws}
        attributes = {"candidate": self.verdict.name, "log": self.log.name}
        return inference_data(draws, ("chain", "draw"), units=units, attributes=attributes)


class SimulatorBesideCar(Protocol):
    """A car's drives and a simulator that is not made of effects: diagnosed by `logs` with `plant` as the baseline."""

    @property
    def logs(self) -> Sequence[Log]: ...
    @property
    def plant(self) -> GapPlant: ...
    def told(self, found: Diagnosis) -> Diagnosis: ...


@runtime_checkable
class BlackBoxSimulator(Protocol):
    """A simulator that is not made of effects; `avtorch.external.ExternalSimulator` is one."""

    def beside(self, logs: Sequence[Log], progress: Callable[[str, int, int], None] | None) -> SimulatorBesideCar: ...
