"""One sealed case: a log as the car would have written it, and, kept apart from it, the cause, its size and onset."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from avtorch.errors import InputError
from avtorch.io import Log, write_json
from benchmarks.blindtest.car import Car
from benchmarks.blindtest.catalogue import EFFECTS
from benchmarks.blindtest.command import Parameters
from benchmarks.blindtest.drives import DrivePlan
from benchmarks.blindtest.oracle_budget import oracle_budget
from benchmarks.blindtest.recorder import Recorder
from benchmarks.blindtest.replay import Replay
from benchmarks.blindtest.vehicle import Run
from benchmarks.blindtest.visibility import Oracle, Sight

_MOVING_MPS = 0.3  # slower rows are masked

Kind = Literal["none", "single", "pair", "outside", "several"]


@dataclass(frozen=True, eq=False)
class Case:
    """One sealed case.

    `kind` and `names` (alphabetical; empty for `none`) are the truth; `parameters` by name; `onset_s`: when the cause
    begins to act (None: from the start; for `gain_change` alone, the time of the change). `visibility`, `tier`: see
    `benchmarks.blindtest.visibility`; `visibility_each`: visibility of each effect of a pair, alone on the same drive.
    `oracles`: rollout errors, by metric, of GLVD and of a model that knows the cause.
    `recorder`: what the log is written by; visibility, tier and oracles are those of the drive before it. `replay`: of
    a case of several causes, the drive again with only some of them; `signals`: the channels that its budget is of.

    Example:
        >>> from benchmarks.blindtest import draw_case
        >>> case = draw_case(0, seed=1, mix={"single": 1.0}, effects=["sensor_bias"], tiers=["easy"], seconds=20.0)
        >>> case.truth_name, case.tier, "sensor_bias" in str(case.log())  # not in the log
        ('sensor_bias', 'easy', False)
    """

    index: int
    seed: int
    kind: Kind
    names: tuple[str, ...]
    parameters: Parameters
    onset_s: float | None
    onset_scored: bool
    visibility: float
    visibility_each: Mapping[str, float]
    tier: str | None
    car: Car
    drive: DrivePlan
    run: Run
    refit: Sight
    oracles: Mapping[str, Oracle]
    recorder: Recorder = field(default_factory=Recorder.ideal)
    replay: Replay | None = None
    signals: tuple[str, ...] = ("accel", "speed")

    @property
    def name(self) -> str:
        """Name of the case, independent of its cause."""
        return f"case_{self.index:05d}"

    @property
    def truth_name(self) -> str:
        """The correct verdict: `none`, `unknown`, or the case's effects joined by `+`."""
        known = "+".join(name for name in self.names if name in EFFECTS)
        return {"none": "none", "outside": "unknown"}.get(self.kind, known)

    @cached_property
    def budget(self) -> dict[str, Any] | None:
        """What each of several causes contributes to the gap (`benchmarks.blindtest.oracle_budget`); None for other
        kinds."""
        return None if self.replay is None else oracle_budget(self.replay, self.log(signals=self.signals)).to_dict()

    @property
    def parts(self) -> list[dict[str, Any]]:
        """Where the cause is known to act, by axis: since its onset, below a speed, while braking."""
        run, parts = self.run, []
        if self.onset_s is not None and self.onset_scored:
            parts.append({"axis": "time", "from": self.onset_s, "to": float(run.time[-1])})
        if self.names == ("low_speed_creep",):
            ends = self.parameters["low_speed_creep"]["ends_mps"]
            parts.append({"axis": "speed", "from": _MOVING_MPS, "to": ends})
        if self.names == ("brake_throttle_asymmetry",):
            parts.append({"axis": "command", "from": float(run.command.min()), "to": 0.0})
        return parts

    def log(self, *, signals: Sequence[str] = ("accel", "speed")) -> Log:
        """The log given to a diagnosis, as the recorder wrote it: `time`, `accel_cmd`, `engaged`, the channels in
        `signals`."""
        columns: dict[str, np.ndarray] = {"accel": self.run.accel, "speed": self.run.speed}
        if not signals or set(signals) - columns.keys():
            raise InputError(f"signals: found {tuple(signals)}, needs accel, speed or both")
        columns |= {"time": self.run.time, "accel_cmd": self.run.command, "engaged": np.ones(len(self.run.time), int)}
        if self.recorder != Recorder.ideal():
            seed = int(np.random.default_rng([self.seed, self.index, 5]).integers(2**63))
            written = self.recorder.record(self._from(columns), seed)
            columns = {name: getattr(written, name) for name in columns}
        always = ("time", "accel_cmd", "engaged")
        return self._from({name: x for name, x in columns.items() if name in (*always, *signals)})

    def _from(self, columns: Mapping[str, np.ndarray]) -> Log:
        """Checked, and bit for bit what a log read from a file is."""
        return Log.from_arrays(
            name=self.name,
            time=columns["time"],
            accel_cmd=columns["accel_cmd"],
            accel=columns.get("accel"),
            speed=columns.get("speed"),
            engaged=columns["engaged"].astype(int),
        )

    def truth(self) -> dict[str, Any]:
        """The hidden truth as plain numbers and strings: the input of `benchmarks.blindtest.score`.

        Where the recorder is not the ideal one, its numbers are in `recorder`, and `oracle` is empty: the floors of the
        oracles lack its noise. A case of several causes has its `budget`, and under `outside` those of its causes that
        are not in the table.
        """
        truth = {
            "schema": "avtorch.blindtest.truth/1",
            "case": self.name,
            "index": self.index,
            "seed": self.seed,
            "kind": self.kind,
            "names": list(self.names),
            "verdict": self.truth_name,
            "parameters": {name: dict(values) for name, values in self.parameters.items()},
            "onset_s": self.onset_s,
            "onset_scored": self.onset_scored,
            "where": self.parts,
            "visibility": self.visibility,
            "visibility_each": dict(self.visibility_each),
            "tier": self.tier,
            "baseline": {"T_L": self.car.T_L, "K_L": self.car.K_L},
            "refit": {"T_L": self.refit.T_L, "K_L": self.refit.K_L},
            "noise": {k: v for k, v in asdict(self.car).items() if k not in ("T_L", "K_L")},
            # truths kept before there were stops stay as they are
            "drive": {key: value for key, value in asdict(self.drive).items() if key != "stops" or value},
            "oracle": {metric: {**asdict(o), "closed": o.closed} for metric, o in self.oracles.items()},
        }
        if self.replay is not None:
            truth |= {"budget": self.budget, "outside": [name for name in self.names if name not in EFFECTS]}
        # truths kept by trials without recorders stay as they are
        if self.recorder == Recorder.ideal():
            return truth
        return truth | {"recorder": asdict(self.recorder), "oracle": {}}


def write(case: Case, folder: str | os.PathLike[str]) -> Path:
    """Write `folder/logs/NAME.csv`, which a diagnosis may read, and `folder/truth/NAME.json`, which it may not.

    Returns the path of the log. Each file is written whole or not at all, the truth first.

    Example:
        >>> from benchmarks.blindtest import draw_case, write
        >>> path = write(draw_case(0, seed=1, mix={"none": 1.0}, seconds=10.0), "cases")
        >>> path.parent.name, path.suffix
        ('logs', '.csv')
    """
    path = Path(folder) / "logs" / f"{case.name}.csv"
    write_json(Path(folder) / "truth" / f"{case.name}.json", case.truth())
    case.log().write(path)
    return path
