"""A trial: sealed cases, the methods that answer them, and the score. A rerun answers only what is missing."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from avtorch.blindtest import MIX
from avtorch.blindtest.cases import SIGNALS, Recording
from avtorch.errors import InputError
from avtorch.io import answer_set, sole_use, write_json
from avtorch.trial.folder import TrialFolder
from avtorch.trial.pool import worked
from avtorch.trial.tally import tally
from avtorch.trial.work import Answerer, Task, work

BLINDTEST_FILES = ("blindtest.json", "confusion.png")
"""The score and its picture; truths and answers are kept beside them."""


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
    keep_logs: bool = False,
    progress: Callable[[int, int], None] | None = None,
    publish: bool = True,
    **draw_options: Any,
) -> dict[str, Any]:
    """Let `answerers` answer cases 0 to `n - 1` of the set `seed`; write and return `out/blindtest.json`.

    An earlier one stays until the new one is complete; its picture is then removed.

    The scores are those of the first answerer; the others are under `baselines` with the same keys. Answers and truths
    are written to `out` as they are made (`avtorch.trial.folder`); a rerun, also with more cases or another answerer,
    answers only what is missing. An answerer that raises, or answers outside the schema, has not answered: the message
    is kept, and the case counts as wrong. After a change of an answerer's code, delete its folder in `out/answers` to
    run it again.

    Args:
        answerers: by name (letters, digits, `_`, `-`): `Log` to a dict of `avtorch.diagnosis/1` or `/2`.
        workers: processes, each with one thread; more than one needs answerers that can be pickled, and a script that
            begins work under `if __name__ == "__main__"`.
        mix, outside, recorder, draw_options: as `avtorch.blindtest.draw_cases`.
        signals: the channels in the logs, in which a cause must show.
        keep_logs: keep `out/logs/NAME.csv`, so that a rerun need not draw the cases again.
        progress: called with (cases done, of).
        publish: False returns the answer and leaves `out/blindtest.json`, whatever it is, to the caller.

    A damaged answer is computed again, and `notes` of the result names it; a damaged truth is refused.

    Raises `InputError` for a folder with another trial's settings or in use by another process, for files of it that
    are damaged or another case's, and for arguments out of range.

    Example:
        >>> from avtorch.trial import reply, run_trial
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
        # without the key where it is ideal: trials that were kept before recorders can be resumed
        draw_options |= {"recorder": recorder}
    with sole_use(out, work="a blind test"):
        found = _run(n, seed, Path(out), answerers, workers, mix, signals, outside, keep_logs, progress, draw_options)
        if publish:
            with answer_set(out, BLINDTEST_FILES) as staged:
                write_json(staged / "blindtest.json", found)
    return found


def _run(
    n: int,
    seed: int,
    out: Path,
    answerers: Mapping[str, Answerer],
    workers: int,
    mix: Mapping[str, float] | None,
    signals: Sequence[str],
    outside: str,
    keep_logs: bool,
    progress: Callable[[int, int], None] | None,
    draw_options: Mapping[str, Any],
) -> dict[str, Any]:
    names = list(answerers)
    shares = dict(MIX if mix is None else mix)
    settings = {"seed": seed, "signals": [s for s in SIGNALS if s in signals], "outside": outside}
    settings |= {"mix": shares, "draw": {key: draw_options[key] for key in sorted(draw_options)}}
    folder = TrialFolder(out)
    settings = folder.settle(settings)
    state = [folder.missing(i, names) for i in range(n)]
    tasks = [
        Task(
            root=folder.root,
            settings=settings,
            index=i,
            seed=seed,
            missing=missing,
            answerers={name: answerers[name] for name in missing},
            signals=tuple(settings["signals"]),
            options={"mix": shares, "outside": outside, **draw_options},
            keep_logs=keep_logs,
        )
        for i, (missing, _) in enumerate(state)
        if missing
    ]
    done = n - len(tasks)
    if progress:
        progress(done, n)
    for _ in worked(work, tasks, workers):
        done += 1
        if progress:
            progress(done, n)
    return tally(folder, n, names, settings) | {"notes": [note for _, damaged in state for note in damaged]}


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
