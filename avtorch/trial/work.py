"""One case of a trial: draw it, let the methods without an answer answer it, and store their answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avtorch.blindtest import draw_case
from avtorch.blindtest.answers import SCHEMAS, read_answer
from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.io.answers import json_text
from avtorch.trial.folder import TrialFolder

Answerer = Callable[[Log], dict[str, Any]]
"""Takes a log, returns an answer of `avtorch.diagnosis/1` or `/2`.

Example:
    >>> from avtorch.trial import Answerer, reply
    >>> def always_none(log):
    ...     return reply(log, {"none": 1.0}, why="it never finds anything")
    >>> answerers: dict[str, Answerer] = {"always_none": always_none}
    >>> sorted(answerers)
    ['always_none']
"""


@dataclass(frozen=True)
class Task:
    """A case to answer: `index` in the set `seed`, the names of those who are `missing`, and how it is drawn.

    `settings` are the trial's, as `TrialFolder.settle` returned them. With more than one process the `answerers` are
    pickled: functions of a module, not lambdas.
    """

    root: Path
    settings: Mapping[str, Any]
    index: int
    seed: int
    missing: tuple[str, ...]
    answerers: Mapping[str, Answerer]
    signals: tuple[str, ...]
    options: Mapping[str, Any]
    keep_logs: bool


def work(task: Task) -> int:
    """Answer a case and store the answers; returns its index."""
    folder = TrialFolder(task.root, task.settings)
    log = folder.kept_log(task.index, task.signals)
    if log is None:
        case = draw_case(task.index, task.seed, signals=task.signals, **task.options)
        kept = None
        if task.keep_logs:
            case.log().write(folder.log_path(task.index))
            kept = folder.log_path(task.index).read_bytes()
        folder.keep_truth(case, log=kept)
        log = case.log(signals=task.signals)
    truth = folder.truth(task.index)
    for name in task.missing:
        ask(folder, name, task.index, task.answerers[name], log, truth)
    return task.index


def ask(folder: TrialFolder, name: str, index: int, answerer: Answerer, log: Log, truth: Mapping[str, Any]) -> None:
    """Keep one answer, with what it cost; a failure is an answer too, and its message is kept."""
    answer: dict[str, Any] | None = None
    fault = ""
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        answer = answerer(log)
    except Exception as error:
        fault = f"{type(error).__name__}: {error}"
    spent = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    if answer is not None:
        try:
            read_answer(truth, answer)  # the scorer must be able to read it
            json_text(answer)
        except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
            answer, fault = None, f"the answer is not of {' or '.join(SCHEMAS)}: {type(error).__name__}: {error}"
    # a disk that is full is no fault of the answer's
    folder.keep_answer(name, index, answer, error=fault if answer is None else None, **spent)
