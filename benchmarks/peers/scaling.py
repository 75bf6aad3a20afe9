"""The third table: how the cost of avtorch's own update grows with windows, chains and points.

``python -m benchmarks.peers.scaling CORE [--quick]`` prints JSON; the package's command runs it in its own process.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.peers.problem import Windows, make_windows
from benchmarks.peers.worker import pin

WINDOWS = (1, 10, 100, 1000, 10_000)
CHAINS = (1, 4, 16, 64, 256, 1024)
POINTS = (200, 2000, 20_000, 200_000)


def clock(call: Callable[[], Any], *, budget_s: float = 2.0, most: int = 7) -> tuple[float, Any]:
    """Median seconds of a call and its last result; one call before warms up, unless it alone used the budget."""
    times = []
    begun = time.perf_counter()
    result = call()
    first = time.perf_counter() - begun
    while len(times) < most and sum(times) + first < budget_s:
        begun = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - begun)
    return statistics.median(times) if times else first, result


def update(windows: Windows, chains: int | None = None) -> dict[str, float]:
    """Seconds of the statistics pass, of the mode, and of the whole update with its draws."""
    import torch

    from avtorch.inference import JerkDensity, JerkStatistics, SamplerSettings, find_mode, sample

    settings = SamplerSettings() if chains is None else SamplerSettings(chains=chains)
    rows = [torch.from_numpy(x) for x in (windows.a, windows.u, windows.jerk)]
    statistics_s, sums = clock(lambda: JerkStatistics.from_samples(*rows))
    density = JerkDensity(sums)
    mode_s, mode = clock(lambda: find_mode(density))
    generator = torch.Generator().manual_seed(1)
    walk_s, _ = clock(lambda: sample(density, settings, mode=mode, generator=generator))
    total = statistics_s + mode_s + walk_s
    return {"statistics_s": statistics_s, "mode_s": mode_s, "sampling_s": walk_s, "total_s": total}


def grow(*, quick: bool = False) -> dict[str, Any]:
    """All rows, and those of mini-batching (`benchmarks.peers.minibatch`)."""
    from benchmarks.peers.minibatch import minibatch

    windows, chains, points = (WINDOWS[:2], CHAINS[:2], POINTS[:2]) if quick else (WINDOWS, CHAINS, POINTS)

    def timed(name: str, value: int, row: dict[str, float]) -> dict[str, float]:
        print(f"{name} {value}: {1e3 * row['total_s']:.1f} ms", file=sys.stderr, flush=True)
        return {name: value, **row}

    update(make_windows(2), 4)  # the loading time of the first call is not part of the growth
    return {
        "windows": [timed("windows", n, update(make_windows(n, seed=3))) for n in windows],
        "chains": [timed("chains", n, update(make_windows(1, seed=4), n)) for n in chains],
        "points": [timed("points", n, update(make_windows(1, points=n, seed=5))) for n in points],
        "minibatch": [row for n in points for row in minibatch(n, quick=quick)],
    }


def in_own_process(core: int, *, quick: bool) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.peers.scaling", str(core), *(["--quick"] if quick else [])]
    root = Path(__file__).resolve().parents[2]
    return json.loads(subprocess.run(command, cwd=root, stdout=subprocess.PIPE, text=True, check=True).stdout)


def main() -> None:
    pin(int(sys.argv[1]))
    import torch

    torch.set_num_threads(1)
    print(json.dumps(grow(quick="--quick" in sys.argv)))


if __name__ == "__main__":
    main()
