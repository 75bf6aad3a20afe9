"""A large fleet whose workers are killed all along: rows lost or doubled, and how busy the cores were.

``python -m benchmarks.fleet_killed [--logs 1000] [--seconds 60] [--steps check,estimate] [--kill-every 20]
[--workers 2] [--check 20] [--seed 1] [--json FILE]``

Logs of the blind test's vehicle, a car each. Every `--kill-every` seconds a worker is ended by SIGKILL, each in its
turn (0: none). In the end every log must have the rows of one answer for each step, and a number of logs, drawn at
random, those that the functions give in this process. Exit code 1 where a row is lost, doubled or different.

`work` is the time of the tasks that were finished, over the time of all workers; `at work` the processor time of all
processes beside that of all cores, with what was begun and killed, and starts after kills; `engine` the processor time
of the process that schedules, sends and writes, beside that of the workers.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil

from avtorch.fleet import FleetLog, FleetSettings, read_rows, run_fleet
from avtorch.fleet.cluster import Cluster
from avtorch.fleet.folder import DATASETS
from avtorch.fleet.log_list import content_hash
from avtorch.fleet.settings import Step
from avtorch.fleet.task import Task, work
from avtorch.io import write_json
from benchmarks.blindtest import draw_case

_OWN = ("car", "log", "date", "tags", "sha256", "version", "seconds")
"""Columns that an answer has from the fleet, or that differ from run to run."""


class Killer:
    """Ends one worker after the other, `every` so many seconds, from `begin` until `end`; counts processor time.

    A process takes what it has used with it, so all are asked twice a second.
    """

    def __init__(self, every: float) -> None:
        self.every = every
        self.killed: list[int] = []
        self.used: dict[int, float] = {}
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self, cluster: Cluster) -> None:
        self._thread = threading.Thread(target=self._run, args=(cluster,), daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, cluster: Cluster) -> None:
        me, due = psutil.Process(), time.monotonic() + self.every
        while not self._over.wait(0.5):
            for process in me.children(recursive=True):
                try:
                    self.used[process.pid] = sum(process.cpu_times()[:2])
                except psutil.Error:
                    continue
            if self.every and time.monotonic() >= due:
                due += self.every
                try:
                    at_work = list(cluster.client.run(os.getpid).values())
                except RuntimeError:  # the fleet has just ended its cluster
                    return
                if at_work:
                    victim = at_work[len(self.killed) % len(at_work)]
                    os.kill(victim, signal.SIGKILL)
                    self.killed.append(victim)


def written(root: Path, logs: int, seconds: float, seed: int) -> list[Path]:
    """The logs, each of its own drive."""
    paths = []
    for index in range(logs):
        paths.append(root / f"car{index:05d}.csv")
        draw_case(index, seed, seconds=seconds).log().write(paths[-1])
        print(f"\rdrive {index + 1} of {logs}", end="" if index + 1 < logs else "\n", file=sys.stderr, flush=True)
    return paths


def faults(paths: list[Path], out: Path, settings: FleetSettings, checked: int, seed: int) -> list[str]:
    """A sentence on each log whose rows are not those of one answer; `checked` of them are computed again, here."""
    found = []
    again = set(random.Random(seed).sample(paths, min(checked, len(paths))))
    for step in settings.steps:
        rows: dict[str, list[dict[str, Any]]] = {}
        for row in read_rows(out, DATASETS[step]).to_pylist():
            rows.setdefault(Path(row["log"]).name, []).append(row)
        for path in paths:
            mine = rows.pop(path.name, [])
            if not mine:
                found.append(f"{path.name}: no rows of {step}")
            elif step == "estimate" and mine[0]["error"] is None and _numbers(mine) != list(range(len(mine))):
                found.append(f"{path.name}: windows {_numbers(mine)}")
            elif step != "estimate" and len(mine) != 1:
                found.append(f"{path.name}: {len(mine)} rows of {step}")
            elif any(row["status"] == "crashed" for row in mine):
                found.append(f"{path.name}: {step} crashed: {mine[0]['error']}")
            if path in again and not _same(mine, _alone(path, step, settings)):
                found.append(f"{path.name}: rows of {step} differ from those computed by themselves")
        found += [f"{name}: rows of a log that is not there" for name in rows]
    return found


def _numbers(rows: list[dict[str, Any]]) -> list[int]:
    first = min(row["window"] for row in rows)
    return sorted(row["window"] - first for row in rows)


def _alone(path: Path, step: Step, settings: FleetSettings) -> list[dict[str, Any]]:
    sha256, size = content_hash(path)
    return work(Task(step, FleetLog(str(path), path.stem), str(path), sha256, size, settings)).rows


def _same(rows: list[dict[str, Any]], alone: list[dict[str, Any]]) -> bool:
    """Whether a fleet's rows are those of one answer, to the bit; they may be in another order."""

    def key(row: dict[str, Any], names: list[str]) -> str:
        return json.dumps({name: row[name] for name in names}, default=str, sort_keys=True)

    if not rows or not alone:
        return False
    names = sorted(name for name in alone[0] if name in rows[0] and name not in _OWN)
    return Counter(key(row, names) for row in rows) == Counter(key(row, names) for row in alone)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("logs", 1000), ("workers", 2), ("check", 20), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--steps", default="check,estimate")
    parser.add_argument("--kill-every", type=float, default=20.0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    settings = FleetSettings(steps=tuple(given.steps.split(",")), posterior="laplace")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        paths = written(root, given.logs, given.seconds, given.seed)
        answer = measured(paths, root / "out", settings, given.workers, given.kill_every)
        wrong = faults(paths, root / "out", settings, given.check, given.seed)
    print(
        f"{given.logs} logs of {given.seconds:g} s, {given.steps}: {answer['clock_s']:.0f} s on {given.workers} workers"
    )
    print(f"{answer['kills']} workers killed; {answer['failed_logs']} logs failed; {len(wrong)} rows lost or wrong")
    print(
        f"work {answer['work']:.1%} of the workers' time; at work {answer['at_work']:.1%} of their cores' time; "
        f"engine {answer['engine']:.1%} of the workers' processor time; a task takes {answer['task_s']:.2f} s"
    )
    for line in wrong[:20]:
        print(line)
    if given.json is not None:
        write_json(given.json, answer | {"wrong": wrong})
    raise SystemExit(1 if wrong else 0)


def measured(paths: list[Path], out: Path, settings: FleetSettings, workers: int, every: float) -> dict[str, Any]:
    """The fleet, with kills, and what it cost; from the start of its processes to their end."""
    killer, own = Killer(every), time.process_time()
    begun = time.perf_counter()
    try:
        answer = run_fleet(paths, out, settings=settings, workers=workers, connected_to=killer.begin)
    finally:
        killer.end()
    clock, own = time.perf_counter() - begun, time.process_time() - own
    tasks: list[float] = []
    for step in settings.steps:
        rows = read_rows(out, DATASETS[step]).select(["log", "seconds"]).to_pylist()
        tasks += {row["log"]: row["seconds"] for row in rows}.values()
    others = sum(killer.used.values())
    return {
        "clock_s": clock,
        "kills": len(killer.killed),
        "failed_logs": answer["failed_logs"],
        "work": sum(tasks) / (workers * clock),
        "at_work": (own + others) / (workers * clock),
        "engine": own / others if others else 0.0,
        "task_s": statistics.mean(tasks),
    }


if __name__ == "__main__":
    main()
