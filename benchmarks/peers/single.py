"""The first table: one window at a time, every method in turn on each window."""

from __future__ import annotations

import json
import math
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.contract import Method, Settings, as_log
from benchmarks.peers.own import own_log_density
from benchmarks.peers.problem import make_windows
from benchmarks.peers.process import PeerFailed, Worker
from benchmarks.peers.score import WANTED, Exact, Score, median, seconds_to

TRIAL_WINDOWS = 3
#: Draws are scaled to this many times the effective draws wanted on the worst trial window.
MARGIN = 1.15


@dataclass
class Row:
    """One method's figures.

    Attributes:
        why: the reason if there are none.
        seconds: median over the windows, of the median over repeats.
        seconds_wanted: the same to the effective draws wanted (`score.seconds_to`); of draws or not.
        first_s: first call less ``seconds``. import_s: importing the peer.
        bulk, tail: least effective draws, median over windows; bulk_least: least over windows.
        shift, shift_rms: worst mean difference in SDs, and its RMS; ratio_*: the SD ratio.
        density_error: largest difference from avtorch's log density at random points, relative to 1 + its size.
    """

    method: str
    title: str
    why: str = ""
    settings: Settings = field(default_factory=dict)
    windows: int = 0
    seconds: float = math.nan
    seconds_wanted: float = math.nan
    first_s: float = math.nan
    import_s: float = math.nan
    bulk: float = math.nan
    bulk_least: float = math.nan
    tail: float = math.nan
    shift: float = math.nan
    shift_rms: float = math.nan
    ratio_low: float = math.nan
    ratio_high: float = math.nan
    ratio_mean: float = math.nan
    peak_mb: float = math.nan
    density_error: float | None = None
    trials: list[dict[str, Any]] = field(default_factory=list)


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Plan:
    """The plan of a run: methods, numbers of windows and points, options; ``log`` takes the peers' own output."""

    methods: list[Method]
    windows: int
    points: int
    quick: bool
    core: int
    seed: int
    log: Path
    clock: str = "wall"

    @property
    def worker(self) -> dict[str, Any]:
        return {"core": self.core, "log": self.log, "clock": self.clock}


def single(plan: Plan) -> list[Row]:
    """All rows in the order of the plan."""
    windows = make_windows(1 + plan.windows, points=plan.points, seed=plan.seed)
    trial = make_windows(1 + TRIAL_WINDOWS, points=plan.points, seed=plan.seed + 1)
    rows = {m.name: Row(m.name, m.title) for m in plan.methods}
    exact, trial_exact = Exact.of(windows), Exact.of(trial)
    ours = own_log_density(windows, as_log(windows))
    workers: dict[str, Worker] = {}
    first: dict[str, float] = {}
    times: dict[str, list[float]] = {}
    scores: dict[str, list[Score]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        windows.save(folder / "one.npz")
        trial.save(folder / "trial.npz")
        try:
            for method in plan.methods:
                row = rows[method.name]
                if method.missing():
                    row.why = f"not installed: {method.pip}"
                    continue
                try:
                    say(f"{method.name}: settings")
                    row.settings, row.trials = choose(method, plan, folder, trial_exact)
                    worker = Worker(method, row.settings, folder, **plan.worker)
                    workers[method.name] = worker
                    row.import_s = worker.import_s
                    theirs = worker.log_density("one.npz")
                    if theirs is not None:
                        row.density_error = float((np.abs(theirs - ours) / (1 + np.abs(ours))).max())
                        if row.density_error > 1e-8:
                            raise PeerFailed(f"its log density differs by {row.density_error:.1e}")
                    first[method.name] = worker.run("one.npz", first=0, count=1, seed=0).seconds[0]
                except PeerFailed as error:
                    row.why = str(error)
                    workers.pop(method.name, None)
            for k in range(1, 1 + plan.windows):
                for method in plan.methods:
                    if method.name not in workers or (method.slow and k > 2) or rows[method.name].why:
                        continue
                    say(f"window {k} of {plan.windows}: {method.name}")
                    often = 1 if plan.quick or method.slow else 5
                    try:
                        timed = workers[method.name].run(
                            "one.npz", first=k, count=1, seed=1000 * k, repeats=often, patience_s=1.0
                        )
                    except PeerFailed as error:
                        rows[method.name].why = str(error)
                        continue
                    times.setdefault(method.name, []).append(median(timed.seconds))
                    scores.setdefault(method.name, []).append(Score.of(timed.answer, exact.select(slice(k, k + 1))))
                    rows[method.name].peak_mb = timed.peak_mb
        finally:
            for worker in workers.values():
                worker.close()
    for name, found in scores.items():
        _fill(rows[name], times[name], Score.join(found), first[name])
    return list(rows.values())


def choose(method: Method, plan: Plan, folder: Path, exact: Exact) -> tuple[Settings, list[dict[str, Any]]]:
    """The fastest accurate settings that reach the wanted effective draws, found on separate trial windows."""
    if plan.quick:
        return quick(method.candidates[-1]), []
    if method.fixed:
        return method.candidates[0], []
    trials: list[dict[str, Any]] = []
    for settings in method.candidates:
        worker = Worker(method, settings, folder, **plan.worker)
        try:
            worker.run("trial.npz", first=0, count=1, seed=1)
            seconds, scores = [], []
            for k in range(1, 1 + (1 if method.slow else TRIAL_WINDOWS)):
                timed = worker.run("trial.npz", first=k, count=1, seed=k, repeats=3, patience_s=1.0)
                seconds.append(median(timed.seconds))
                scores.append(Score.of(timed.answer, exact.select(slice(k, k + 1))))
        finally:
            worker.close()
        score = Score.join(scores)
        least = float(score.bulk.min())
        scaled = max(4, math.ceil(settings[method.scales] * MARGIN * WANTED / least))
        allowed = 0.1 + 3 / math.sqrt(least)
        ratio = score.ratio.mean(0)
        accurate = bool(np.abs(score.shift).max() <= allowed and (np.abs(ratio - 1) <= 0.05).all())
        cost = median([t * MARGIN * WANTED / e for t, e in zip(seconds, score.bulk, strict=True)])
        trial = {"settings": settings, "seconds": median(seconds), "least_ess": least, "seconds_wanted": cost}
        trials.append({**trial, "accurate": accurate, "scaled": scaled})
        say(f"  {json.dumps(settings)}: {1e3 * cost:.1f} ms to {WANTED}, {'accurate' if accurate else 'not accurate'}")
    best = min(trials, key=lambda t: (not t["accurate"], t["seconds_wanted"]))
    chosen = {**best["settings"], method.scales: best["scaled"]}
    if "proposals" in chosen:
        chosen["proposals"] = chosen["draws"]
    return chosen, trials


def quick(settings: Settings) -> Settings:
    """The same with few draws, as a test that it runs."""
    return {**settings, "draws": min(settings["draws"], 200)} if "draws" in settings else settings


def _fill(row: Row, times: list[float], score: Score, first: float) -> None:
    row.windows, row.seconds = len(times), median(times)
    row.first_s = max(0.0, first - row.seconds)
    row.shift = float(np.nanmax(np.abs(score.shift)))
    row.shift_rms = float(np.sqrt(np.nanmean(score.shift**2)))
    row.ratio_low, row.ratio_high = float(np.nanmin(score.ratio)), float(np.nanmax(score.ratio))
    row.ratio_mean = float(np.nanmean(score.ratio))
    row.seconds_wanted = row.seconds
    if not np.isnan(score.bulk).all():
        row.bulk, row.bulk_least, row.tail = (
            median(score.bulk.tolist()),
            float(score.bulk.min()),
            median(score.tail.tolist()),
        )
        pairs = zip(times, score.bulk, strict=True)
        row.seconds_wanted = median([seconds_to(WANTED, t, e) for t, e in pairs])
