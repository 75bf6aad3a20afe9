"""What a live watch costs: the CPU of a car at 100 Hz, and how long after a window's end its answer comes.

Rows are sent at the pace at which cars send them, for a stated time, as lines of JSON to the watch in this process. The
latency counts from the moment at which the first row behind the window's end was due, so that it holds what waits in
line, too, and the lateness for which rows are kept back (0.05 s).

    python -m benchmarks.watch --cars 20 --seconds 20
    python -m benchmarks.watch --cars 5 --seconds 20 --estimator sgld
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Generator
from threading import Event

import numpy as np
import torch

from avtorch.live import Answer, Batch, Counts, LineParser, LiveSettings, LiveWatch, Row, watch_source
from avtorch.live.car import LiveCar
from avtorch.live.watch_source import line_of
from avtorch.vehicle.glvd import glvd_rollout

RATE_HZ = 100
PERIOD_S = 0.01


def driven(car: int, seconds: float, noise: torch.Generator) -> dict[str, torch.Tensor]:
    """Columns (time,) of a car behind commands of two sines, so that every window is excited."""
    time_s = torch.arange(round(seconds * RATE_HZ), dtype=torch.float64) / RATE_HZ
    command = 1.5 * torch.sin(2.0 * time_s + car) + torch.sin(5.0 * time_s + 2.0 * car)
    lag, gain = (torch.tensor([x], dtype=torch.float64) for x in (0.3 + 0.5 * (car % 2), 1.0 - 0.2 * (car % 2)))
    later = glvd_rollout(torch.zeros(1, dtype=torch.float64), command[None], lag, gain, PERIOD_S)[0]
    accel = torch.cat([torch.zeros(1, dtype=torch.float64), later[:-1]])
    jerk = (gain * command - accel) / lag
    measured = {"accel": accel, "speed": 20.0 + PERIOD_S * accel.cumsum(-1), "jerk": jerk}
    sd = {"accel": 0.05, "speed": 0.02, "jerk": 0.1}
    for name, values in measured.items():
        measured[name] = values + sd[name] * torch.randn(values.shape, dtype=torch.float64, generator=noise)
    return {"accel_cmd": command, **measured}


class Paced:
    """Lines of `cars` cars, each due at a time; `together`: all on one clock, so that their windows end together."""

    identity = None

    def __init__(self, parser: LineParser, cars: int, seconds: float, form: str, *, together: bool) -> None:
        self.parser = parser
        names = ("accel_cmd", "accel", "speed", *(("jerk",) if form == "jerk" else ()))
        due: list[tuple[float, bytes]] = []
        noise = torch.Generator().manual_seed(0)
        for car in range(cars):
            drive = driven(car, seconds, noise)
            columns = {name: drive[name] for name in names}
            begin = 0.0 if together else 2.0 * car / cars  # windows of 2 s end one after the other
            for i, row in enumerate(torch.stack(list(columns.values())).T.tolist()):
                entry = {"car": f"car {car}", "time": round(i / RATE_HZ, 3)}
                entry |= {name: round(value, 5) for name, value in zip(names, row, strict=True)}
                due.append((begin + i / RATE_HZ, json.dumps(entry).encode()))
        due.sort(key=lambda item: item[0])
        self._due, self._lines = np.array([item[0] for item in due]), [item[1] for item in due]
        self.begun = 0.0

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract of a source; a batch has arrived when its first row was due."""
        self.begun = time.monotonic()
        row = 0
        while row < len(self._lines):
            now = time.monotonic() - self.begun
            end = min(int(np.searchsorted(self._due, now, side="right")), row + 600)
            if end == row:
                time.sleep(max(0.0, float(self._due[row]) - now))
                continue
            # one tick a batch, so that a row that waited in line arrived when it was due
            end = min(end, int(np.searchsorted(self._due, self._due[row] + 0.5 * PERIOD_S, side="right")))
            rows: list[Row] = [x for line in self._lines[row:end] if (x := self.parser.row(line)) is not None]
            yield Batch(rows, arrived=self.begun + float(self._due[row]))
            row = end


class Latencies:
    """Seconds from the end of a window to its answer."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def answered(self, answer: Answer, car: LiveCar, seconds: float | None) -> None:
        if seconds is not None:
            self.seconds.append(seconds)


class Written:
    """A sink that makes the lines and keeps none; `used` counts the excited windows, which alone cost a posterior."""

    def __init__(self) -> None:
        self.used = 0

    def write(self, answer: Answer) -> bool:
        line_of(answer)
        self.used += answer.entry["used"]
        return True

    def flush(self) -> None: ...

    def close(self) -> None: ...


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cars", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--estimator", default="auto")
    parser.add_argument("--form", default="jerk", choices=["jerk", "latent"])
    parser.add_argument("--together", action="store_true", help="all windows end at the same time")
    given = parser.parse_args()
    torch.set_num_threads(1)
    counts = Counts()
    watch = LiveWatch(LiveSettings(estimator=given.estimator, form=given.form), counts)
    source = Paced(LineParser(counts), given.cars, given.seconds, given.form, together=given.together)
    # what the estimator compiles is no car's cost
    watch_source(Paced(LineParser(Counts()), 1, 4.5, given.form, together=True), LiveWatch(watch.settings), [])
    latencies, written, cpu, begun = Latencies(), Written(), time.process_time(), time.monotonic()
    watch_source(source, watch, [written], answered=latencies.answered)
    used, took = time.process_time() - cpu, time.monotonic() - begun
    # the last windows are closed early, at the end
    seconds = np.array(latencies.seconds[: -given.cars])
    print(f"{given.cars} cars at {RATE_HZ} Hz, {given.estimator}, {given.form}, windows of 2 s")
    print(f"  {counts.rows} rows in {took:.1f} s, {counts.windows} windows, {written.used} of them used")
    print(f"  CPU: {100 * used / took:.1f} % of one core, {100 * used / took / given.cars:.2f} % a car")
    shown = ", ".join(f"{name} {1e3 * np.quantile(seconds, q):.0f} ms" for name, q in (("p50", 0.5), ("p99", 0.99)))
    print(f"  answer after the end of its window: {shown}, longest {1e3 * seconds.max():.0f} ms")


if __name__ == "__main__":
    main()
