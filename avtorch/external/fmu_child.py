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
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.external import fmu_process
from avtorch.external.fmu_process import NOT_RUNNING

OPENING_SECONDS = 120.0
"""For unpacking and loading: hundreds of MB take seconds, starting the tool behind an FMU can take a minute."""


class FmuProcess:
    """An FMU in a process of its own, with its `listing` of variables. Raises InputError where it cannot be opened."""

    def __init__(self, path: Path, source: str, step_seconds: float) -> None:
        self.source = source
        self._seconds = step_seconds
        self._late = False
        folder = tempfile.TemporaryDirectory(prefix="avtorch_fmu_", ignore_cleanup_errors=True)
        clock = Path(folder.name, "clock")
        clock.write_bytes(np.array([NOT_RUNNING]).tobytes())
        with clock.open("rb") as file:
            self._clock = memoryview(mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)).cast("d")
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
        self._finish = weakref.finalize(self, _end, self._process, folder)
        try:
            self.listing: dict[str, Any] = self._answer(OPENING_SECONDS)
        except BaseException:
            self.end()
            raise
        if "refused" in self.listing:
            self.end()
            raise InputError(self.listing["refused"])

    @property
    def alive(self) -> bool:
        return self._finish.alive

    def ask(self, request: dict[str, Any], numbers: FloatArray | None = None) -> FloatArray:
        """The numbers that answer a request. Raises InputError naming the simulated time, and ends the process."""
        try:
            return self._asked(request, numbers)
        except BaseException:  # an interruption, too: the rest of the answer would be taken for the next one
            self.end()
            raise

    def _asked(self, request: dict[str, Any], numbers: FloatArray | None) -> FloatArray:
        stream = self._process.stdin
        assert stream is not None
        with suppress(OSError):  # where it has ended, the answer tells how
            stream.write(json.dumps(request).encode() + b"\n")
            if numbers is not None:
                stream.write(np.ascontiguousarray(numbers, dtype=np.float64).tobytes())
            stream.flush()
        answer = self._answer(self._seconds)
        if "error" in answer:
            raise self._failed(answer["error"])
        raw = self._within(lambda stream: stream.read(8 * answer["numbers"]), self._seconds)
        if len(raw) != 8 * answer["numbers"]:
            raise self._ended(self._seconds)
        return np.frombuffer(raw, dtype=np.float64).copy()

    def _answer(self, seconds: float) -> dict[str, Any]:
        try:
            return json.loads(self._within(lambda stream: stream.readline(), seconds))
        except ValueError:
            raise self._ended(seconds) from None

    def _within(self, read: Callable[[Any], bytes], seconds: float) -> bytes:
        """What `read` takes of the answer; the process is ended when its clock stands still for `seconds`."""
        done = threading.Event()

        def watch() -> None:
            shown, since = math.nan, time.monotonic()
            while not done.wait(min(seconds / 8, 1.0)):
                if self._clock[0] != shown:
                    shown, since = self._clock[0], time.monotonic()
                elif time.monotonic() - since > seconds:
                    self._late = True
                    _kill(self._process)
                    return

        threading.Thread(target=watch, daemon=True).start()
        try:
            return read(self._process.stdout)
        finally:
            done.set()

    def _ended(self, seconds: float) -> InputError:
        if self._late:
            return self._failed(f"it does not answer within {seconds:g} s; a longer step_seconds gives it more")
        _kill(self._process)
        code = self._process.wait()
        how = f"status {code}"
        if code < 0:
            how = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
        return self._failed(f"it ended the process that ran it ({how})")

    def _failed(self, what: str) -> InputError:
        at = self._clock[0]
        when = "before the first step" if at == NOT_RUNNING else f"in the step that begins at {at:.6g} s of the drive"
        return InputError(f"{self.source}: {when}: {what}")

    def end(self) -> None:
        """End the process, and leave nothing of it."""
        self._finish()


def _kill(process: subprocess.Popen) -> None:
    with suppress(OSError):
        if hasattr(os, "killpg") and process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        else:  # Windows has no groups to end
            process.kill()


def _end(process: subprocess.Popen, folder: tempfile.TemporaryDirectory) -> None:
    _kill(process)
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):  # a request that nobody will read
                stream.close()
    folder.cleanup()
