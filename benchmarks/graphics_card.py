"""A graphics card beside two cores of its machine and beside BlackJAX's NUTS on the same card, in one run.

    python -m benchmarks.graphics_card [--out FOLDER] [--sizes 10 100 1000 10000 100000] [--patience 150]

Windows of the peers' benchmark, one call for all of them: `sample` with chains for 2000 effective draws. The cores work
beside the card; each part is a process of its own, held to its own cores, and ends after its patience with what it has.
`--device cpu` tries the script out where there is no card.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.problem import make_windows

#: Windows of which the effective draws are counted.
COUNTED = 100
CHAINS = 320
#: Of the peers, by their settings for many windows at once.
PEERS = ("blackjax-nuts-whitened", "blackjax-nuts-stan")
PARTS = ("cores", "card", "profile", "peers")


class Figures:
    """Lines of a part, each on disk as soon as it is there."""

    def __init__(self, path: Path) -> None:
        self.path, self.lines = path, list[dict[str, Any]]()

    def add(self, **line: Any) -> None:
        self.lines.append(line)
        print(json.dumps(line), flush=True)
        self.path.write_text(json.dumps(self.lines, indent=1), encoding="utf-8")


def timed(call: Callable[[], Any], most: int = 5, enough_s: float = 12.0) -> tuple[Any, float, list[float]]:
    """The last answer, seconds of the first call, and of those after it, until there are enough."""
    first, rest, found = 0.0, list[float](), None
    for k in range(most + 1):
        begun = time.perf_counter()
        found = call()
        spent = time.perf_counter() - begun
        if k:
            rest.append(spent)
        else:
            first = spent
        if sum(rest) + first * (k == 0) > enough_s and (rest or first > 30):
            break
    return found, first, rest or [first]


def ess(draws: Any) -> float:
    """Effective draws of the worst parameter, the median over the first windows of ``(chain, draw, window, 3)``."""
    from avtorch.inference.chains import effective_sample_size, normal_scores

    return float(effective_sample_size(normal_scores(draws[:, :, :COUNTED])).median(0).values.min())


def line(windows: int, first: float, rest: list[float], draws: float) -> dict[str, Any]:
    seconds = float(np.median(rest))
    each = 1e3 * seconds / windows * max(1.0, 2000 / draws)
    return {
        "windows": windows,
        "first_s": first,
        "s": seconds,
        "spread_s": [min(rest), max(rest)],
        "ess": draws,
        "ms_a_window_to_2000": each,
        "ess_per_s": draws * windows / seconds,
    }


def sampled(device: str, sizes: list[int], into: Figures) -> None:
    """`sample` for so many windows at once."""
    import torch

    from avtorch.inference import SamplerSettings, sample

    for count in sizes:
        density = density_on(device, count)

        def call(density: Any = density) -> Any:
            generator = torch.Generator(device).manual_seed(1)
            posterior = sample(density, SamplerSettings(chains=CHAINS), generator=generator)
            wait(device)
            return posterior

        posterior, first, rest = timed(call)
        good = float(posterior.converged.double().mean())
        into.add(device=device, converged=good, **line(count, first, rest, ess(posterior.draws)))


def density_on(device: str, windows: int) -> Any:
    import torch

    from avtorch.inference import JerkDensity, JerkStatistics

    rows = make_windows(windows, seed=3)
    columns = (torch.from_numpy(x).to(device) for x in (rows.a, rows.u, rows.jerk))
    return JerkDensity(JerkStatistics.from_samples(*columns))


def wait(device: str) -> None:
    import torch

    if device == "cuda":
        torch.cuda.synchronize()


def cores(args: argparse.Namespace, into: Figures) -> None:
    import torch

    torch.set_num_threads(2)
    sampled("cpu", args.sizes, into)


def card(args: argparse.Namespace, into: Figures) -> None:
    sampled(args.device, args.sizes, into)


def profile(args: argparse.Namespace, into: Figures) -> None:
    """Where the time of one call goes: stages, and lines that wait for the card."""
    import torch

    from avtorch.inference import SamplerSettings, sample, sampler

    stages = ("find_mode", "stiffness", "_walk", "_summary", "_diverged", "constrained", "compare_with_exact")
    plain = {name: getattr(sampler, name) for name in stages}
    for count in (args.sizes[len(args.sizes) // 2], args.sizes[-1]):
        spent: Counter[str] = Counter()
        density = density_on(args.device, count)

        def call(density: Any = density) -> Any:
            generator = torch.Generator(args.device).manual_seed(1)
            return sample(density, SamplerSettings(chains=CHAINS), generator=generator)

        def held(name: str, spent: Counter[str] = spent) -> Callable[..., Any]:
            def stage(*given: Any, **options: Any) -> Any:
                wait(args.device)
                begun = time.perf_counter()
                out = plain[name](*given, **options)
                wait(args.device)
                spent[name] += time.perf_counter() - begun  # pyright: ignore[reportArgumentType]
                spent[f"{name} calls"] += 1
                return out

            return stage

        call()
        for name in stages:
            setattr(sampler, name, held(name))
        begun = time.perf_counter()
        call()
        wait(args.device)
        into.add(windows=count, stages=dict(spent), whole_s=time.perf_counter() - begun)
        for name in stages:
            setattr(sampler, name, plain[name])
        if args.device == "cuda":
            with warnings.catch_warnings(record=True) as waits:
                warnings.simplefilter("always")
                torch.cuda.set_sync_debug_mode("warn")
                call()
                torch.cuda.set_sync_debug_mode("default")
            places = Counter(f"{Path(w.filename).name}:{w.lineno}" for w in waits)
            into.add(windows=count, waits=sum(places.values()), places=places.most_common(30))


def peers(args: argparse.Namespace, into: Figures) -> None:
    """Vmapped NUTS; programs of all sizes are compiled at the same time, as that takes longest."""
    os.environ["JAX_ENABLE_X64"] = "1"
    import jax
    import torch

    from benchmarks.peers.registry import METHODS

    def compiled(name: str, count: int) -> tuple[Any, Any, float]:
        runner, begun = METHODS[name].build(METHODS[name].batch or {}), time.perf_counter()
        arguments = jax.random.split(jax.random.key(1), count), jax.numpy.asarray(make_windows(count, seed=3).sums())
        return runner._many.lower(*arguments).compile(), arguments, time.perf_counter() - begun

    with ThreadPoolExecutor(10) as pool:
        programs = {(n, c): pool.submit(compiled, n, c) for n in PEERS for c in args.sizes}
        wait_for(programs.values(), timeout=0.5 * args.patience)
        for (name, count), program in programs.items():
            try:
                run, arguments, compiling = program.result()
                draws, first, rest = timed(lambda run=run, given=arguments: jax.block_until_ready(run(*given)))
                kept = torch.from_numpy(np.array(draws[:COUNTED])).permute(1, 2, 0, 3)
                into.add(
                    peer=name, on=str(jax.devices()[0]), compiling_s=compiling, **line(count, first, rest, ess(kept))
                )
                del draws
            except Exception as error:  # a size too large is a line, not the end
                into.add(peer=name, windows=count, error=f"{type(error).__name__}: {error}"[:300])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/graphics_card"))
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 100, 1000, 10_000, 100_000])
    parser.add_argument("--patience", type=float, default=150.0, help="seconds that a part may take")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.part:
        globals()[args.part](args, Figures(args.out / f"{args.part}.json"))
        return
    mine = [x for i, x in enumerate(sys.argv[1:], 1) if x != "--parts" and x not in PARTS]
    available = sorted(os.sched_getaffinity(0))
    running = []
    for part in args.parts:
        own = available[:2] if part == "cores" else available[2:] or available
        command = [sys.executable, "-m", "benchmarks.graphics_card", *mine, "--part", part]
        begun = time.perf_counter()
        process = subprocess.Popen(command, preexec_fn=lambda own=own: os.sched_setaffinity(0, own))
        if part == "cores":
            running.append(process)
            continue
        try:
            process.wait(args.patience)
        except subprocess.TimeoutExpired:
            process.kill()
        print(f"{part}: {time.perf_counter() - begun:.0f} s, {process.wait()}", flush=True)
    for process in running:
        try:
            process.wait(args.patience)
        except subprocess.TimeoutExpired:
            process.kill()


if __name__ == "__main__":
    main()
