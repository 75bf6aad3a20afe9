"""Cost of updating the belief: seconds per 2 s window, for one vehicle and for many in one batch.

    python -m benchmarks.real_time [--repeats 5] [--chains 128] [--threads 2] [--vehicles 1000]

A window has 200 rows at 100 Hz and is sampled with the default settings, by one thread unless told otherwise. The aims
are an update in less than 5 % of the window's length, a cost that grows more slowly than the number of vehicles, and
1000 vehicles of 128 chains each in less than 0.5 s on two cores. The share is of processor time, which grows less than
wall time on a busy machine; wall time is printed beside it.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from avtorch.inference import BeliefStream, SamplerSettings
from avtorch.vehicle.glvd import glvd_jerk, glvd_rollout

WINDOW_S, RATE_HZ = 2.0, 100.0
AIM = 0.05


def drive(vehicles: int, windows: int, seed: int = 0) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Rows of ``vehicles`` of different lags and gains behind commands of two sines, jerk noise 0.1 m/s^3."""
    g = torch.Generator().manual_seed(seed)
    time_s = torch.arange(round(windows * WINDOW_S * RATE_HZ), dtype=torch.float64) / RATE_HZ
    draw = torch.rand(5, vehicles, 1, generator=g, dtype=torch.float64)
    lag, gain, size = 0.2 + 1.0 * draw[0], 0.6 + 0.4 * draw[1], 0.7 + draw[2]
    u = size * (torch.sin(2 * time_s + 6.28 * draw[3]) + 0.5 * torch.sin(5 * time_s + 6.28 * draw[4]))
    later = glvd_rollout(torch.zeros(vehicles, dtype=torch.float64), u, lag[:, 0], gain[:, 0], 1 / RATE_HZ)
    a = torch.cat([torch.zeros(vehicles, 1, dtype=torch.float64), later[:, :-1]], -1)
    jerk = glvd_jerk(a, u, lag, gain) + 0.1 * torch.randn(a.shape, generator=g, dtype=torch.float64)
    return time_s, {"accel_cmd": u, "accel": a, "jerk": jerk}


def seconds_per_window(vehicles: int, repeats: int = 5, chains: int | None = None) -> tuple[list[float], list[float]]:
    """Clock and processor seconds of the first window and of each of the ``repeats`` that follow; all are excited."""
    time_s, columns = drive(vehicles, repeats + 1)
    options = {} if chains is None else {"settings": SamplerSettings(chains=chains)}
    stream = BeliefStream(window=WINDOW_S, vehicles=vehicles, **options)
    rows = round(WINDOW_S * RATE_HZ)
    by_clock, by_processor = [], []
    for k in range(repeats + 1):
        part = slice(k * rows, (k + 1) * rows)
        block = {name: value[:, part] for name, value in columns.items()}
        begun, begun_processor = time.perf_counter(), time.process_time()
        (window,) = stream.feed(time_s[part], block, until=(k + 1) * WINDOW_S)
        by_clock.append(time.perf_counter() - begun)
        by_processor.append(time.process_time() - begun_processor)
        assert bool(window.belief.excited.all()), "an unexcited window would cost nothing"
    return by_clock, by_processor


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Seconds per window, for one vehicle and for many.")
    parser.add_argument("--repeats", type=int, default=5, help="windows timed after the first")
    parser.add_argument("--chains", type=int, default=SamplerSettings().chains)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 10, 100, 1000])
    given = parser.parse_args()
    repeats, chains = given.repeats, given.chains
    torch.set_num_threads(given.threads)
    threads = "one thread" if given.threads == 1 else f"{given.threads} threads"
    print(f"window {WINDOW_S:g} s at {RATE_HZ:g} Hz, {chains} chains, {threads}, torch {torch.__version__}")
    heads = ("vehicles", "first [s]", "clock [s]", "processor [s]", "of window", "per vehicle", "against one")
    print("".join(f"{head:>14}" for head in heads))
    one = None
    for vehicles in given.vehicles:
        by_clock, by_processor = seconds_per_window(vehicles, repeats, chains)
        clock, median = statistics.median(by_clock[1:]), statistics.median(by_processor[1:])
        one = median if one is None else one
        print(
            f"{vehicles:14d}{by_clock[0]:14.4f}{clock:14.4f}{median:14.4f}{median / WINDOW_S:14.2%}"
            f"{1e3 * median / vehicles:11.3f} ms{median / one:12.1f} x"
        )
    if one is None or given.vehicles[0] != 1:
        return
    verdict = "met" if one / WINDOW_S < AIM else "MISSED"
    print(f"aim for one vehicle: below {AIM:.0%} of the window: {verdict}")


if __name__ == "__main__":
    main()
