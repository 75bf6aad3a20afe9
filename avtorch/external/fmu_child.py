"""The process of an FMU, seen from here: requests, answers, and what became of it."""

from __future__ import annotations

import json
import math
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.external import fmu_process
from avtorch.external.fmu_process import NOT_RUNNING

OPENING_SECONDS = 120.0
"""For unpacking, for loading and for the begin of a drive: starting the tool behind an FMU can take a minute."""


class FmuProcess:
    """An FMU in a process of its own, with its `listing` of variables. Raises InputError where it cannot be opened."""

    def __init__(self, path: Path, source: str, timeout_s: float) -> None:
        self.source = source
        folder = tempfile.TemporaryDirectory(prefix="avtorch_fmu_", ignore_cleanup_errors=True)
        clock = Path(folder.name, "clock")
        clock.write_bytes(np.array([NOT_RUNNING]).tobytes())
        with clock.open("rb") as file:
            view = memoryview(mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)).cast("d")
        unpacked = Path(folder.name, "fmu")
        unpacked.mkdir()
        # -P: nothing of the folder that the user happens to work in; a file, as its package would load PyTorch
        command = [sys.executable or "python", "-P", "-W", "ignore", fmu_process.__file__]
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(part for part in sys.path if part))
        try:
            self._process = subprocess.Popen(
                [*command, os.fspath(path), source, os.fspath(unpacked), os.fspath(clock)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd=folder.name,  # where it may write what it likes
                env=environment,
                start_new_session=True,  # with the tools that an FMU starts
            )
        except (OSError, ValueError) as fault:
            raise InputError(f"{self.source}: no process can be started to run it ({fault})") from None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests, self._answers = self._process.stdin, self._process.stdout
        self._watch = _Watch(self._process, view)
        self._finish = weakref.finalize(self, _end, self._process, self._watch, folder)
        self._watch.start()
        with self._watched(OPENING_SECONDS):
            self.listing: dict[str, Any] = self._answer()
            if "refused" in self.listing:
                raise InputError(self.listing["refused"])
        self._seconds = timeout_s

    @property
    def alive(self) -> bool:
        return self._finish.alive

    def ask(self, request: dict[str, Any], numbers: FloatArray | None = None) -> FloatArray:
        """The numbers that answer a request: for steps, with their `numbers`, or to begin a drive. Raises InputError
        naming the simulated time, and ends the process."""
        with self._watched(OPENING_SECONDS if numbers is None else self._seconds):
            with suppress(OSError):  # where it has ended, the answer tells how
                self._requests.write(json.dumps(request).encode() + b"\n")
                if numbers is not None:
                    self._requests.write(np.ascontiguousarray(numbers, dtype=np.float64).tobytes())
                self._requests.flush()
            answer = self._answer()
            if "error" in answer:
                raise self._failed(answer["error"])
            raw = self._answers.read(8 * answer["numbers"])
            if len(raw) != 8 * answer["numbers"]:
                raise self._ended()
        return np.frombuffer(raw, dtype=np.float64).copy()

    @contextmanager
    def _watched(self, seconds: float) -> Iterator[None]:
        """Within it the process is ended when its clock stands still for `seconds`; and by any error, an interruption
        too, after which the rest of an answer would be taken for the next one."""
        self._watch.begin(seconds)
        try:
            yield
        except BaseException:
            self.end()
            raise
        finally:
            self._watch.rest()

    def _answer(self) -> dict[str, Any]:
        try:
            return json.loads(self._answers.readline())
        except ValueError:
            raise self._ended() from None

    def _ended(self) -> InputError:
        if self._watch.late:
            more = "" if self._watch.seconds == OPENING_SECONDS else "; a longer timeout_s gives it more"
            return self._failed(f"it does not answer within {self._watch.seconds:g} s{more}")
        _kill(self._process)
        code = self._process.wait()
        how = f"status {code}"
        if code < 0:
            how = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
        return self._failed(f"it ended the process that ran it ({how})")

    def _failed(self, what: str) -> InputError:
        at = self._watch.clock[0]
        when = "before the first step" if at == NOT_RUNNING else f"in the step that begins at {at:.6g} s of the drive"
        return InputError(f"{self.source}: {when}: {what}")

    def end(self) -> None:
        """End the process, and leave nothing of it."""
        self._finish()


class _Watch(threading.Thread):
    """Ends a process whose clock stands still while it owes an answer; one thread, as starting one takes longer than a
    step."""

    def __init__(self, process: subprocess.Popen, clock: memoryview[float]) -> None:
        super().__init__(daemon=True)
        self.clock = clock
        self.seconds = OPENING_SECONDS
        self.late = False
        self._process = process
        self._asked, self._owes = 0, False
        self._over = threading.Event()

    def begin(self, seconds: float) -> None:
        self.seconds, self._asked, self._owes = seconds, self._asked + 1, True

    def rest(self) -> None:
        self._owes = False

    def end(self) -> None:
        self._over.set()

    def run(self) -> None:
        shown, since = (0, math.nan), time.monotonic()
        while not self._over.wait(min(self.seconds / 8, 1.0)):
            now = (self._asked, self.clock[0])
            if not self._owes or now != shown:
                shown, since = now, time.monotonic()
            elif time.monotonic() - since > self.seconds:
                self.late = True
                _kill(self._process)
                return


def _kill(process: subprocess.Popen) -> None:
    with suppress(OSError):
        if hasattr(os, "killpg") and process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        else:  # Windows has no groups to end
            process.kill()


def _end(process: subprocess.Popen, watch: _Watch, folder: tempfile.TemporaryDirectory) -> None:
    watch.end()
    _kill(process)
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):  # a request that nobody will read
                stream.close()
    folder.cleanup()
