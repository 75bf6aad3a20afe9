"""The work on one log in one worker: a step of its answer, as rows; whatever goes wrong becomes a row that says why."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.errors import InputError, printable
from avtorch.fleet.places import content_hash, fetched
from avtorch.fleet.rows import Row, check_rows, diagnosis_rows, failure_rows, window_rows
from avtorch.fleet.settings import FleetSettings, Step
from avtorch.io import Damaged, Log
from avtorch.io.opening import place
from avtorch.logcheck.check import check
from avtorch.version import __version__

if TYPE_CHECKING:
    from avtorch.gap.result.diagnosis import Diagnosis


@dataclass(frozen=True)
class Task:
    """A `step` for the log at `place` with this content; `size` [bytes]; a `name` that no other task of the run has.

    `checkpoint`: a file that keeps what was finished, for a worker that comes after one that was killed; None where
    workers share no disk with the caller. `report`: makes the page of a diagnosis, where one is wanted; a function that
    the worker can import. `shown`: the place as the caller has it, for messages; None: as it is.
    """

    name: str
    step: Step
    place: str
    sha256: str
    size: int
    settings: FleetSettings
    checkpoint: str | None = None
    report: Callable[[Diagnosis], str] | None = None
    shown: str | None = None
    version: str = __version__


@dataclass(frozen=True)
class Outcome:
    """The rows of a task, how long it computed [s], and the page of its diagnosis, where one was wanted."""

    rows: list[Row]
    seconds: float
    report: str | None = None


def work(task: Task) -> Outcome:
    """Do a task. Raises nothing but what ends the process."""
    begun = time.perf_counter()
    page, where = None, task.place
    try:
        if task.version != __version__:
            raise RuntimeError(f"this worker has avtorch {__version__}, needs {task.version}")
        with fetched(task.place) as local:
            where = str(local)
            if content_hash(local)[0] != task.sha256:
                raise RuntimeError("the log was changed while the fleet ran; needs another run")
            try:
                rows, page = _rows(task, local)
            except Damaged:
                raise  # of the checkpoint, not of the log
            except InputError as fault:
                rows = failure_rows("failed", str(fault))
    except InputError as fault:
        rows = failure_rows("crashed", str(fault))  # what could not be reached may be there tomorrow
    except Exception as fault:
        rows = failure_rows("crashed", printable(f"{type(fault).__name__}: {fault}", 400))
    for row in rows:
        if row.get("error") is not None:  # on a copy from a store, or by a path that the caller did not give
            row["error"] = row["error"].replace(place(where), task.shown or task.place)
    return Outcome(rows, time.perf_counter() - begun, page)


def _rows(task: Task, local: Path) -> tuple[list[Row], str | None]:
    given = task.settings
    read: dict[str, Any] = {name: getattr(given, name) or None for name in ("map", "unit", "stamp")}
    mapped = any(read.values())
    if task.step == "check":
        return check_rows(check(Log.read(local, **read) if mapped else local)), None
    drive, note = _commanded(Log.read(local, **read))
    return (_estimated(task, drive, note), None) if task.step == "estimate" else _diagnosed(task, drive, note)


def _commanded(drive: Log) -> tuple[Log, str | None]:
    """The drive with an `accel_cmd`, and a note on the map of its pedals where one made it."""
    if drive.accel_cmd is not None or (not drive.pedals and drive.speed_cmd is None):
        return drive, None
    from avtorch.pedals import fit_pedals

    fit = fit_pedals([drive])
    by = " and ".join(fit.map.pedals)
    return fit.map.commanded(drive), f"The log has no accel_cmd: a map of {by} and speed stands for it; K_L is 1 by it."


def _estimated(task: Task, drive: Log, note: str | None) -> list[Row]:
    from avtorch.decision.estimation import estimate
    from avtorch.decision.settings import Setting

    given = task.settings
    with _checkpoint(task) as kept:
        found = estimate(
            drive,
            given.window,
            estimator=given.estimator,
            setting=Setting(time_gap=given.time_gap, gains=given.gains, scenarios=1),
            accepted=given.accepted,
            dead_time=given.dead_time,
            seed=given.seed,
            progress=False,  # the fleet's own tells of it
            checkpoint=kept,
        )
    return window_rows(found, note)


def _diagnosed(task: Task, drive: Log, note: str | None) -> tuple[list[Row], str | None]:
    from avtorch.gap.diagnose import diagnose
    from avtorch.gap.simulator.plant import GapPlant

    given = task.settings
    found = diagnose(
        drive,
        baseline=None if given.baseline == "glvd" else GapPlant.from_toml(given.baseline),
        effects=given.effects,
        pairs=given.pairs,
        posterior=given.posterior,
        budget_s=given.budget_s,
        seed=given.seed,
        progress=False,
    )
    return diagnosis_rows(found, note), None if task.report is None else task.report(found)


@contextmanager
def _checkpoint(task: Task) -> Iterator[Path | None]:
    """The task's checkpoint; it is removed unless the process is killed within."""
    path = None if task.checkpoint is None else Path(task.checkpoint)
    try:
        yield path
    finally:
        if path is not None:
            with suppress(OSError):
                path.unlink(missing_ok=True)
