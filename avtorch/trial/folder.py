"""The folder of a trial: its settings, the truths apart from the answers, and one small file per answer.

`trial.json`, `truth/case_00012.json`, `answers/NAME/case_00012.json`, and if they are kept `logs/case_00012.csv`. Every
file appears whole or not at all, so whatever is there after an interruption counts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from avtorch.blindtest import Case
from avtorch.errors import InputError
from avtorch.io import Log, write_json

SCHEMA = "avtorch.trial/1"


class TrialFolder:
    """Paths and files of a trial kept in `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def settle(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Remember the settings, or hold them against those that are there; returns them as JSON has them.

        Raises `InputError` where the folder is of another trial, naming what differs.
        """
        path = self.root / "trial.json"
        wanted = {"schema": SCHEMA, **json.loads(json.dumps(settings))}
        if not path.exists():
            write_json(path, wanted)
            return wanted
        found = _read(path)
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

    def missing(self, index: int, answerers: Sequence[str]) -> tuple[str, ...]:
        """Those who have not answered the case; all of them where its truth is not there."""
        if not self.truth_path(index).exists():
            return tuple(answerers)
        return tuple(name for name in answerers if not self.answer_path(name, index).exists())

    def truth(self, index: int) -> dict[str, Any]:
        return _read(self.truth_path(index))

    def answer(self, answerer: str, index: int) -> dict[str, Any]:
        return _read(self.answer_path(answerer, index))

    def keep_truth(self, case: Case) -> None:
        """Write the truth. Raises `InputError` where the same case was another one when it was answered before."""
        path, told = self.truth_path(case.index), case.truth()
        if path.exists() and _read(path) != json.loads(json.dumps(told)):
            raise InputError(
                f"{path}: the case comes out otherwise than when it was drawn before; the reference vehicle has "
                "changed since, needs another folder"
            )
        write_json(path, told)

    def kept_log(self, index: int, signals: Sequence[str]) -> Log | None:
        """The log that was kept, with the witnesses in `signals`; None where none was, or its truth is missing."""
        path = self.log_path(index)
        if not path.exists() or not self.truth_path(index).exists():
            return None
        log = Log.read(path)
        accel, speed = (getattr(log, name) if name in signals else None for name in ("accel", "speed"))
        # as `Case.log` makes it, to the bit
        return Log.from_arrays(
            name=case_name(index), time=log.time, accel_cmd=log.accel_cmd, accel=accel, speed=speed
        )  # fmt: skip


def case_name(index: int) -> str:
    return f"case_{index:05d}"


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as fault:
        raise InputError(f"{path}: cannot be read ({fault}); needs the file this trial wrote") from None
