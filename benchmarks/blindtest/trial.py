"""A trial: sealed cases, the methods that answer them, and the score. A second call answers only what is missing.

Its folder holds `trial.json` (the settings), `truth/case_00012.json`, `answers/NAME/case_00012.json` and the score,
`blindtest.json`: plain JSON files, each written whole or not at all.
"""

from __future__ import annotations

import json
import os
import re
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from avtorch.errors import InputError
from avtorch.io import Log, sole_use, write_json
from avtorch.io.answers import json_text
from benchmarks.blindtest.answers import SCHEMAS, read_answer
from benchmarks.blindtest.cases import SIGNALS, Recording, draw_case
from benchmarks.blindtest.deck import MIX
from benchmarks.blindtest.pool import worked
from benchmarks.blindtest.score import score

Answerer = Callable[[Log], Any]
"""Takes a log, returns a dict of `avtorch.diagnosis/1` or `/2`, or an `avtorch.Diagnosis`."""


def case_name(index: int) -> str:
    return f"case_{index:05d}"


def ask(answerer: Callable[[Any], Any], given: Any, truth: Mapping[str, Any]) -> dict[str, Any]:
    """One answer with what it cost. A failure is an answer too: `answer` is None then, and `error` its traceback."""
    answer = error = None
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        found = answerer(given)
        answer = dict(found if isinstance(found, Mapping) else found.to_dict())
    except Exception:
        error = traceback.format_exc()
    spent = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    if answer is not None:
        try:
            read_answer(truth, answer)  # the scorer must be able to read it
            json_text(answer)
        except (InputError, KeyError, TypeError, ValueError, AttributeError) as fault:
            why = f"the answer is not of {' or '.join(SCHEMAS)}: {type(fault).__name__}: {fault}"
            answer, error = None, f"{traceback.format_exc()}{why}"
    return {"answer": answer, "error": error, **spent}


def failures(kept: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """How many answers failed, and the last lines of up to five different errors."""
    errors = [one["error"].strip().splitlines()[-1] for one in kept if one["error"]]
    return {"failed": len(errors), "failures": sorted(set(errors))[:5]}


@dataclass(frozen=True)
class TrialFolder:
    """The files of a trial in the folder `root`."""

    root: Path

    def settle(self, settings: Mapping[str, Any]) -> None:
        """Write the settings, or compare them with those there; `InputError` names what differs."""
        path, wanted = self.root / "trial.json", json.loads(json.dumps(settings))
        if not path.exists():
            write_json(path, wanted)
            return
        found = json.loads(path.read_text(encoding="utf-8"))
        for key in sorted(wanted.keys() | found.keys()):
            if found.get(key) != wanted.get(key):
                raise InputError(
                    f"{self.root}: holds a trial with {key} {found.get(key)!r}; found {wanted.get(key)!r}, "
                    "needs the same, or another folder"
                )

    def truth_path(self, index: int) -> Path:
        return self.root / "truth" / f"{case_name(index)}.json"

    def answer_path(self, name: str, index: int) -> Path:
        return self.root / "answers" / name / f"{case_name(index)}.json"

    def missing(self, index: int, names: Sequence[str]) -> tuple[str, ...]:
        """The methods without an answer to the case; all where its truth is missing."""
        drawn = self.truth_path(index).exists()
        return tuple(name for name in names if not (drawn and self.answer_path(name, index).exists()))

    def truth(self, index: int) -> dict[str, Any]:
        return json.loads(self.truth_path(index).read_text(encoding="utf-8"))

    def answer(self, name: str, index: int) -> dict[str, Any]:
        return json.loads(self.answer_path(name, index).read_text(encoding="utf-8"))

    def keep_truth(self, index: int, truth: Mapping[str, Any]) -> None:
        """Write the truth. Raises `InputError` where this case differed when it was answered before."""
        path = self.truth_path(index)
        if path.exists() and self.truth(index) != json.loads(json_text(truth)):
            raise InputError(
                f"{path}: the case comes out otherwise than when it was drawn before; the reference vehicle has "
                "changed since, needs another folder"
            )
        write_json(path, truth)


@dataclass(frozen=True)
class _Task:
    """A case to answer by the methods that have not; with more than one process the `answerers` are pickled."""

    folder: TrialFolder
    index: int
    seed: int
    answerers: Mapping[str, Answerer]
    signals: tuple[str, ...]
    options: Mapping[str, Any]


def _answer(task: _Task) -> int:
    case = draw_case(task.index, task.seed, signals=task.signals, **task.options)
    truth, log = case.truth(), case.log(signals=task.signals)
    task.folder.keep_truth(task.index, truth)
    for name, answerer in task.answerers.items():
        write_json(task.folder.answer_path(name, task.index), ask(answerer, log, truth))
    return task.index


def run_trial(
    n: int,
    seed: int,
    out: str | os.PathLike[str],
    *,
    answerers: Mapping[str, Answerer],
    workers: int = 1,
    mix: Mapping[str, float] | None = None,
    signals: Sequence[str] = SIGNALS,
    outside: Literal["sealed", "calibration"] = "sealed",
    recorder: Recording = "ideal",
    progress: Callable[[int, int], None] | None = None,
    **draw_options: Any,
) -> dict[str, Any]:
    """Let `answerers` answer cases 0 to `n - 1` of the set `seed`; write and return `out/blindtest.json`.

    The scores are those of the first answerer; the others are under `baselines` with the same keys. Answers and truths
    are written as they are made; a rerun, also with more cases or another answerer, answers only what is missing. An
    answerer that raises, or answers outside the schema, has not answered: the case counts as wrong. After a change of
    an answerer's code, delete its folder in `out/answers` to run it again.

    Args:
        answerers: by name (letters, digits, `_`, `-`).
        workers: processes, each with one thread; more than one needs answerers that can be pickled, and a script that
            begins work under `if __name__ == "__main__"`.
        mix, outside, recorder, draw_options: as `draw_cases`.
        signals: the channels in the logs, in which a cause must show.
        progress: called with (cases done, of).

    Raises `InputError` for a folder with another trial's settings or in use by another process, and for arguments out
    of range.

    Example:
        >>> from benchmarks.blindtest.reply import reply
        >>> from benchmarks.blindtest.trial import run_trial
        >>> def always_none(log):
        ...     return reply(log, {"none": 1.0}, why="it never finds anything")
        >>> options = dict(mix={"none": 1.0}, seconds=20.0)
        >>> answer = run_trial(2, seed=1, out="trial", answerers={"always_none": always_none}, **options)
        >>> answer["false_alarm"], answer["schema"]
        (0.0, 'avtorch.blindtest/1')
    """
    names = list(answerers)
    _check(n, seed, names, workers, signals, recorder)
    if recorder != "ideal":
        draw_options |= {"recorder": recorder}
    kept = tuple(s for s in SIGNALS if s in signals)
    settings: dict[str, Any] = {"seed": seed, "signals": list(kept), "outside": outside}
    settings |= {"mix": dict(MIX if mix is None else mix), "draw": dict(sorted(draw_options.items()))}
    options = {"mix": settings["mix"], "outside": outside, **draw_options}
    folder = TrialFolder(Path(out))
    with sole_use(out, work="a blind test"):
        folder.settle(settings)
        missing = {i: folder.missing(i, names) for i in range(n)}
        tasks = [
            _Task(folder, i, seed, {name: answerers[name] for name in some}, kept, options)
            for i, some in missing.items()
            if some
        ]
        for done in counted(_answer, tasks, workers, n - len(tasks)):
            if progress:
                progress(done, n)
        found = _scored(folder, n, names, json.loads(json.dumps(settings)))
        write_json(Path(out) / "blindtest.json", found)
    return found


def counted(work: Callable[[Any], int], tasks: Sequence[Any], workers: int, done: int) -> Iterable[int]:
    """Work off the tasks; yields how many are done, beginning with those `done` before."""
    yield done
    for _ in worked(work, tasks, workers):
        done += 1
        yield done


def _scored(folder: TrialFolder, n: int, names: Sequence[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """`avtorch.blindtest/1` of cases 0 to `n - 1`, all of them answered; the first of `names` is under test."""
    truths = [folder.truth(i) for i in range(n)]

    def measures(name: str) -> dict[str, Any]:
        kept = [folder.answer(name, i) for i in range(n)]
        found = score(truths, [one["answer"] for one in kept], seconds=[one["seconds"] for one in kept])
        return {**found, "cpu_seconds_per_case": float(np.mean([x["cpu_seconds"] for x in kept])), **failures(kept)}

    return {
        "schema": "avtorch.blindtest/1",
        "cases": n,
        "answerer": names[0],
        **settings,
        **measures(names[0]),
        "baselines": {name: measures(name) for name in names[1:]},
    }


def _check(n: int, seed: int, names: Sequence[str], workers: int, signals: Sequence[str], recorder: Recording) -> None:
    if n < 1:
        raise InputError(f"n: found {n}, needs 1 case or more")
    if not 0 <= seed < 2**63:
        raise InputError(f"seed: found {seed}, needs a whole number from 0 to 2^63 - 1")
    if workers < 1:
        raise InputError(f"workers: found {workers}, needs 1 or more")
    if not names:
        raise InputError("answerers: found none, needs at least one")
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise InputError(f"answerers: found the name {name!r}, needs letters, digits, _ and -")
    if not signals or set(signals) - set(SIGNALS):
        raise InputError(f"signals: found {tuple(signals)}, needs accel, speed or both")
    if recorder not in get_args(Recording):
        raise InputError(f"recorder: found {recorder!r}, needs ideal or ordinary")
