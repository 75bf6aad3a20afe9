"""The parent's end of a worker: start it, order windows from it, read its answers."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from benchmarks.peers.contract import Answer, Method, Settings


class PeerFailed(RuntimeError):
    """A peer raised, or its process ended."""


@dataclass(frozen=True)
class Timed:
    """Seconds of every repeat of a call by the requested clock, the last answer, peak memory so far [MB]."""

    seconds: list[float]
    answer: Answer
    peak_mb: float


class Worker:
    """A method in its own process, which lives until :meth:`close` so that what it compiled is used again."""

    def __init__(
        self, method: Method, settings: Settings, folder: Path, *, core: int, log: Path, clock: str = "wall"
    ) -> None:
        self.method, self.folder, self.clock = method, folder, clock
        self._log = log.open("a", encoding="utf-8")
        command = [sys.executable, "-m", "benchmarks.peers.worker", method.name, json.dumps(settings)]
        self._process = subprocess.Popen(
            [*command, str(folder), str(core)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            cwd=Path(__file__).resolve().parents[2],
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        try:
            self.import_s = float(self._read()["import_s"])
        except PeerFailed:
            self.close()
            raise

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise PeerFailed(f"{self.method.name}: its process ended with {self._process.wait()}; see {self._log.name}")
        fields = json.loads(line)
        if "error" in fields:
            raise PeerFailed(f"{self.method.name}: {fields['error']}")
        return fields

    def _order(self, **fields: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(fields) + "\n")
        self._process.stdin.flush()
        return self._read()

    def log_density(self, windows: str) -> FloatArray | None:
        """Its log density at ``contract.as_log`` of the windows in that file."""
        value = self._order(do="density", windows=windows)["value"]
        return None if value is None else np.asarray(value)

    def run(
        self,
        windows: str,
        *,
        first: int,
        count: int,
        seed: int,
        repeats: int = 1,
        patience_s: float = 0.0,
        keep: int = 100,
    ) -> Timed:
        """Time it on ``count`` windows of a file, up to ``repeats`` times but no new one after ``patience_s``."""
        out = f"{self.method.name}.npz"
        fields = {"windows": windows, "first": first, "count": count, "seed": seed, "out": out, "keep": keep}
        reply = self._order(do="run", repeats=repeats, patience_s=patience_s, **fields)
        with np.load(self.folder / out) as file:
            answer = Answer(**{key: file[key] for key in file.files})
        return Timed(reply[self.clock], answer, float(reply["peak_mb"]))

    def close(self) -> None:
        """End the process and close its pipes."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if self._process.poll() is None:
            try:
                self._process.stdin.write('{"do": "end"}\n')
                self._process.stdin.flush()
                self._process.wait(timeout=20)
            except (OSError, subprocess.TimeoutExpired):
                self._process.kill()
                self._process.wait()
        with contextlib.suppress(OSError):  # data not yet sent to a process that has ended
            self._process.stdin.close()
        self._process.stdout.close()
        self._log.close()
