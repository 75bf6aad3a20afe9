"""A file of finished fits, from which an interrupted search continues.

The file states what its fits belong to: the content of the logs and every setting that changes a fit. A fit is reused
only if it started from exactly the same values, bit for bit; a search that takes another path, for instance under a
budget, makes its own fits.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
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

SCHEMA = "avtorch.fits/2"
MOST = 16 * 2**20
"""Limit on the bytes of a file of fits; a search makes some tens of fits, of a few hundred bytes each."""

REMEDY = "remove it to begin anew (avtorch diagnose --no-resume), or use another folder"

_ENTRY = {"name", "onset", "inputs", "z", "noise", "log_prior"}
_LARGEST = 64  # most coordinates of a fit


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
    """The fits of one search; with `path` None nothing is stored.

    `work`: what the fits belong to, from `fitted_work`. Raises `InputError` for a file that is damaged, that is not a
    file of fits, or that belongs to other work, and states the difference.
    """

    def __init__(self, path: str | os.PathLike[str] | None, work: Mapping[str, Any] | None = None) -> None:
        self.path, self.work = None if path is None else Path(path), dict(work or {})
        self._done: dict[str, dict[str, Any]] = {}
        # this includes a dangling symlink
        if self.path is not None and os.path.lexists(self.path):
            self._done = {entry["inputs"]: entry for entry in read_fits(self.path, self.work)}

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
        write_sealed(self.path, {"fits": list(self._done.values())}, schema=SCHEMA, of=self.work)


def read_fits(path: Path, work: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The entries of a file of fits, each checked in shape and type.

    Raises `InputError` as `Checkpoint` does.
    """
    found = read_sealed(path, schema=SCHEMA, most=MOST, remedy=REMEDY)
    other = difference(found.of, work)
    if other is not None:
        raise InputError(f"{path}: was begun with {other}; needs the same logs and settings, or {REMEDY}")
    content = found.content
    if not isinstance(content, dict) or set(content) != {"fits"} or not isinstance(content["fits"], list):
        raise InputError(f"{path}: holds no list of fits; {REMEDY}")
    for i, entry in enumerate(content["fits"]):
        for wrong in _faults(entry):
            raise InputError(f"{path}: fit {i}: {wrong}; {REMEDY}")
    return content["fits"]


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


def _is_number(x: Any) -> bool:
    return type(x) in (int, float) and math.isfinite(x)
