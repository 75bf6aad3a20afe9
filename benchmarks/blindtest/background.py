"""A trial on recordings: known effects in front of recorded cars, the untouched log of each as its control.

Its folder is a trial's (`TrialFolder`): number 0 up to the number of recordings are the controls, then follow
effects and sizes, recording by recording. Controls come first, since a force on the body takes the car's lag and gain
from the diagnosis of its untouched log.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.errors import InputError
from avtorch.io import Log, fingerprint, sole_use, write_json
from benchmarks.blindtest import IN_FRONT, Injected, put_in_front, score_in_front
from benchmarks.blindtest.trial import Answerer, TrialFolder, ask, case_name, counted, failures

SIZES = (0.5, 0.8, 1.25)
"""Sizes of the effects by default, in units of `put_in_front`: two below what is clearly visible, one above."""


def run_background(
    logs: Sequence[Log],
    seed: int,
    out: str | os.PathLike[str],
    *,
    answerer: Answerer,
    name: str = "avtorch",
    sizes: Sequence[float] = SIZES,
    effects: Sequence[str] | None = None,
    draws: int = 1,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Let `answerer` answer each of the `logs`, and each with each effect in front; write `out/background.json`.

    Effects that a log cannot show (no such channel, or nothing changes) are left out and listed under `skipped`.
    Answers are kept in `out` as they come, under `name`; a rerun asks only for those that are missing. An answerer that
    raises has not answered: where that is a control, no effect is put in front of its log.

    Args:
        answerer: `Log` to a dict of `avtorch.diagnosis/1` or `/2`, whose `baseline` holds the lag and gain that fit the
            log.
        seed: of the times, roads and gusts of effects; the same for all sizes of an effect in front of a log.
        sizes: relative to the spread of the log's signals, see `put_in_front`.
        effects: of `IN_FRONT`; default: all.
        draws: how often each effect is put in front with new times, roads and gusts; once where it has none.
        workers: processes, as in `run_trial`.
        progress: called with (logs answered, of).

    Returns `table` and `totals` (`benchmarks.blindtest.score_in_front`), `trials` one by one, `backgrounds`
    with the controls' verdicts. Raises `InputError` for arguments out of range, a log without `accel_cmd`, the same log
    twice, and a folder of another trial.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from benchmarks.blindtest.background import run_background
        >>> from benchmarks.blindtest.reply import reply
        >>> log = simulate(Leader.default(start=50.0, duration=20.0, dt=0.05)).log()
        >>> def always_none(log):
        ...     return reply(log, {"none": 1.0}, why="it never finds anything", baseline={"T_L": (0.3, 0.01)})
        >>> effects = ["dead_time", "sensor_bias"]
        >>> found = run_background([log], 1, "recorded", answerer=always_none, name="always_none", effects=effects)
        >>> found["totals"]["trials"], found["totals"]["held"], found["totals"]["nothing_named"]
        (6, 0, 6)
    """
    wanted = list(IN_FRONT) if effects is None else list(effects)
    _check(logs, seed, wanted, sizes, draws, workers)
    sizes = [float(size) for size in sizes]
    with sole_use(out, work="a blind test"):
        found = _run(logs, seed, Path(out), answerer, name, sizes, wanted, draws, workers, progress)
        write_json(Path(out) / "background.json", found)
    return found


@dataclass(frozen=True)
class _Place:
    """Number `index` of the trial: recording number `background` as it is, or with an `effect` in front of it; `draw`:
    which one of its random draws."""

    index: int
    background: int
    effect: str | None
    size: float | None
    draw: int = 0


@dataclass(frozen=True)
class _Task:
    """A place of the trial, its recording, the `car` (lag [s], gain) fitted to it, and who answers; can be pickled."""

    folder: TrialFolder
    place: _Place
    log: Log
    seed: int
    car: tuple[float, float] | None
    name: str
    answerer: Answerer


def _answer(task: _Task) -> int:
    index = task.place.index
    log, truth = _drawn(task.place, task.log, task.seed, task.car)
    task.folder.keep_truth(index, truth)
    write_json(task.folder.answer_path(task.name, index), ask(task.answerer, log, truth))
    return index


def _run(
    logs: Sequence[Log],
    seed: int,
    out: Path,
    answerer: Answerer,
    name: str,
    sizes: Sequence[float],
    effects: Sequence[str],
    draws: int,
    workers: int,
    progress: Callable[[int, int], None] | None,
) -> dict[str, Any]:
    folder = TrialFolder(out)
    # by content: a recording may move between two runs
    prints = [fingerprint(replace(log, name=""))[:16] for log in logs]
    settings = {"background": prints, "seed": seed, "sizes": list(sizes), "effects": list(effects)}
    folder.settle(settings | {"draws": draws})
    places, skipped = _places(logs, effects, sizes, draws)
    of, done, notes = len(places), 0, []

    def answer(some: Sequence[_Place], cars: Sequence[tuple[float, float] | None]) -> None:
        nonlocal done
        tasks = []
        for place in some:
            car = cars[place.background]
            if folder.missing(place.index, [name]) and (place.effect is None or car is not None):
                tasks.append(_Task(folder, place, logs[place.background], seed, car, name, answerer))
        before = done + len(some) - len(tasks)
        for done in counted(_answer, tasks, workers, before):
            if progress:
                progress(done, of)

    answer(places[: len(logs)], [None] * len(logs))
    controls = [folder.answer(name, i) for i in range(len(logs))]
    cars = [_car(one["answer"]) for one in controls]
    answer(places[len(logs) :], cars)
    for log, one, car in zip(logs, controls, cars, strict=True):
        if car is None:
            why = failures([one])["failures"] or ["its lag and gain are not above 0"]
            notes.append(f"{log.name}: no fit to the untouched log ({why[0]}), so no effect was put in front of it.")
    trials, kept = [], list(controls)
    for place in places[len(logs) :]:
        control = controls[place.background]["answer"]
        if cars[place.background] is None:
            continue
        truth, one = folder.truth(place.index), folder.answer(name, place.index)
        kept.append(one)
        trials.append(
            Injected(
                logs[place.background].name, truth["effect"], truth["size"], truth["put_in"], control, one["answer"]
            )
        )
    return {
        "schema": "avtorch.blindtest.background/1",
        "answerer": name,
        "seed": seed,
        "sizes": list(sizes),
        "effects": list(effects),
        "draws": draws,
        "backgrounds": [
            {
                "name": log.name,
                "rows": log.rows,
                "seconds": log.seconds,
                "rate_hz": log.rate_hz,
                "names": None if one["answer"] is None else list(one["answer"]["verdict"]["names"]),
                "T_L": None if car is None else car[0],
                "K_L": None if car is None else car[1],
            }
            for log, one, car in zip(logs, controls, cars, strict=True)
        ],
        **score_in_front(trials),
        "trials": [one.to_dict() for one in trials],
        "skipped": [{"background": logs[b].name, "effect": effect, "why": why} for b, effect, why in skipped],
        **failures(kept),
        "seconds_per_log": float(np.mean([one["seconds"] for one in kept])),
        "cpu_seconds_per_log": float(np.mean([one["cpu_seconds"] for one in kept])),
        "notes": notes,
    }


def _places(
    logs: Sequence[Log], effects: Sequence[str], sizes: Sequence[float], draws: int
) -> tuple[list[_Place], list[tuple[int, str, str]]]:
    """All controls, then all that can be put in front of them; and (recording, effect, why) of what cannot."""
    places, skipped = [_Place(b, b, None, None) for b in range(len(logs))], []
    for b, log in enumerate(logs):
        for effect in effects:
            why = _cannot(log, effect, max(sizes))
            if why is not None:
                skipped.append((b, effect, why))
                continue
            for draw in range(draws if draws > 1 and _has_draws(log, effect) else 1):
                for size in sizes:
                    places.append(_Place(len(places), b, effect, size, draw))
    return places, skipped


def _cannot(log: Log, effect: str, size: float) -> str | None:
    """Why an effect cannot be put in front of a log, whatever the car's lag and gain; None where it can."""
    try:
        with np.errstate(all="ignore"):
            changed, put_in = put_in_front(log, effect, T_L=1.0, K_L=1.0, size=size)
    except InputError as error:
        return str(error)
    columns = [(changed.accel_cmd, log.accel_cmd), (changed.accel, log.accel)]
    if not all(np.isfinite(list(put_in.values()))) or not all(
        np.isfinite(x).all() for x, _ in columns if x is not None
    ):
        return f"{log.name}: its signals give {effect} no finite size"
    if all(x is None or y is None or np.array_equal(x, y) for x, y in columns):
        return f"{log.name}: nothing changes, as nothing in it meets {effect}"
    return None


def _has_draws(log: Log, effect: str) -> bool:
    """Whether an effect in front of a log depends on chance: else all its draws are one."""
    logs = [put_in_front(log, effect, T_L=1.0, K_L=1.0, seed=seed)[0] for seed in (0, 1)]
    return fingerprint(logs[0]) != fingerprint(logs[1])


def _drawn(place: _Place, log: Log, seed: int, car: tuple[float, float] | None) -> tuple[Log, dict[str, Any]]:
    """The log to answer, under a neutral name, and its truth; `verdict`, `kind` as the folder reads them."""
    truth: dict[str, Any] = {"index": place.index, "background": place.background, "tier": None, "onset_s": None}
    truth |= {"case": case_name(place.index), "onset_scored": False, "effect": place.effect, "size": place.size}
    if place.effect is None or place.size is None or car is None:
        return replace(log, name=case_name(place.index)), truth | {"kind": "control", "verdict": "control"}
    which = list(IN_FRONT).index(place.effect)
    begin = [seed, place.background, which, *([place.draw] if place.draw else [])]
    draws = int(np.random.default_rng(begin).integers(2**31))
    T_L, K_L = car
    changed, put_in = put_in_front(log, place.effect, T_L=T_L, K_L=K_L, size=place.size, seed=draws)
    truth |= {"kind": "in_front", "verdict": place.effect, "put_in": put_in, "baseline": {"T_L": T_L, "K_L": K_L}}
    return replace(changed, name=case_name(place.index)), truth


def _car(control: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """Lag [s] and gain [-] of the fit to the untouched log; None where there is none that a force could be put into."""
    if control is None:
        return None
    T_L, K_L = (float(control["baseline"][key]["mean"]) for key in ("T_L", "K_L"))
    return (T_L, K_L) if T_L > 0 and K_L > 0 else None


def _check(
    logs: Sequence[Log], seed: int, effects: Sequence[str], sizes: Sequence[float], draws: int, workers: int
) -> None:
    if not logs:
        raise InputError("logs: found none, needs a recording")
    for log in logs:
        if log.accel_cmd is None:
            raise InputError(f"{log.name}: has no accel_cmd, which is needed to add an effect")
    seen: dict[str, str] = {}
    for log in logs:
        mark = fingerprint(replace(log, name=""))
        if mark in seen:
            raise InputError(f"{log.name}: holds the same drive as {seen[mark]}, needs each recording once")
        seen[mark] = log.name
    if not 0 <= seed < 2**63:
        raise InputError(f"seed: found {seed}, needs a whole number from 0 to 2^63 - 1")
    for name, count in (("workers", workers), ("draws", draws)):
        if count < 1:
            raise InputError(f"{name}: found {count}, needs 1 or more")
    if not effects or len(set(effects)) < len(effects) or set(effects) - IN_FRONT.keys():
        raise InputError(
            f"effects: found {', '.join(effects) or 'none'}, needs some of {', '.join(IN_FRONT)}, each once"
        )
    if not sizes or len(set(sizes)) < len(sizes) or not all(np.isfinite(size) and size > 0 for size in sizes):
        raise InputError(
            f"sizes: found {', '.join(f'{x:g}' for x in sizes) or 'none'}, needs numbers above 0, each once"
        )
