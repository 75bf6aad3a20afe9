"""The simulator that comes back, on stretches of recordings that taught nothing, beside black boxes in the same run.

``AVTORCH_DATA=DIR python -m benchmarks.repair [--only TEXT] [--json FILE]``

Each recording is cut into stretches of about 20 s; every other one teaches. Over the rest each model runs free for
10 s at a time, begun at the measured speed after 3 s in which it sees what was measured: the best GLVD with a gain and
a lag, the plant that `diagnose` hands back, and what an engineer fits in an afternoon (`black_boxes`). Figures are root
mean square errors of speed [m/s]. The last columns: the interval of what a black box still gains over the plant, in
shares of the squared error, and what the best one did gain.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from avtorch import diagnose
from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.io.log import STANDSTILL_MPS
from benchmarks.black_boxes import BLACK_BOXES, Driven, PlantDriven, Stretch, free_run
from benchmarks.recordings import SETS, folder

CHUNK_S, WARM_S, FREE_S = 20.0, 3.0, 10.0
_UNITS = ["speed=m/s", "accel_cmd=m/s2"]  # said, as a nominal command may be far from what the car does
RECORDINGS = {
    {"genesis, three laps": "genesis", "indy_av21": "AV-21"}.get(name, name): SETS[name]
    for name in (
        *("genesis, three laps", "indy_av21", "roboracer, one mass", "roboracer, training", "roboracer, validation"),
        *("roboracer, tyres", "dart, 10:02", "dart, 10:27", "volvo_truck"),
    )
}
"""Recordings with a command in m/s² and 38 s or more, by name: their files."""
SLOWEST_HZ = 20.0
"""Rate [Hz] at which models run free; a slower recording keeps its own."""


@dataclass
class Result:
    """One recording: errors of speed by model [m/s], what the diagnosis said of the rest, and seconds of it."""

    name: str
    taught_s: float
    seconds: float = 0.0
    rmse: dict[str, float] = field(default_factory=dict)
    verdict: tuple[str, ...] = ()
    unexplained: tuple[float, float] | None = None
    noise: bool = False
    runs: int = 0

    @property
    def best(self) -> float:
        """Error of the best black box."""
        return min(self.rmse[name] for name in BLACK_BOXES)

    @property
    def gain(self) -> float:
        """Share of the plant's squared error that the best black box takes off."""
        return max(0.0, 1 - (self.best / self.rmse["ours"]) ** 2)

    def line(self) -> str:
        cells = [self.name, f"{self.taught_s:.0f}", *(f"{x:.3f}" for x in self.rmse.values())]
        low_high = "-" if self.unexplained is None else "{:.2f} to {:.2f}".format(*self.unexplained)
        cells += [f"{self.rmse['ours'] / self.best:.2f}", f"{self.rmse['ours'] / self.rmse['baseline']:.2f}"]
        cells += [low_high + (", noise" if self.noise else ""), f"{self.gain:.2f}"]
        return f"| {' | '.join([*cells, f'{self.seconds:.0f}', '+'.join(self.verdict)])} |"


def pieces(log: Log) -> list[slice]:
    """Stretches of about `CHUNK_S` without a gap."""
    t = log.elapsed
    cuts = np.flatnonzero(np.diff(log.segment) != 0) + 1
    out = []
    for a, b in pairwise([0, *cuts.tolist(), len(t)]):
        edges = np.linspace(a, b, max(1, round((t[b - 1] - t[a]) / CHUNK_S)) + 1).astype(int).tolist()
        out += [slice(i, j) for i, j in pairwise(edges)]
    return out


def examined(name: str, logs: list[Log]) -> Result:
    """Teach on every other stretch, run free over the rest."""
    rows = [(log, piece) for log in logs for piece in pieces(log)]
    taught, held = rows[0::2], rows[1::2]
    train = _taught(taught)
    out = Result(name, train.rows / train.rate_hz)
    begun = time.perf_counter()
    found = diagnose(train)
    out.seconds = time.perf_counter() - begun
    out.verdict = found.verdict.names
    if found.budget is not None:
        rest = found.budget.unexplained
        if rest.still is not None:
            out.unexplained = rest.still.q05, rest.still.q95
        out.noise = rest.rest(found.budget.material) == "noise"
    rate = logs[0].rate_hz
    thin = max(1, round(rate / SLOWEST_HZ))
    dt = thin / rate
    stretches = [_stretch(log, piece, thin, dt) for log, piece in taught]
    assert found.simulator is not None
    models: dict[str, Driven] = {
        "baseline": PlantDriven(found.simulator, dt),
        "ours": PlantDriven(found.plant or found.simulator, dt),
    }
    models |= {key: make(stretches, dt) for key, make in BLACK_BOXES.items()}
    warm, free = round(WARM_S / dt), round(FREE_S / dt)
    errors: dict[str, list[np.ndarray]] = {key: [] for key in models}
    for log, piece in held:
        for run in _runs(_stretch(log, piece, thin, dt), warm, free):
            out.runs += 1
            for key, model in models.items():
                errors[key].append(free_run(model, run, warm, dt) - run.v[warm:])
    if not out.runs:
        raise InputError("no run of a third of the time or more on what taught nothing")
    out.rmse = {key: float(np.sqrt(np.mean(np.concatenate(x) ** 2))) for key, x in errors.items()}
    return out


def _runs(whole: Stretch, warm: int, free: int) -> Iterator[Stretch]:
    """Parts of `warm` and up to `free` rows in which the car moves and obeys, one after the other."""
    a = 0
    while a + warm + free // 3 <= len(whole.u):
        ok = whole.ok[a : a + warm + free]
        end = len(ok) if ok.all() else int(np.flatnonzero(~ok)[0])
        if end < warm + free // 3:
            a += end + 1
            continue
        yield whole.part(slice(a, a + end))
        a += free


def _taught(parts: list[tuple[Log, slice]]) -> Log:
    """The stretches as one log, a segment each."""
    columns: dict[str, list[np.ndarray]] = {}
    begin = 0.0
    for number, (log, rows) in enumerate(parts):
        time = log.elapsed[rows] - log.elapsed[rows][0] + begin
        begin = float(time[-1]) + 10.0
        own = {"time": time, "engaged": log.engaged[rows].astype(float), "segment": np.full(len(time), float(number))}
        own |= {key: x[rows] for key in ("accel_cmd", "accel", "speed") if (x := getattr(log, key)) is not None}
        for key, x in own.items():
            columns.setdefault(key, []).append(x)
    joined: dict[str, Any] = {key: np.concatenate(x) for key, x in columns.items()}
    return Log.from_arrays(name=parts[0][0].name, unit=_UNITS, **joined)


def _stretch(log: Log, rows: slice, thin: int, dt: float) -> Stretch:
    assert log.accel_cmd is not None
    assert log.speed is not None
    v = log.speed[rows][::thin]
    return Stretch.of(log.accel_cmd[rows][::thin], v, (v > STANDSTILL_MPS) & log.engaged[rows][::thin], dt)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default="")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    names = ("baseline", "ours", *BLACK_BOXES)
    print(
        f"| recording | taught [s] | {' | '.join(names)} | ours / best | ours / baseline | rest | gained | s | names |"
    )
    print("|" + "---|" * (len(names) + 8))
    done: list[Result] = []
    for name, files in RECORDINGS.items():
        if given.only not in name:
            continue
        try:
            done.append(examined(name, [Log.read(folder() / file, unit=_UNITS) for file in files]))
        except InputError as error:
            print(f"| {name} | {error} |", flush=True)
            continue
        print(done[-1].line(), flush=True)
    if not done:
        return
    to_best = [r.rmse["ours"] / r.best for r in done]
    worse = sum(r.rmse["ours"] > 1.005 * r.rmse["baseline"] for r in done)
    told = [r for r in done if r.unexplained is not None]
    held = sum(r.unexplained[0] - 0.005 <= r.gain <= r.unexplained[1] + 0.005 for r in told if r.unexplained)
    wrong = sum(r.noise and r.rmse["ours"] > 1.3 * r.best for r in told)
    print(
        f"\nours / best: median {np.median(to_best):.2f}, worst {max(to_best):.2f}; worse than the baseline: {worse} "
        f"of {len(done)}; intervals that hold: {held} of {len(told)}; 'noise' where a black box is > 1.3 times better: "
        f"{wrong}; seconds: median {np.median([r.seconds for r in done]):.0f}"
    )
    if given.json:
        rows: list[dict[str, Any]] = [vars(r) for r in done]
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
