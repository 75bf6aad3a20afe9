"""The folder of a trial: its settings, the truths apart from the answers, and one small file per answer.

`trial.json`, `truth/case_00012.json`, `answers/NAME/case_00012.json`, and if they are kept `logs/case_00012.csv`. Every
file appears whole or not at all, so every file that an interruption leaves is valid. Each JSON file is sealed and names
its trial, case and answerer: a file that was damaged, or moved to another's place, is rejected.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from avtorch.blindtest.answers import SCHEMAS, read_answer
from avtorch.errors import InputError
from avtorch.io import Damaged, Log, Sealed, fingerprint, read_sealed, write_sealed

TRIAL, TRUTH, ANSWER = "avtorch.trial/2", "avtorch.trial.truth/1", "avtorch.trial.answer/1"
"""Schemas of its files."""

_MOST = 16 * 2**20
_ELSEWHERE = "needs another folder"
_DRAW_AGAIN = "remove it to have the case drawn again, or use another folder"
_ANSWER_AGAIN = "remove it to have the case answered again, or use another folder"


class Drawn(Protocol):
    """What is kept as the truth of number `index`: a case, or a recording with an effect in front of it."""

    @property
    def index(self) -> int: ...

    def truth(self) -> dict[str, Any]: ...


class TrialFolder:
    """Paths and files of a trial kept in `root`; call `settle` first, as the files belong to its settings."""

    def __init__(self, root: Path, settings: Mapping[str, Any] | None = None) -> None:
        self.root = root
        self._trial = None if settings is None else fingerprint(settings)

    def settle(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Store the settings, or compare them with the stored ones; returns them as read from JSON.

        Raises `InputError` where the folder is of another trial, naming what differs, or cannot be read.
        """
        path = self.root / "trial.json"
        wanted = json.loads(json.dumps(settings))
        self._trial = fingerprint(wanted)
        if not os.path.lexists(path):
            write_sealed(path, wanted, schema=TRIAL, of={})
            return wanted
        found = read_sealed(path, schema=TRIAL, most=_MOST, remedy=_ELSEWHERE).content
        if not isinstance(found, dict):
            raise InputError(f"{path}: holds no settings; {_ELSEWHERE}")
        for key in sorted(wanted.keys() | found.keys()):
            if found.get(key) != wanted.get(key):
                raise InputError(
                    f"{self.root}: holds a trial with {key} {found.get(key)!r}; found {wanted.get(key)!r}, "
                    "needs the same, or another folder"
                )
        return wanted

    def truth_path(self, index: int) -> Path:
        return self.root / "truth" / f"{case_name(index)}.json"

    def log_path(self, index: int) -> Path:
        return self.root / "logs" / f"{case_name(index)}.csv"

    def answer_path(self, answerer: str, index: int) -> Path:
        return self.root / "answers" / answerer / f"{case_name(index)}.json"

    def missing(self, index: int, answerers: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The methods without an answer to the case, and a sentence on each damaged answer.

        All are missing where there is no truth. Raises `InputError` for a damaged truth: it may have been changed after
        the answers were known.
        """
        if not os.path.lexists(self.truth_path(index)):
            return tuple(answerers), ()
        truth, missing, damaged = self.truth(index), [], []
        for name in answerers:
            path = self.answer_path(name, index)
            if not os.path.lexists(path):
                missing.append(name)
                continue
            try:
                self._answer(name, index, truth)
            except Damaged as fault:
                # unlike a truth, an answer can be computed again
                missing.append(name)
                damaged.append(f"{str(fault).partition(';')[0]}; the case was answered again.")
        return tuple(missing), tuple(damaged)

    def truth(self, index: int) -> dict[str, Any]:
        """Read a truth. Raises `InputError` for one that is missing, damaged, or of another case or trial."""
        return self._truth(index)["truth"]

    def answer(self, answerer: str, index: int) -> dict[str, Any]:
        """Read what `keep_answer` wrote. Raises `InputError` for a file that is missing, damaged, or of another
        case."""
        return self._answer(answerer, index, self.truth(index))

    def keep_truth(self, case: Drawn, *, log: bytes | None = None) -> None:
        """Write the truth, and the checksum of the `log` that is kept beside it.

        Raises `InputError` where this case differed when it was answered before.
        """
        path, truth = self.truth_path(case.index), case.truth()
        if os.path.lexists(path) and self.truth(case.index) != json.loads(json.dumps(truth)):
            raise InputError(
                f"{path}: the case comes out otherwise than when it was drawn before; the reference vehicle has "
                "changed since, needs another folder"
            )
        kept = {"truth": truth, "log_sha256": None if log is None else hashlib.sha256(log).hexdigest()}
        write_sealed(path, kept, schema=TRUTH, of=self._of(case.index))

    def keep_answer(
        self, answerer: str, index: int, answer: Mapping[str, Any] | None, *, error: str | None, **spent: float
    ) -> None:
        """Write an answer, or None with the `error` raised in its place, and the time it `spent`."""
        kept = {"answer": answer, "error": error, **spent}
        path = self.answer_path(answerer, index)
        write_sealed(path, kept, schema=ANSWER, of=self._of(index, answerer))

    def kept_log(self, index: int, signals: Sequence[str]) -> Log | None:
        """The stored log, with the channels in `signals`; None where no log was stored, it was changed since, or its
        truth is missing."""
        path = self.log_path(index)
        if not path.exists() or not os.path.lexists(self.truth_path(index)):
            return None
        if hashlib.sha256(path.read_bytes()).hexdigest() != self._truth(index)["log_sha256"]:
            return None
        log = Log.read(path)
        accel, speed = (getattr(log, name) if name in signals else None for name in ("accel", "speed"))
        # bit for bit as `Case.log` makes it
        return Log.from_arrays(
            name=case_name(index),
            time=log.time,
            accel_cmd=log.accel_cmd,
            accel=accel,
            speed=speed,
            engaged=log.engaged.astype(int),
        )

    def _of(self, index: int, answerer: str | None = None) -> dict[str, Any]:
        assert self._trial is not None, "the trial's settings come first"
        return {"trial": self._trial, "case": index, **({} if answerer is None else {"answerer": answerer})}

    def _read(self, path: Path, schema: str, of: Mapping[str, Any], remedy: str) -> Any:
        found: Sealed = read_sealed(path, schema=schema, most=_MOST, remedy=remedy)
        for key, value in of.items():
            if found.of.get(key) != value:
                raise Damaged(f"{path}: is of another {key}; {remedy}")
        return found.content

    def _truth(self, index: int) -> dict[str, Any]:
        path = self.truth_path(index)
        found = self._read(path, TRUTH, self._of(index), _DRAW_AGAIN)
        if not isinstance(found, dict) or set(found) != {"truth", "log_sha256"} or not isinstance(found["truth"], dict):
            raise Damaged(f"{path}: holds no truth; {_DRAW_AGAIN}")
        return found

    def _answer(self, answerer: str, index: int, truth: Mapping[str, Any]) -> dict[str, Any]:
        path = self.answer_path(answerer, index)
        found = self._read(path, ANSWER, self._of(index, answerer), _ANSWER_AGAIN)
        fault = _fault(found, truth)
        if fault is not None:
            raise Damaged(f"{path}: {fault}; {_ANSWER_AGAIN}")
        return found


def case_name(index: int) -> str:
    return f"case_{index:05d}"


def _fault(kept: Any, truth: Mapping[str, Any]) -> str | None:
    """The fault in the content of an answer's file, or None."""
    if not isinstance(kept, dict) or set(kept) != {"answer", "error", "seconds", "cpu_seconds"}:
        return "holds no answer"
    for key in ("seconds", "cpu_seconds"):
        if type(kept[key]) not in (int, float) or not math.isfinite(kept[key]) or kept[key] < 0:
            return f"{key} is no finite number of 0 or more"
    if (kept["answer"] is None) != isinstance(kept["error"], str) or not (
        kept["error"] is None or isinstance(kept["error"], str)
    ):
        return "needs an answer, or the error that came in its place"
    try:
        read_answer(truth, kept["answer"])
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        return f"the answer is not of {' or '.join(SCHEMAS)} ({type(error).__name__})"
    return None
