"""A command that the workbench runs: as it is typed, as Python, and as a process with progress that can be ended."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

_PERCENT = re.compile(r"(\d+) %")


@dataclass(frozen=True)
class Task:
    """`avtorch diagnose` of one log, or `avtorch compare` of two, by their names in the workplace, into the folder
    `out`; `map`, `unit`: columns that are not as the log and the file beside it say."""

    logs: Sequence[str]
    out: str
    map: Mapping[str, str] = field(default_factory=dict)
    unit: Mapping[str, str] = field(default_factory=dict)
    follower: bool = False

    @property
    def arguments(self) -> list[str]:
        """Of `avtorch`."""
        # a name that begins with a dash would be an option
        given = [f"./{name}" if name.startswith("-") else name for name in self.logs]
        given += [f"--map={key}={name}" for key, name in self.map.items()]
        given += [f"--unit={key}={name}" for key, name in self.unit.items()]
        if len(self.logs) == 2:
            return ["compare", *given, "--out", self.out]
        return ["diagnose", *given, "--follower" if self.follower else "--credibility", "--out", self.out]

    @property
    def command(self) -> str:
        """The line to type in the folder of the workbench."""
        return shlex.join(["avtorch", *self.arguments])

    @property
    def python(self) -> str:
        """Python that gives the same answer."""
        own = ", ".join(
            [*map(repr, self.logs), *(f"{k}={dict(x)!r}" for k in ("map", "unit") if (x := getattr(self, k)))]
        )
        if len(self.logs) == 2:
            return f"import avtorch\n\nprint(avtorch.compare({own}))"
        if self.follower:
            return f"from avtorch import follower, io\n\nprint(follower.diagnose_follower(io.read_following({own})))"
        return (
            "import avtorch\nfrom avtorch.report import write_report\n\n"
            f'found = avtorch.diagnose({own}, posterior="sgld")\n'
            f"print(found)\nfound.write({self.out!r})\nwrite_report(found, {self.out!r})"
        )


class Job:
    """A task as a process in the folder `root`, which waits for one of the `slots`. `state` is waiting, running, done,
    failed or cancelled; `percent` and `line` tell how far it is, `fault` in one sentence why it failed.

    A process of its own can be ended at any moment, shares no threads with other tabs, and takes its memory along.
    """

    def __init__(self, task: Task, root: Path, slots: threading.Semaphore) -> None:
        self.task, self._root, self._slots = task, root, slots
        self.state: Literal["waiting", "running", "done", "failed", "cancelled"] = "waiting"
        self.percent, self.line, self.fault = 0, "Waiting for another run to end", ""
        self._process: subprocess.Popen[str] | None = None
        self._lock = threading.Lock()
        self._cancelled = False
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        last: deque[str] = deque(maxlen=20)
        with self._slots:
            with self._lock:
                if self._cancelled:
                    self.state = "cancelled"
                    return
                self._process = process = subprocess.Popen(
                    [sys.executable, "-m", "avtorch.cli", *self.task.arguments],
                    cwd=self._root,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    encoding="utf-8",
                    errors="replace",
                    env=os.environ | {"AVTORCH_PROGRESS_S": "0.5", "PYTHONIOENCODING": "utf-8"},
                )
                self.state, self.line = "running", "Starting"
            assert process.stderr is not None
            with process.stderr as lines:
                for line in lines:
                    last.append(line.strip())
                    if (told := _PERCENT.search(line)) is not None:
                        self.percent, self.line = int(told[1]), line.strip()
            code = process.wait()
        if code and not self._cancelled:
            own = [line.removeprefix("avtorch: ") for line in last if line.startswith("avtorch: ")]
            self.fault = own[-1] if own else f"The command ended with code {code}; run it in a terminal to see why"
        self.state = "cancelled" if self._cancelled else "failed" if code else "done"

    def cancel(self) -> None:
        """End it as Ctrl-C does, by force where it does not end."""
        with self._lock:
            self._cancelled = True
            process = self._process
        if process is not None and process.poll() is None:
            process.send_signal(signal.SIGINT) if os.name == "posix" else process.terminate()
            threading.Timer(5.0, lambda: process.kill() if process.poll() is None else None).start()
