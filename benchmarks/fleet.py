"""What a fleet costs beside its logs' own work, and whether it keeps the cores busy.

``python -m benchmarks.fleet [--logs 3] [--seconds 60] [--rounds 4] [--workers 2] [--seed 1] [--json FILE]``

Logs of the blind test's reference vehicle. In each round the same logs are checked, estimated and diagnosed twice, in
turns: one after another by the Python functions in this process, and as a fleet with one worker process, on a cluster
that is already up. Both processes have done one log before. Ratios are of time and of CPU time, the latter with all
that the scheduler and the caller use; on a machine that others use only the latter means something. Then one fleet on
`--workers`, from the start of its processes to their end: the share of the workers' time that was work.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import avtorch
from avtorch.decision.settings import Setting
from avtorch.fleet import FleetSettings, read_rows, run_fleet
from avtorch.fleet.cluster import Cluster, connected
from benchmarks.blindtest import draw_case


def by_themselves(paths: Sequence[Path], settings: FleetSettings) -> None:
    """Check, estimate and diagnose, each log after the other."""
    setting = Setting(time_gap=settings.time_gap, gains=settings.gains, scenarios=1)
    for path in paths:
        avtorch.check(path)
        avtorch.estimate(avtorch.Log.read(path), setting=setting, dead_time=None, seed=settings.seed)
        avtorch.diagnose(avtorch.Log.read(path), posterior=settings.posterior, seed=settings.seed)


def timed(work: Callable[[], object], cluster: Cluster) -> tuple[float, float]:
    """Seconds of the clock, and of the CPU in this process and in the worker's."""
    cpu = used(cluster)
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun, used(cluster) - cpu


def used(cluster: Cluster) -> float:
    """CPU time so far of this process, with the scheduler in it, and of the workers [s]."""
    return time.process_time() + sum(dict(cluster.client.run(time.process_time)).values())


def computed(out: Path) -> float:
    """Seconds of computing in all tasks of a fleet; every window of a log has those of the log."""
    seconds = 0.0
    for dataset in ("checks", "windows", "diagnoses"):
        rows = read_rows(out, dataset).select(["log", "seconds"]).to_pylist()
        seconds += sum({row["log"]: row["seconds"] for row in rows}.values())
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("logs", 3), ("rounds", 4), ("workers", 2), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    settings = FleetSettings(posterior="laplace")
    with tempfile.TemporaryDirectory() as folder:
        root, paths = Path(folder), []
        for index in range(given.logs):
            paths.append(root / f"car{index}.csv")
            draw_case(index, given.seed, seconds=given.seconds).log().write(paths[-1])
        ratios: dict[str, list[float]] = {"time": [], "cpu": []}
        with connected(1, "4GiB", None) as cluster:
            scheduler = cluster.client.scheduler_info()["address"]
            by_themselves(paths[:1], settings)
            run_fleet(paths[:1], root / "warm", settings=settings, scheduler=scheduler)
            for number in range(given.rounds):
                out = root / f"out{number}"
                fleet = partial(run_fleet, paths, out, settings=settings, scheduler=scheduler)
                alone = partial(by_themselves, paths, settings)
                # which of them is first takes turns, too
                pair = [timed(work, cluster) for work in ((alone, fleet) if number % 2 == 0 else (fleet, alone))]
                own, whole = pair if number % 2 == 0 else pair[::-1]
                ratios["time"].append(whole[0] / own[0])
                ratios["cpu"].append(whole[1] / own[1])
                print(
                    f"round {number + 1}: by themselves {own[0]:.1f} s (CPU {own[1]:.1f}), as a fleet {whole[0]:.1f} s "
                    f"(CPU {whole[1]:.1f}), outside of tasks {100 * (1 - computed(out) / whole[0]):.1f} %",
                    flush=True,
                )
        begun = time.perf_counter()
        run_fleet(paths, root / "all", settings=settings, workers=given.workers)
        whole_s = time.perf_counter() - begun
        busy = computed(root / "all") / (given.workers * whole_s)
        begun = time.perf_counter()
        run_fleet(paths, root / "all", settings=settings)
        again = time.perf_counter() - begun
    for name, values in ratios.items():
        print(f"{name}: ratio {statistics.median(values):.3f} (median), {min(values):.3f} to {max(values):.3f}")
    print(f"{given.workers} workers, started and ended: {whole_s:.1f} s, {100 * busy:.0f} % of their time was work")
    print(f"a second call: {1000 * again / given.logs:.1f} ms a log")
    if given.json is not None:
        answer = {"ratios": ratios, "busy": busy, "whole_s": whole_s, "again_s": again}
        given.json.write_text(json.dumps(answer, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
