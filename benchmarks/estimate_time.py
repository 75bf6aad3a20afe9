"""How long does `estimate` take for a log as cars record them, on one core?

``python -m benchmarks.estimate_time [--seconds 60] [--seed 1]``

A car with a lag of 0.3 s and a gain of 0.95 answers steps of its command, read by noisy sensors at several rates: speed
alone or with accel, at even steps or with a clock that jitters by a fifth of a step. The dead time is inferred. Windows
without excitation cost next to nothing, so the command moves all the time. Processor seconds.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from scipy.signal import lfilter

from avtorch import Log, estimate

ACCEL_SD, SPEED_SD, JITTER, STEP_S = 0.1, 0.03, 0.2, 1.5


def drive(rate_hz: float, seconds: float, seed: int, *, accel: bool, jitter: bool) -> Log:
    """A drive, as its recorder has it."""
    rng, dt = np.random.default_rng(seed), 1 / rate_hz
    rows = round(seconds * rate_hz)
    command = np.repeat(rng.normal(size=round(seconds / STEP_S) + 1), round(STEP_S * rate_hz))[:rows]
    keep = np.exp(-dt / 0.3)
    motion = lfilter([0.0, 0.95 * (1 - keep)], [1, -keep], command)
    speed = 30.0 + np.concatenate([[0.0], np.cumsum(0.5 * dt * (motion[1:] + motion[:-1]))])
    stamps = dt * np.arange(rows) + (JITTER * dt * rng.uniform(-1, 1, rows) if jitter else 0.0)
    columns = {"accel_cmd": command, "speed": speed + max(0.0, 3.0 - speed.min()) + rng.normal(0, SPEED_SD, rows)}
    if accel:
        columns["accel"] = motion + rng.normal(0, ACCEL_SD, rows)
    return Log.from_arrays(time=stamps - stamps[0], name="drive", **columns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)
    estimate(drive(50.0, 10.0, given.seed, accel=True, jitter=True), dead_time=None)  # what is loaded and compiled once
    print("| rate [Hz] | channels | clock | windows, excited | s | times faster |\n|---|---|---|---|---|---|")
    for rate in (20.0, 50.0, 100.0):
        for accel in (False, True):
            for jitter in (False, True):
                log = drive(rate, given.seconds, given.seed, accel=accel, jitter=jitter)
                begun = time.process_time()
                found = estimate(log, dead_time=None)
                spent = time.process_time() - begun
                excited = round(found.excited_share * len(found.windows))
                channels, clock = "speed, accel" if accel else "speed", "jitters" if jitter else "even"
                cells = (f"{rate:g}", channels, clock, f"{len(found.windows)}, {excited}", f"{spent:.1f}")
                print(f"| {' | '.join(cells)} | {log.seconds / spent:.0f} |", flush=True)


if __name__ == "__main__":
    main()
