"""A soak of the live watch: cars at 100 Hz for as long as there is time, faults all along, every answer checked.

Rows of simulated cars go through `avtorch.live` as lines of JSON, as fast as they are taken. Among them are lines that
are reordered, doubled, late, corrupt and implausible; every stretch of 20 s ends with a stop and a start from the
states on disk, and every tenth stretch is killed half-way and done again. A second run takes the same rows, without the
faults, car by car as whole columns (the batch run): every answer has to be its answer, to the bit.

    make soak                         # 100 cars, a week of driving, or until Ctrl-C
    make soak SOAK="--hours 8 --cars 100 --minutes 30"

It goes on where it ended. In the folder (`out/soak`) are `soak.json`, `soak.md` and the states.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Generator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Event

import numpy as np
import torch
from scipy.stats import linregress, t

from avtorch.arrays import FloatArray
from avtorch.inference.stream import packed, unpacked
from avtorch.io.answers import atomic
from avtorch.io.log import STANDSTILL_MPS
from avtorch.live import Answer, Batch, Counts, KeptCars, LineParser, LiveSettings, LiveWatch, Row, watch_source
from avtorch.live.car import window_answer
from avtorch.live.watch_source import line_of

RATE_HZ, PERIOD_S = 100, 0.01
CHUNK_S, CHUNKS = 2, 10
"""Seconds of rows made at once, and how many of these make a stretch between two starts."""
KILL_EVERY = 10
"""Stretches of which one is killed and done again."""
FAULTS = {"reordered": 2e-3, "doubled": 2e-3, "late": 5e-4, "corrupt": 1e-3, "implausible": 5e-4}
"""Share of the rows of each fault."""
LATER_ROWS = 30
"""Rows of the car itself that come before a late one: 0.3 s, where 0.05 s are waited for."""
COLUMNS = ("accel_cmd", "accel", "speed", "jerk")
WARM_UP = 0.2
"""Share of the samples of memory, the first, that are left out of the slope: caches fill."""


@dataclass(frozen=True)
class Chunk:
    """Rows of all cars in `CHUNK_S`: the lines as sent, how many faults of each kind, and the columns of every car
    without the rows that come late, (column, time), the first the time [s]."""

    lines: list[bytes]
    faults: dict[str, int]
    rows: list[FloatArray]


def chunk(number: int, cars: int, seed: int = 0) -> Chunk:
    """Chunk `number` of the drive; the same whenever it is made."""
    rng = np.random.default_rng([seed, number])
    per_car = CHUNK_S * RATE_HZ
    clock = (number * per_car + np.arange(per_car)) / RATE_HZ
    columns = drive(clock, cars, rng)
    lost = [set() for _ in range(cars)]
    faults: Counter[str] = Counter()
    text: list[list[bytes]] = []
    for car in range(cars):
        head = f'{{"car": "car {car}", "time": '
        values = columns[car].T.tolist()
        text.append(
            [
                f'{head}{t!r}, "accel_cmd": {u!r}, "accel": {a!r}, "speed": {v!r}, "jerk": {j!r}}}'.encode()
                for t, u, a, v, j in values
            ]
        )
    # by time and car, the lines one behind the other
    sent = [[text[car][i]] for i in range(per_car) for car in range(cars)]
    for kind, share in FAULTS.items():
        for where in rng.choice(per_car * cars, rng.poisson(share * per_car * cars)).tolist():
            i, car = divmod(where, cars)
            # at the edges of a chunk a row has no neighbour to change places with; a row has one fault at most
            if not 1 <= i < per_car - LATER_ROWS - 2 or sent[where] != [text[car][i]]:
                continue
            if kind == "reordered":
                behind = where + cars
                if sent[behind] != [text[car][i + 1]]:
                    continue
                sent[where], sent[behind] = sent[behind], sent[where]
            elif kind == "doubled":
                sent[where] = 2 * sent[where]
            elif kind == "late":
                sent[where], behind = [], where + LATER_ROWS * cars
                sent[behind] = [*sent[behind], text[car][i]]
                lost[car].add(i)
            elif kind == "corrupt":
                sent[where] = [text[car][i][: 5 + where % 60], *sent[where]]
            else:
                sent[where] = [text[car][i].replace(b'"jerk": ', b'"jerk": 1e9, "was": '), *sent[where]]
            faults[kind] += 1
    rows = [np.delete(columns[car], sorted(lost[car]), axis=1) for car in range(cars)]
    return Chunk([line for lines in sent for line in lines], dict(faults), rows)


def drive(clock: FloatArray, cars: int, rng: np.random.Generator) -> FloatArray:
    """Columns (car, column, time) of cars of different lags and gains, as rounded as they are sent.

    The command is two sines of nearly one period and a third, so that lively minutes follow calm ones; its answer is in
    closed form, so that any chunk can be made without those before it.
    """
    car = np.arange(cars)[:, None, None]
    lag, gain = 0.2 + 0.1 * (car % 12), 1.0 - 0.05 * (car % 9)
    pulse = np.array([1.1, 1.13, 0.37])[:, None] * (1 + 0.01 * (car % 7))
    size = np.array([0.8, 0.8, 0.1])[:, None]
    phase = pulse * clock + 1.7 * car
    command = (size * np.sin(phase)).sum(1)
    shrunk, behind = size * gain / np.sqrt(1 + (pulse * lag) ** 2), phase - np.arctan(pulse * lag)
    accel = (shrunk * np.sin(behind)).sum(1)
    speed = 25.0 - (shrunk / pulse * np.cos(behind)).sum(1)
    jerk = (gain[:, 0] * command - accel) / lag[:, 0]
    noise = rng.standard_normal((3, cars, len(clock)))
    measured = (command, accel + 0.05 * noise[0], speed + 0.02 * noise[1], jerk + 0.1 * noise[2])
    times = np.broadcast_to(np.round(clock + 1000.0, 3), command.shape)
    return np.stack([times, *(np.round(x, 5) for x in measured)], 1)


class Stretch:
    """The lines of a stretch as a source that is read on from a position, the number of a line since the first."""

    identity = "simulated cars"

    def __init__(self, parser: LineParser, chunks: list[Chunk], begin: int) -> None:
        self.parser, self.chunks, self.begin = parser, chunks, begin

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract of a source."""
        number = self.begin
        for part in self.chunks:
            for first in range(0, len(part.lines), 500):
                rows: list[Row] = []
                for line in part.lines[first : first + 500]:
                    number += 1
                    if start is None or number > start:
                        row = self.parser.row(line)
                        if row is not None:
                            rows.append(row)
                yield Batch(rows, number)


class Killed(Exception):
    """The watch ends in the middle of a batch, as by a crash."""


class Collected:
    """Answers by car and window; one that is told again, after a kill, has to be the same. `kill` after so many."""

    def __init__(self, kill: int | None = None) -> None:
        self.lines: dict[str, str] = {}
        self.told_apart = 0
        self.left = kill

    def write(self, answer: Answer) -> bool:
        if answer.ended is None:
            return True
        key, line = f"{answer.car}/{answer.number}", line_of(answer)
        self.told_apart += self.lines.setdefault(key, line) != line
        if self.left is not None:
            self.left -= 1
            if self.left <= 0:
                self.left = None
                raise Killed
        return True

    def flush(self) -> None: ...

    def close(self) -> None: ...


@dataclass
class Progress:
    """What has been done, as it is kept between two runs; `rss_mib` after each stretch, by simulated hours."""

    cars: int
    seed: int
    stretches: int = 0
    lines: int = 0
    rows: int = 0
    windows: int = 0
    equal: int = 0
    different: int = 0
    restarts: int = 0
    kills: int = 0
    told_again: int = 0
    seconds: float = 0.0
    live_seconds: float = 0.0
    injected: dict[str, int] = field(default_factory=dict)
    counted: dict[str, int] = field(default_factory=dict)
    again: dict[str, int] = field(default_factory=dict)
    rss_mib: list[tuple[float, float]] = field(default_factory=list)
    pending: dict[str, str] = field(default_factory=dict)
    examples: list[str] = field(default_factory=list)

    @property
    def hours(self) -> float:
        """Simulated."""
        return self.stretches * CHUNKS * CHUNK_S / 3600


class Soak:
    """A soak in `folder`, which goes on from what is there. Raises `ValueError` for what is of another soak."""

    def __init__(self, folder: Path, cars: int, seed: int = 0) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.settings = LiveSettings(estimator="map", cars=cars, seed=seed)
        self.kill_after = 5 * cars  # answers of a stretch: half of them
        self.progress = Progress(cars, seed)
        self.setting = self.settings.setting()
        form = self.settings.form_of(set(COLUMNS))
        assert form is not None
        self.batch = [self.settings.watch(f"car {car}", form) for car in range(cars)]
        self.numbers = [0] * cars
        self._load()

    def stretch(self) -> None:
        """The next `CHUNKS` chunks: live, with a kill where it is its turn, then as a batch; compare, and keep."""
        p, begun = self.progress, time.monotonic()
        first = p.stretches * CHUNKS
        chunks = [chunk(first + i, p.cars, p.seed) for i in range(CHUNKS)]
        faults: Counter[str] = sum((Counter(part.faults) for part in chunks), Counter())
        told = Collected(kill=self.kill_after if p.stretches % KILL_EVERY == KILL_EVERY - 1 else None)
        live = time.monotonic()
        try:
            watch = self._live(chunks, told)
        except Killed:
            p.kills += 1
            # what is read again may be counted again
            p.again = dict(Counter(p.again) + faults)
            watch = self._live(chunks, told)
        p.live_seconds += time.monotonic() - live
        p.restarts += 1
        p.lines += sum(len(part.lines) for part in chunks)
        p.injected = dict(Counter(p.injected) + faults)
        p.counted = {**watch.counts.refused, "reordered": watch.counts.reordered}
        p.rows, p.windows = watch.counts.rows, watch.counts.windows
        p.told_again += told.told_apart
        p.pending |= self._batch(chunks)
        for key, line in told.lines.items():
            expected = p.pending.pop(key, None)
            if line == expected:
                p.equal += 1
            else:
                p.different += 1
                p.examples = [*p.examples, f"{line} {expected}"][:3]
        p.stretches += 1
        p.seconds += time.monotonic() - begun
        p.rss_mib.append((round(p.hours, 5), rss_mib()))
        self._keep()

    def _live(self, chunks: list[Chunk], told: Collected) -> LiveWatch:
        """A watch from the states on disk, over the stretch, and its states back to disk."""
        counts = Counts()
        watch = LiveWatch(self.settings, counts)
        source = Stretch(LineParser(counts), chunks, self.progress.lines)
        watch_source(source, watch, [told], kept=KeptCars(self.folder / "state", source.identity))
        return watch

    def _batch(self, chunks: list[Chunk]) -> dict[str, str]:
        """Answers of the batch run, by car and window."""
        out: dict[str, str] = {}
        for car, watch in enumerate(self.batch):
            rows = torch.from_numpy(np.concatenate([part.rows[car] for part in chunks], 1))
            signals = dict(zip(COLUMNS, rows[1:], strict=True))
            usable = signals["speed"] >= STANDSTILL_MPS
            for watched in watch.feed(rows[0], signals, self.setting, usable=usable):
                self.numbers[car] += 1
                number, name = self.numbers[car], f"car {car}"
                entry = window_answer(name, number, watched)
                out[f"{name}/{number}"] = line_of(Answer(entry, name, number, 0.0))
        return out

    def _keep(self) -> None:
        state = {"numbers": self.numbers, "watches": [watch.state_dict() for watch in self.batch]}
        files = {
            "batch.state": packed({**state, "lines": self.progress.lines}),
            "soak.json": (json.dumps(asdict(self.progress), indent=1) + "\n").encode(),
            "soak.md": summary(self.progress).encode(),
        }
        for name, content in files.items():
            with atomic(self.folder / name, binary=True) as stream:
                stream.write(content)

    def _load(self) -> None:
        path = self.folder / "soak.json"
        if not path.exists():
            if (self.folder / "state").exists():
                raise ValueError(f"{self.folder}: holds states without soak.json; needs another folder")
            return
        found = Progress(**json.loads(path.read_text()))
        if (found.cars, found.seed) != (self.progress.cars, self.progress.seed):
            raise ValueError(
                f"{path}: is of {found.cars} cars and seed {found.seed}; needs the same, or another folder"
            )
        found.rss_mib = [(hours, mib) for hours, mib in found.rss_mib]
        state = unpacked((self.folder / "batch.state").read_bytes(), self.folder / "batch.state", "use another folder")
        position = KeptCars(self.folder / "state", Stretch.identity).restore(LiveWatch(self.settings))
        if not state["lines"] == found.lines == position:
            raise ValueError(f"{self.folder}: was killed between two of its files; needs another folder")
        for watch, saved in zip(self.batch, state["watches"], strict=True):
            watch.load_state_dict(saved)
        self.progress, self.numbers = found, state["numbers"]


def rss_mib() -> float:
    """Resident memory of this process [MiB]."""
    with open("/proc/self/statm") as stream:
        pages = int(stream.read().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


def slope(samples: list[tuple[float, float]]) -> tuple[float, float] | None:
    """MiB per simulated hour and half of its 95 % interval, from means of eight parts: neighbours depend on each
    other."""
    kept = np.array(samples[int(WARM_UP * len(samples)) :])
    if len(kept) < 16:
        return None
    means = np.array([part.mean(0) for part in np.array_split(kept, 8)])
    fit = linregress(means[:, 0], means[:, 1])
    return float(fit.slope), float(t.ppf(0.975, 6) * fit.stderr)  # pyright: ignore[reportAttributeAccessIssue]


def summary(p: Progress) -> str:
    """A page for people."""
    hours, speed = p.hours, p.hours * 3600 / max(p.seconds, 1e-9)
    live = p.hours * 3600 / max(p.live_seconds, 1e-9)
    lines = [
        f"# Soak: {p.cars} cars at {RATE_HZ} Hz, {hours:.2f} simulated hours each",
        "",
        f"- {p.rows} rows in {p.lines} lines, {p.windows} windows, {p.restarts} starts from states, {p.kills} kills",
        f"- answers equal to the batch run's, to the bit: {p.equal}; different: {p.different}; "
        f"told differently after a kill: {p.told_again}",
        f"- {p.seconds:.0f} s of this machine, {speed:.2f} times real time ({live:.2f} without making the rows and "
        f"without the batch run); a week of them takes {168 / max(speed, 1e-9):.0f} hours",
    ]
    found = slope(p.rss_mib)
    if p.rss_mib:
        lines.append(f"- resident memory: {p.rss_mib[0][1]:.0f} MiB at first, {p.rss_mib[-1][1]:.0f} MiB at last")
    if found is not None:
        lines.append(f"- its slope behind the first fifth: {found[0]:+.2f} ± {found[1]:.2f} MiB an hour (95 %)")
    lines += ["", "| fault | injected | counted | read again after kills, at most |", "|---|---|---|---|"]
    for kind in FAULTS:
        cells = [table.get(kind, 0) for table in (p.injected, p.counted, p.again)]
        lines.append(f"| {kind} | {cells[0]} | {cells[1]} | {cells[2]} |")
    other = {kind: many for kind, many in p.counted.items() if kind not in FAULTS and many}
    lines += ["", f"Counted besides: {other or 'nothing'}.", ""]
    return "\n".join([*lines, "Verdict: " + ("; ".join(faults_of(p)) or "nothing wrong"), ""])


def faults_of(p: Progress) -> list[str]:
    """What is wrong, in words; empty where nothing is."""
    found = []
    if p.different or p.told_again:
        found.append(f"{p.different + p.told_again} answers are not the batch run's")
    # of each car one window may be closed by the batch run alone, as its rows are not kept back
    if len(p.pending) > p.cars:
        found.append(f"{len(p.pending)} answers are missing")
    for kind in {*FAULTS, *p.counted}:
        injected, counted = p.injected.get(kind, 0), p.counted.get(kind, 0)
        if not injected <= counted <= injected + p.again.get(kind, 0):
            found.append(f"{kind}: {injected} injected, {counted} counted")
    grown = slope(p.rss_mib)
    if grown is not None and grown[0] - grown[1] > 1.0:
        found.append(f"memory grows by {grown[0]:.1f} MiB an hour")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cars", type=int, default=100)
    parser.add_argument("--hours", type=float, default=168.0, help="simulated, of every car")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="of this machine, at most")
    parser.add_argument("--folder", type=Path, default=Path("out/soak"))
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    soak, stop, begun = Soak(given.folder, given.cars, given.seed), Event(), time.monotonic()
    before = signal.getsignal(signal.SIGINT)

    def on(number: int, frame: object) -> None:
        stop.set()
        print("ends behind this stretch; the same command goes on from there", file=sys.stderr)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, on)
    while not stop.is_set() and soak.progress.hours < given.hours and time.monotonic() - begun < 60 * given.minutes:
        soak.stretch()
        p = soak.progress
        print(
            f"{p.hours:8.3f} of {given.hours:g} h, {p.hours * 3600 / p.seconds:5.2f} times real time, "
            f"{p.different} different, {p.rss_mib[-1][1]:.0f} MiB",
            file=sys.stderr,
            flush=True,
        )
    print(summary(soak.progress))
    sys.exit(1 if faults_of(soak.progress) else 0)


if __name__ == "__main__":
    main()
