"""Fits that are done, kept in a file, so that a search that was cut off goes on where it was."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError
from avtorch.gap.likelihood.candidate import Candidate
from avtorch.gap.likelihood.earlier import whitener
from avtorch.gap.likelihood.fit import finish
from avtorch.gap.likelihood.noise_fit import NoiseFit
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.search.found import Found
from avtorch.io import write_json

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Kept:
    """A fit that has come to rest: the mode `z` (coordinate,), its `noise`, and the noise's `log_prior`."""

    z: Float
    noise: NoiseModel
    log_prior: float

    def found(self, candidate: Candidate, onset: int | None) -> Found:
        """All that follows from it."""
        record = candidate.record
        white = whitener(record, self.noise, onset=onset)
        fit = finish(candidate, white, self.z, onset)
        rows = white.row_likelihoods(fit.errors)
        noise = NoiseFit(self.noise, self.log_prior, rows, {})
        likelihood = float(rows.sum())
        return Found.of(candidate, fit, noise, fit.log_evidence + self.log_prior, likelihood, onset)


class Checkpoint:
    """Fits in the order of a search, which is the same every time; `path` None: nothing is kept.

    Raises `InputError` for a file that is not one of its own.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._done: list[dict[str, Any]] = []
        self._turn = 0
        if path is None or not path.exists():
            return
        try:
            self._done = json.loads(path.read_text(encoding="utf-8"))["fits"]
        except (ValueError, KeyError, TypeError):
            raise InputError(f"{path}: is not a file of fits; remove it to begin anew") from None

    def next(self, name: str, onset: int | None) -> Kept | None:
        """The next fit, if the file has it."""
        if self._turn >= len(self._done):
            return None
        entry = self._done[self._turn]
        if (entry.get("name"), entry.get("onset")) != (name, onset):
            # the search took another way (a budget that ended earlier): what follows is made anew
            self._done = self._done[: self._turn]
            return None
        self._turn += 1
        noise = dict(entry["noise"])
        return Kept(np.array(entry["z"]), NoiseModel(**noise), float(entry["log_prior"]))

    def keep(self, name: str, onset: int | None, fit: Kept) -> None:
        """One more fit is done."""
        entry = {"name": name, "onset": onset, "z": fit.z.tolist(), "noise": asdict(fit.noise)}
        self._done.append(entry | {"log_prior": fit.log_prior})
        self._turn = len(self._done)
        if self.path is not None:
            write_json(self.path, {"fits": self._done})
