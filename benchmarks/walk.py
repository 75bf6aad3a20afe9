"""The compiled walk beside the eager one: the same windows in turn, one thread; medians of the ratios of pairs.

    python -m benchmarks.walk [--pairs 9]

Processor seconds. A size has a line for the walk alone and one for a whole update: mode, walk, check of the draws.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from avtorch.inference import SamplerSettings, find_mode, sample
from avtorch.inference.sampler import walk
from benchmarks.peers.own import density_of
from benchmarks.peers.problem import make_windows

#: Windows and chains: one log's, the peers' table, a fleet's.
SIZES = ((1, 320), (1, 1024), (300, 320), (1000, 128))
WAYS = ("eager", "auto")


def seconds(call: Callable[[], object]) -> float:
    begun = time.process_time()
    call()
    return time.process_time() - begun


def pairs(calls: dict[str, Callable[[], object]], count: int, repeats: int) -> dict[str, list[float]]:
    """Seconds of each call, in turn, so that a slow minute affects both; one round before it is not counted."""
    times: dict[str, list[float]] = {way: [] for way in calls}
    for k in range(count + 1):
        for way, call in calls.items():
            spent = seconds(lambda call=call: [call() for _ in range(repeats)]) / repeats
            if k > 0:
                times[way].append(spent)
    return times


def measure(windows: int, chains: int, count: int) -> None:
    """Print both lines of one size."""
    density = density_of(make_windows(windows, seed=3))
    mode, slow = find_mode(density), torch.ones(windows, dtype=torch.float64)
    settings = {way: SamplerSettings(chains=chains, walk=way) for way in WAYS}
    g = torch.Generator().manual_seed(1)
    steps = settings["eager"].burn_in + settings["eager"].draws * settings["eager"].thinning
    walks = {w: lambda s=s: walk(density, mode, s, slowdown=slow, generator=g) for w, s in settings.items()}
    updates = {w: lambda s=s: sample(density, s, generator=g) for w, s in settings.items()}
    for name, calls, share, unit in (
        ("walk", walks, 1e9 / (windows * chains * steps), "ns a chain-step"),
        ("update", updates, 1e3 / windows, "ms a window"),
    ):
        times = pairs(calls, count, repeats=20 if windows == 1 else 1)
        ratio = statistics.median(a / b for a, b in zip(times["eager"], times["auto"], strict=True))
        each = ", ".join(f"{way} {share * statistics.median(times[way]):.3g}" for way in WAYS)
        print(f"{windows} windows, {chains} chains, {name}: {each} {unit}; {ratio:.2f} x", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=9)
    count = parser.parse_args().pairs
    torch.set_num_threads(1)
    for windows, chains in SIZES:
        measure(windows, chains, count)


if __name__ == "__main__":
    main()
