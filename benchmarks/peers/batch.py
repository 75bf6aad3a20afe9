"""The second table: many windows at once, cost per window."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.peers.problem import make_windows
from benchmarks.peers.process import PeerFailed, Worker
from benchmarks.peers.score import WANTED, Exact, Score, median, seconds_to
from benchmarks.peers.single import TRIAL_WINDOWS, Plan, Row, choose, quick, say

#: Windows whose draws are scored against quadrature.
SCORED = 100


def batch(plan: Plan, count: int) -> list[Row]:
    """Rows of the methods that take many windows at once; seconds are those of all, divided by their number."""
    methods = [m for m in plan.methods if m.batch is not None]
    windows = make_windows(2 * count, points=plan.points, seed=plan.seed + 2)
    trial = make_windows(1 + TRIAL_WINDOWS, points=plan.points, seed=plan.seed + 1)
    trial_exact = Exact.of(trial)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        windows.save(folder / "many.npz")
        trial.save(folder / "trial.npz")
        for method in methods:
            row = Row(method.name, method.title, settings=method.batch or {}, windows=min(count, method.batch_windows))
            rows.append(row)
            if method.missing():
                row.why = f"not installed: {method.pip}"
                continue
            say(f"{row.windows} windows at once: {method.name}")
            worker = None
            try:
                if method.scales != "draws" and not plan.quick:
                    row.settings, row.trials = choose(method, plan, folder, trial_exact)
                settings = quick(row.settings) if plan.quick else row.settings
                worker = Worker(method, settings, folder, **plan.worker)
                first = worker.run("many.npz", first=0, count=row.windows, seed=0).seconds[0]
                often = 1 if plan.quick else 3
                timed = worker.run(
                    "many.npz", first=count, count=row.windows, seed=1, repeats=often, patience_s=20.0, keep=SCORED
                )
            except PeerFailed as error:
                row.why = str(error)
                continue
            finally:
                if worker is not None:
                    worker.close()
            kept = min(SCORED, row.windows)
            score = Score.of(timed.answer, Exact.of(windows.select(slice(count, count + kept))))
            row.seconds = median(timed.seconds) / row.windows
            row.first_s = max(0.0, first - row.seconds * row.windows)
            row.import_s, row.peak_mb = worker.import_s, timed.peak_mb
            _fill(row, score)
    return rows


def _fill(row: Row, score: Score) -> None:
    """Quantiles over windows in place of extremes: of a hundred windows one is always poor by chance."""
    row.shift = float(np.nanquantile(np.abs(score.shift), 0.95))
    row.shift_rms = float(np.sqrt(np.nanmean(score.shift**2)))
    low, high = np.nanquantile(score.ratio, [0.025, 0.975])
    row.ratio_low, row.ratio_high, row.ratio_mean = float(low), float(high), float(np.nanmean(score.ratio))
    row.seconds_wanted = row.seconds
    if not np.isnan(score.bulk).all():
        row.bulk, row.bulk_least = float(np.median(score.bulk)), float(np.quantile(score.bulk, 0.05))
        row.tail = float(np.median(score.tail))
        row.seconds_wanted = seconds_to(WANTED, row.seconds, row.bulk)
