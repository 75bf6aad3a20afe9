"""An FMU as a simulator: FMI 2 and 3, co-simulation, run by FMPy in a process of its own."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, printable, quoted
from avtorch.external import fmu_process
from avtorch.external.fmu_variables import REALS, SIGNALS, STARTS, Variable, ports
from avtorch.io.mapping import mapping_beside
from avtorch.io.opening import place, read_toml

OPENING_S = 120.0
"""For unpacking, for loading and for the begin of a drive: starting the tool behind an FMU can take a minute."""
_WHOLE = 1e-6  # how far from a whole number of an FMU's steps a step of the log may be: clocks write 6 digits
_OTHER_START = 1e-6  # m/s or m/s², beyond which an FMU begins elsewhere than it was told


class FmuSimulator:
    """An FMU that takes a demanded acceleration and answers with acceleration and speed; a `Simulator`.

    `map`: the FMU's variables by signal: `accel_cmd`, `accel`, `speed`, and `speed0`, `accel0` for the start of a
    drive; `unit`: units by signal, where the FMU states none or a wrong one. Both may stand in a TOML file, in the
    tables `[fmu]` and `[fmu.unit]`: the one beside the FMU (`car.toml` beside `car.fmu`), overruled by the one that
    `mapping` names. A signal without a name is the variable that has the signal's own name, or the only one that it can
    be by causality, unit and name. `notes` says what was taken for what.

    Start: where `speed0` and `accel0` are mapped, or the FMU lets the start values of its two outputs be set, a drive
    begins at the speed and acceleration asked for; otherwise at the FMU's own, which `notes` then says. The command is
    held at that acceleration while the FMU initialises.

    Steps: an FMU that states a step of its own gets whole numbers of it; one that takes steps of any length gets parts
    of the log's step, none longer than its own.

    It runs in a process of its own. A crash, an error, an answer that is not finite, or a step that takes longer than
    `timeout_s` (120 s to begin a drive) ends that process and is an InputError that names the simulated time; the
    next `reset` starts another. `close`, or leaving a `with` block, ends it for good.

    Raises InputError for what is no FMU with co-simulation for this machine, for a signal that is not found or may be
    several variables (with the candidates), for a unit of another quantity, and without `pip install 'avtorch[fmu]'`.

    Example:
        >>> from avtorch.external import FmuSimulator, write_fmu
        >>> from avtorch.gap import plant
        >>> _ = write_fmu(plant(baseline="dead_time=0.2", T_L=0.4), "car.fmu")
        >>> with FmuSimulator("car.fmu") as car:
        ...     car.reset(speed=20.0, accel=0.0)
        ...     accel, speed = car.step(1.0, 0.1)  # a command of 1 m/s², held for 0.1 s
        >>> round(speed, 1)
        20.0
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        map: Mapping[str, str] | None = None,
        unit: Mapping[str, str] | None = None,
        mapping: str | os.PathLike[str] | None = None,
        timeout_s: float = 10.0,
    ) -> None:
        if not (isinstance(timeout_s, int | float) and 0 < timeout_s <= 86400):
            raise InputError(f"timeout_s: found {timeout_s!r}, needs a number of seconds up to 86400")
        self.path = Path(path)
        source = place(path)
        if importlib.util.find_spec("fmpy") is None:
            raise InputError(f"{source}: is an FMU; reading it needs fmpy: pip install 'avtorch[fmu]'")
        if not self.path.is_file():
            what = "is no regular file" if self.path.exists() else "no such file"
            raise InputError(f"{source}: {what}; an FMU is needed")
        names, units = _told(self.path, mapping)
        names |= _known("map", map, (*SIGNALS, *STARTS))
        units |= _known("unit", unit, SIGNALS)
        self._process = _Process(self.path.absolute(), source, float(timeout_s))
        self._listing = self._process.begun()
        self._variables = [Variable(**v) for v in self._listing["variables"]]
        try:
            self._ports = ports(source, self._variables, names, units)
        except InputError:
            self.close()
            raise
        self._values: dict[str, float] = {}
        self._start_notes: tuple[str, ...] = ()
        self._drive: object | None = None  # as long as it is also the process's, the drive goes on
        self._step: float | None = None  # where an FMU that states none wants all steps alike
        self._time = 0.0  # s of the drive

    # what it is ----------------------------------------------------------------------------------------------------
    @property
    def notes(self) -> tuple[str, ...]:
        """What was taken for what, in which unit and in which steps, and where the last drive began."""
        listing, h = self._listing, self._listing["step"]
        made = f", made by {printable(listing['made_by'], 60)}" if listing["made_by"] else ""
        notes = [f"{place(self.path)}: {listing['form']}{made}"]
        notes += [port.note for port in self._ports.values()]
        notes += [f"{s}: cannot be set; a drive begins at the FMU's own" for s in STARTS if s not in self._ports]
        taken = {port.variable.name for port in self._ports.values()}
        if rest := [v.name for v in self._variables if v.causality == "input" and v.name not in taken]:
            notes.append(f"inputs that keep their start values: {listed(rest)}")
        if h:
            notes.append(f"steps of {h:g} s" + (" or shorter" if listing["variable_step"] else ", no others"))
        return (*notes, *self._start_notes)

    def parameters(self) -> dict[str, float]:
        """The FMU's numeric parameters with the values of the next drive, in the FMU's own units."""
        return {name: self._values.get(name, v.start) for name, v in self._settable().items() if v.start is not None}

    def with_parameters(self, values: Mapping[str, float]) -> FmuSimulator:
        """The same FMU with other values of its `parameters`, set when a drive begins; it shares this one's process, of
        which the latest drive has the use. Raises InputError for other names and for values beyond the FMU's limits.
        """
        known = self._settable()
        for name, value in values.items():
            if name not in known:
                raise InputError(f"parameters: found {quoted(str(name))}, needs one of {listed(known) or 'none'}")
            v = known[name]
            whole = v.type in REALS or float(value).is_integer()
            least, most = (-math.inf if v.least is None else v.least), (math.inf if v.most is None else v.most)
            if not (math.isfinite(value) and whole and least <= value <= most):
                right = f"{'a finite' if whole else 'a whole'} number from {least:g} to {most:g}"
                raise InputError(f"{printable(name, 40)}: found {value!r}, needs {right}")
        return self._copy(_values=self._values | {name: float(value) for name, value in values.items()})

    def apart(self) -> FmuSimulator:
        """The same FMU with the same parameters in another process, which `close` ends."""
        return self._copy(_process=self._process.another())

    def _copy(self, **changed: Any) -> FmuSimulator:
        other = copy(self)
        other.__dict__.update(changed, _drive=None, _start_notes=())
        return other

    def _settable(self) -> dict[str, Variable]:
        starts = {self._ports[s].variable.name for s in STARTS if s in self._ports}
        return {
            v.name: v
            for v in self._variables
            if v.causality == "parameter" and v.settable and v.start is not None and v.name not in starts
            and v.type.lstrip("U").rstrip("0123456789") in ("Real", "Float", "Integer", "Int")
        }  # fmt: skip

    # drives --------------------------------------------------------------------------------------------------------
    def reset(self, *, speed: float, accel: float) -> None:
        """Begin a drive at this speed [m/s] and acceleration [m/s²], as far as the FMU lets them be set. Raises
        InputError where the FMU does not initialise."""
        for name, value in (("speed", speed), ("accel", accel)):
            if not math.isfinite(value):
                raise InputError(f"{name}: found {value!r}, needs a finite number")
        values, command = dict(self._values), self._ports["accel_cmd"]
        for name, value in (("speed0", speed), ("accel0", accel)):
            if name in self._ports:
                values[self._ports[name].variable.name] = value / self._ports[name].factor
        outputs = [self._ports[s].variable.name for s in ("accel", "speed")]
        request = {"values": values, "command": command.variable.name, "at": accel / command.factor, "outputs": outputs}
        self._process.begun()
        (begun,) = self._process.ask(request, OPENING_S)
        self._drive = self._process.drive = object()
        self._step, self._time, notes = None, 0.0, []
        for name, unit, shown, asked in zip(
            ("accel", "speed"), ("m/s²", "m/s"), begun["shown"], (accel, speed), strict=True
        ):
            at = shown * self._ports[name].factor
            if not abs(at - asked) <= _OTHER_START:
                notes.append(f"{name}: the FMU begins at {at:g} {unit}, the drive at {asked:g} {unit}")
        self._start_notes = tuple(notes)

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        """Hold the command [m/s²] for `dt` [s]; the acceleration [m/s²] and speed [m/s] at the end of it.

        Raises InputError where no drive has begun, for a `dt` that is no whole number of the FMU's steps, and where the
        FMU fails.
        """
        accel, speed = self._advance(np.array([accel_cmd], dtype=np.float64), np.array([dt], dtype=np.float64))
        return float(accel[0]), float(speed[0])

    def whole_drive(
        self, accel_cmd: ArrayLike, dt: ArrayLike, *, speed: float, accel: float
    ) -> tuple[FloatArray, FloatArray]:
        """`reset`, then one step for each command (row,) [m/s²], of one length or of each row's own (row,) [s]: the
        accelerations (row,) [m/s²] and speeds (row,) [m/s] at the ends of the steps.

        The same as step by step, in one message to the process of the FMU. Raises InputError as `reset` and `step`.
        """
        command = np.atleast_1d(np.asarray(accel_cmd, dtype=np.float64))
        steps = np.asarray(dt, dtype=np.float64)
        if command.ndim != 1 or steps.ndim > 1 or (steps.ndim == 1 and len(steps) != len(command)):
            raise InputError(
                f"accel_cmd, dt: found shapes {command.shape} and {steps.shape}, needs (row,), and one step or as many"
            )
        steps = np.broadcast_to(steps, command.shape)
        self._parts(steps, None)  # before the FMU starts
        self.reset(speed=speed, accel=accel)
        return self._advance(command, steps)

    def _advance(self, command: FloatArray, dt: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self._drive is None or self._process.drive is not self._drive:
            raise InputError(f"{place(self.path)}: no drive is under way; needs reset first")
        if not np.isfinite(command).all():
            raise InputError(f"accel_cmd: found {command[~np.isfinite(command)][0]}, needs finite numbers")
        length, count = self._parts(dt, self._step)
        if not len(command):
            return command.copy(), command.copy()
        self._step = float(dt[0])
        sent = (command / self._ports["accel_cmd"].factor).tolist()
        steps = list(zip(sent, length.tolist(), count.astype(int).tolist(), strict=True))
        times = self._time + np.cumsum(np.append(0.0, dt))
        answers = self._process.ask({"steps": steps}, self._process.timeout_s, times[:-1].tolist())
        self._time = float(times[-1])
        shown = np.array([answer["shown"] for answer in answers])
        return shown[:, 0] * self._ports["accel"].factor, shown[:, 1] * self._ports["speed"].factor

    def _parts(self, dt: FloatArray, before: float | None) -> tuple[FloatArray, FloatArray]:
        """Length [s] and number of the FMU's steps in each step of the log."""
        if not (able := np.isfinite(dt) & (dt > 0)).all():
            raise InputError(f"dt: found {dt[~able][0]:g} s, needs finite steps above 0 s")
        h, free = self._listing["step"], self._listing["variable_step"]
        if h is None:
            steps = dt if before is None else np.append(dt, before)
            if not free and len(steps) and np.ptp(steps) > _WHOLE * steps[-1]:
                raise InputError(
                    f"dt: found steps from {steps.min():g} to {steps.max():g} s; {place(self.path)} needs steps that "
                    "are all alike, such as a resampled log's"
                )
            return dt, np.ones_like(dt)
        count = np.maximum(np.rint(dt / h), 1.0)
        off = np.abs(dt - count * h) > _WHOLE * dt
        if off.any() and not free:
            down = h * max(math.floor(dt[off][0] / h), 1)
            raise InputError(
                f"dt: found {dt[off][0]:g} s; {place(self.path)} takes steps of {h:g} s, needs a whole number of them, "
                f"such as {down:g} or {down + h:g} s"
            )
        count = np.where(off, np.ceil(dt / h), count)
        return np.where(off, dt / count, h), count

    # its process ---------------------------------------------------------------------------------------------------
    def close(self) -> None:
        """End the process of the FMU; a later `reset` is refused."""
        self._process.close()

    def __enter__(self) -> FmuSimulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"FmuSimulator({os.fspath(self.path)!r})"


class _Process:
    """The process of an FMU, begun again after it has failed; `drive`: the one that it runs."""

    def __init__(self, path: Path, source: str, timeout_s: float) -> None:
        self.source, self.timeout_s = source, timeout_s
        self.drive: object | None = None
        self._path, self._closed = path, False
        self._listing: dict[str, Any] = {}
        self._finish: Any = None

    def another(self) -> _Process:
        return _Process(self._path, self.source, self.timeout_s)

    def close(self) -> None:
        """End it for good."""
        self._closed = True
        self.end()

    def end(self) -> None:
        """End it, and leave nothing of it."""
        self.drive = None
        if self._finish is not None:
            self._finish()

    def begun(self) -> dict[str, Any]:
        """What the FMU has, its process begun where none runs. Raises `InputError` where it cannot be opened."""
        if self._closed:
            raise InputError(f"{self.source}: is closed; needs FmuSimulator(...) again")
        if self._finish is not None and self._finish.alive:
            return self._listing
        folder = tempfile.TemporaryDirectory(prefix="avtorch_fmu_", ignore_cleanup_errors=True)
        # -P: nothing of the folder that the user happens to work in; a file, as its package would load PyTorch
        command = [sys.executable or "python", "-P", "-W", "ignore", fmu_process.__file__]
        try:
            self._child = subprocess.Popen(
                [*command, os.fspath(self._path), os.path.join(folder.name, "fmu")],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd=folder.name,  # where it may write what it likes
                env=dict(os.environ, PYTHONPATH=os.pathsep.join(part for part in sys.path if part)),
                start_new_session=True,  # with the tools that an FMU starts
            )
        except (OSError, ValueError) as fault:
            raise InputError(f"{self.source}: no process can be started to run it ({fault})") from None
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=_forward, args=(self._child.stdout, self._lines), daemon=True).start()
        self._finish = weakref.finalize(self, _end, self._child, folder)
        (self._listing,) = self.ask(None, OPENING_S)
        return self._listing

    def ask(
        self, request: dict[str, Any] | None, timeout_s: float, times: Sequence[float | None] = (None,)
    ) -> list[dict[str, Any]]:
        """The answers to a request, or what the process says first; `times` [s] of the drive at which what each answers
        begins. Any error, an interruption too, ends the process: the rest of an answer would be taken for the next one.
        Raises `InputError` naming the simulated time."""
        try:
            if request is not None:
                with suppress(OSError):  # where it has ended, the answer tells how
                    self._child.stdin.write(json.dumps(request).encode() + b"\n")  # type: ignore[union-attr]
                    self._child.stdin.flush()  # type: ignore[union-attr]
            return [self._answer(timeout_s, at) for at in times]
        except BaseException:
            self.end()
            raise

    def _answer(self, timeout_s: float, at: float | None) -> dict[str, Any]:
        try:
            answer = json.loads(self._lines.get(timeout=timeout_s))
        except queue.Empty:
            more = "" if timeout_s == OPENING_S else "; a longer timeout_s gives it more"
            what = f"it does not answer within {timeout_s:g} s{more}"
        except ValueError:
            self.end()
            code = -self._child.returncode
            how = signal.Signals(code).name if code in signal.valid_signals() else f"status {-code}"
            what = f"it ended the process that ran it ({how})"
        else:
            if "refused" in answer:
                raise InputError(f"{self.source}: {answer['refused']}")
            if "error" not in answer:
                return answer
            what = answer["error"]
        when = "before the first step" if at is None else f"in the step that begins at {at:.6g} s of the drive"
        raise InputError(f"{self.source}: {when}: {what}")


def _forward(stream: IO[bytes], lines: queue.SimpleQueue[bytes]) -> None:
    """The lines of a stream, and an empty one at its end."""
    with suppress(OSError, ValueError):  # closed meanwhile
        for line in stream:
            lines.put(line)
    lines.put(b"")


def _end(process: subprocess.Popen[bytes], folder: tempfile.TemporaryDirectory[str]) -> None:
    with suppress(OSError):
        if hasattr(os, "killpg") and process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        else:  # Windows has no groups to end
            process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):  # a request that nobody will read
                stream.close()
    folder.cleanup()


def _told(path: Path, mapping: str | os.PathLike[str] | None) -> tuple[dict[str, str], dict[str, str]]:
    """Names and units by the TOML file beside the FMU, overruled by the one that was named."""
    names: dict[str, str] = {}
    units: dict[str, str] = {}
    for file, links in ((mapping_beside(path), False), (mapping, True)):
        if file is None:
            continue
        here, table = f"{place(file)}: ", read_toml(file, links=links).get("fmu", {})
        if not isinstance(table, dict):
            raise InputError(f"{here}fmu is no table; write [fmu] and its lines below")
        inner = table.get("unit", {})
        if not isinstance(inner, dict):
            raise InputError(f"{here}[fmu] unit is no table; write [fmu.unit] and its lines below")
        own = {key: value for key, value in table.items() if key != "unit"}
        names |= _known(f"{here}[fmu]", own, (*SIGNALS, *STARTS))
        units |= _known(f"{here}[fmu.unit]", inner, SIGNALS)
    return names, units


def _known(where: str, given: Mapping[str, Any] | None, signals: tuple[str, ...]) -> dict[str, str]:
    for name, value in (given or {}).items():
        if name not in signals:
            raise InputError(f"{where} {printable(str(name), 40)}: not known; signals: {', '.join(signals)}")
        if not isinstance(value, str):
            raise InputError(f"{where} {name}: is a {type(value).__name__}; a text is needed")
    return dict(given or {})
