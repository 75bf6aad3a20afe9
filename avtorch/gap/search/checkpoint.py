"""A file of what is finished, from which an interrupted search continues: fits, and steps of the budget's selection.

The file states what these belong to: the content of the logs and every setting that changes a fit. A fit or a step is
reused only if it started from exactly the same values, bit for bit; a search that takes another path, for instance
under a budget, makes its own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.likelihood.gauss_newton import finish
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_fit import NoiseFit
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import whitening_filter
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.search.fitted_work import difference
from avtorch.io import fingerprint, read_sealed, write_sealed

SCHEMA = "avtorch.fits/3"
MOST = 16 * 2**20
"""Limit on the bytes of a file; a search makes some tens of fits and steps, of some hundred to thousand bytes each."""

REMEDY = "remove it to begin anew (avtorch diagnose --no-resume), or use another folder"

_ENTRY = {"name", "onset", "inputs", "z", "noise", "log_prior"}
_STEP = {"inputs", "effects", "onsets", "z", "nats", "block_nats", "aliases"}
_LARGEST = 64  # most coordinates of a fit
_LARGEST_STEP = 4096  # most coordinates or blocks of a step


@dataclass(frozen=True, eq=False)
class StoredFit:
    """A converged fit: the mode `z` (coordinate,), its `noise`, and the noise's `log_prior`."""

    z: FloatArray
    noise: NoiseModel
    log_prior: float

    def fitted_model(self, hypothesis: Hypothesis, onset: int | None) -> FittedModel:
        """The fitted model that results from this fit."""
        record = hypothesis.record
        white = whitening_filter(record, self.noise, onset=onset)
        fit = finish(hypothesis, white, self.z, onset)
        rows = white.row_likelihoods(fit.errors)
        noise = NoiseFit(self.noise, self.log_prior, rows, {})
        likelihood = float(rows.sum())
        return FittedModel.of(hypothesis, fit, noise, fit.log_evidence + self.log_prior, likelihood, onset)


@dataclass(frozen=True, eq=False)
class StoredStep:
    """A step of the budget's selection: the names of the model's `effects`, the last of which entered, and its fit.

    `onsets` [s] by effect, coordinates `z` (coordinate,), cost `nats` with the prior and `block_nats` (block,) without,
    `aliases` of the effect that entered. Without `effects`: none entered.
    """

    effects: tuple[str, ...] = ()
    onsets: Mapping[str, float] = field(default_factory=dict)
    z: FloatArray = field(default_factory=lambda: np.zeros(0))
    nats: float = 0.0
    block_nats: FloatArray = field(default_factory=lambda: np.zeros(0))
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class FitKey:
    """The start of a fit; `inputs` is the fingerprint of everything that determines its result."""

    hypothesis: Hypothesis
    onset: int | None
    inputs: str

    @classmethod
    def of(cls, hypothesis: Hypothesis, z: FloatArray, noise: NoiseModel, onset: int | None, rounds: int) -> FitKey:
        data = hypothesis.record.fingerprint
        return cls(hypothesis, onset, fingerprint(data, hypothesis.name, z, noise, onset, rounds))


class Checkpoint:
    """The fits and steps of one search; with `path` None nothing is stored.

    `work`: what the fits belong to, from `fitted_work`. Raises `InputError` for a file that is damaged, that is not a
    file of fits, or that belongs to other work, and states the difference.
    """

    def __init__(self, path: str | os.PathLike[str] | None, work: Mapping[str, Any] | None = None) -> None:
        self.path, self.work = None if path is None else Path(path), dict(work or {})
        self._done: dict[str, dict[str, Any]] = {}
        self._steps: dict[str, dict[str, Any]] = {}
        # this includes a dangling symlink
        if self.path is not None and os.path.lexists(self.path):
            kept = _read(self.path, self.work)
            self._done, self._steps = ({x["inputs"]: x for x in kept[name]} for name in ("fits", "steps"))

    def next(self, start: FitKey | None) -> StoredFit | None:
        """The stored fit with this start, or None."""
        entry = None if start is None else self._done.get(start.inputs)
        if start is None or entry is None:
            return None
        own = (start.hypothesis.name, start.onset, start.hypothesis.size)
        if (entry["name"], entry["onset"], len(entry["z"])) != own:
            raise InputError(f"{self.path}: the fit of {entry['name']} does not match its recorded start; {REMEDY}")
        return StoredFit(np.array(entry["z"]), NoiseModel(**entry["noise"]), float(entry["log_prior"]))

    def start(
        self, hypothesis: Hypothesis, z: FloatArray, noise: NoiseModel, onset: int | None, rounds: int
    ) -> FitKey | None:
        """The start of a fit; None where nothing is stored."""
        return None if self.path is None else FitKey.of(hypothesis, z, noise, onset, rounds)

    def keep(self, start: FitKey | None, fit: StoredFit) -> None:
        """Store one more finished fit."""
        if self.path is None or start is None:
            return
        self._done[start.inputs] = {
            "name": start.hypothesis.name,
            "onset": start.onset,
            "inputs": start.inputs,
            "z": fit.z.tolist(),
            "noise": asdict(fit.noise),
            "log_prior": fit.log_prior,
        }
        self._write(self.path)

    def step(self, inputs: str) -> StoredStep | None:
        """The stored step with these inputs, a fingerprint, or None."""
        entry = self._steps.get(inputs)
        if entry is None:
            return None
        z, block_nats = (np.array(entry[name], float) for name in ("z", "block_nats"))
        names, aliases = (tuple(entry[name]) for name in ("effects", "aliases"))
        return StoredStep(names, entry["onsets"], z, float(entry["nats"]), block_nats, aliases)

    def keep_step(self, inputs: str, step: StoredStep) -> None:
        """Store one more finished step."""
        if self.path is None:
            return
        self._steps[inputs] = {
            "inputs": inputs,
            "effects": list(step.effects),
            "onsets": dict(step.onsets),
            "z": step.z.tolist(),
            "nats": step.nats,
            "block_nats": step.block_nats.tolist(),
            "aliases": list(step.aliases),
        }
        self._write(self.path)

    def _write(self, path: Path) -> None:
        content = {"fits": list(self._done.values()), "steps": list(self._steps.values())}
        write_sealed(path, content, schema=SCHEMA, of=self.work)


def read_fits(path: Path, work: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The fits of a file, each checked in shape and type, as its steps are.

    Raises `InputError` as `Checkpoint` does.
    """
    return _read(path, work)["fits"]


def _read(path: Path, work: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """The fits and the steps of a file."""
    found = read_sealed(path, schema=SCHEMA, most=MOST, remedy=REMEDY)
    other = difference(found.of, work)
    if other is not None:
        raise InputError(f"{path}: was begun with {other}; needs the same logs and settings, or {REMEDY}")
    content = found.content
    lists = isinstance(content, dict) and set(content) == {"fits", "steps"}
    if not lists or not all(isinstance(entries, list) for entries in content.values()):
        raise InputError(f"{path}: holds no lists of fits and steps; {REMEDY}")
    for one, name, faults in (("fit", "fits", _faults), ("step", "steps", _step_faults)):
        for i, entry in enumerate(content[name]):
            for wrong in faults(entry):
                raise InputError(f"{path}: {one} {i}: {wrong}; {REMEDY}")
    return content


def _faults(entry: Any) -> Iterable[str]:
    """Faults of an entry, in words."""
    if not isinstance(entry, dict) or set(entry) != _ENTRY:
        yield f"is no object of {', '.join(sorted(_ENTRY))}"
        return
    if not all(isinstance(entry[key], str) for key in ("name", "inputs")):
        yield "name or inputs is no string"
    onset = entry["onset"]
    if onset is not None and (type(onset) is not int or not 0 <= onset < 2**53):
        yield "onset is no row"
    z = entry["z"]
    if not isinstance(z, list) or len(z) > _LARGEST or not all(map(_is_number, z)):
        yield f"z is no list of at most {_LARGEST} finite numbers"
    noise, known = entry["noise"], {f.name for f in fields(NoiseModel)}
    if not isinstance(noise, dict) or set(noise) != known or not all(map(_is_number, noise.values())):
        yield f"noise is not {len(known)} finite numbers by name"
    elif any(value < 0 for key, value in noise.items() if key.endswith(("_sd", "_lag"))):
        yield "noise has a standard deviation or a lag below 0"
    elif any(value <= 0 for key, value in noise.items() if key.endswith("_time")):
        yield "noise has a time constant that is not above 0"
    if not _is_number(entry["log_prior"]):
        yield "log_prior is no finite number"


def _step_faults(entry: Any) -> Iterable[str]:
    """Faults of a step, in words."""
    if not isinstance(entry, dict) or set(entry) != _STEP:
        yield f"is no object of {', '.join(sorted(_STEP))}"
        return
    if not isinstance(entry["inputs"], str):
        yield "inputs is no string"
    for key in ("effects", "aliases"):
        if not isinstance(entry[key], list) or not all(isinstance(name, str) for name in entry[key]):
            yield f"{key} is no list of names"
            return
    onsets = entry["onsets"]
    if (
        not isinstance(onsets, dict)
        or not set(onsets) <= set(entry["effects"])
        or not all(map(_is_number, onsets.values()))
    ):
        yield "onsets is not finite numbers by effect"
    for key in ("z", "block_nats"):
        values = entry[key]
        if not isinstance(values, list) or len(values) > _LARGEST_STEP or not all(map(_is_number, values)):
            yield f"{key} is no list of at most {_LARGEST_STEP} finite numbers"
    if not _is_number(entry["nats"]):
        yield "nats is no finite number"


def _is_number(x: Any) -> bool:
    return type(x) in (int, float) and math.isfinite(x)
