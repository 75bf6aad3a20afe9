"""The commands put together, and what happens when one is refused or interrupted.

The commands import torch and matplotlib only once their arguments are read: help and a mistyped option answer at once.
"""

from __future__ import annotations

import gc
import inspect
import os
import shlex
import sys
import webbrowser
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CoercionError, CycloptsError, MissingArgumentError, Parameter, ValidationError

from avtorch.cli.arguments import COMMAND_LINE
from avtorch.cli.check import check
from avtorch.cli.compare import compare
from avtorch.cli.diagnose import diagnose
from avtorch.cli.estimate import estimate
from avtorch.cli.fleet import fleet
from avtorch.cli.paper import paper
from avtorch.cli.run import run
from avtorch.cli.simulators import check_simulator
from avtorch.cli.stability import stability
from avtorch.cli.validate import validate
from avtorch.cli.watch import watch
from avtorch.errors import InputError, printable
from avtorch.version import __version__

app = App(
    name="avtorch",
    help="Watch an automated vehicle: from a drive log to a belief about its actuation, and from the belief to action.",
    version=__version__,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


def alone_in_out(command: Callable[..., None]) -> Callable[..., None]:
    """`command`, holding its `out` folder; it stays free where `out` is None.

    A second process in the same folder gets one line (`InputError`) that names the first.
    """
    arguments = inspect.signature(command)

    @wraps(command)
    def held(*args: Any, **kwargs: Any) -> None:
        given = arguments.bind(*args, **kwargs)
        given.apply_defaults()
        out = given.arguments["out"]
        if out is None:
            return command(*args, **kwargs)
        from avtorch.io import sole_use

        with sole_use(out, work=f"avtorch {command.__name__}") as locked:
            if not locked:
                warning = "the file system has no locks; keep other runs out of this folder"
                print(f"avtorch: {out}: {warning}", file=sys.stderr)
            return command(*args, **kwargs)

    return held


def workbench(
    folder: Path = Path(),
    /,
    *,
    port: Annotated[int, Parameter(help="Port of this machine; default: a free one.")] = 0,
    open_page: Annotated[bool, Parameter(name="--open", help="Show the page in your browser.")] = True,
) -> None:
    """Open the workbench: drop a log, confirm its columns, diagnose it, switch effects, save the report.

    A page for your browser, on this machine alone; Ctrl-C ends it. Needs pip install 'avtorch[app]'.

    Parameters
    ----------
    folder
        The folder with your logs; nothing outside it is read. Answers go to its folder out.
    """
    from avtorch.app.serve import server_of
    from avtorch.app.workplace import Workplace

    if not 0 <= port < 65536:
        raise InputError(f"--port: found {port}, needs a number from 1 to 65535")
    server, address = server_of(Workplace.of(folder), port)
    server.start()
    print(f"The workbench is at {address}\nOnly this address opens it. Ctrl-C ends it.", flush=True)
    if open_page:
        server.io_loop.add_callback(webbrowser.open, address)
    try:
        server.io_loop.start()
    finally:
        server.stop()


for _command in (check, check_simulator, watch):
    app.command(_command)
for _command in (run, estimate, diagnose, compare, fleet, stability, validate, paper):
    app.command(alone_in_out(_command))
app.command(workbench, name="app")


def _said(fault: CycloptsError) -> str:
    """What is missing, or the option and what it needs; the parser's own message otherwise."""
    argument = fault.argument
    if argument is None:
        return str(fault)
    if isinstance(fault, MissingArgumentError) and not argument.tokens:
        name = argument.name if argument.index is None else argument.name.lstrip("-").upper()
        return f"{name}: missing; see avtorch {' '.join(fault.command_chain or ())} --help"
    if isinstance(fault, ValidationError):
        return f"{argument.name}: {fault.exception_message}"
    return f"{argument.name}: {fault.msg}" if isinstance(fault, CoercionError) and fault.msg else str(fault)


def use_one_thread() -> None:
    """Give torch and the linear algebra behind it one thread each, where the user has set no other number: tensors are
    small here, and threads that wait for each other take several times as long.

    `OMP_NUM_THREADS` sets all of them, another variable its own library. The libraries read these variables when they
    are loaded: in a program that has loaded them before, nothing changes.
    """
    if "OMP_NUM_THREADS" in os.environ or not {"numpy", "torch"}.isdisjoint(sys.modules):
        return
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(name, "1")


def main(tokens: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 2 for bad input (one line on stderr), 130 when interrupted."""
    use_one_thread()
    given = COMMAND_LINE.set(shlex.join(["avtorch", *(sys.argv[1:] if tokens is None else tokens)]))
    try:
        app(tokens, exit_on_error=False, print_error=False)
    except (InputError, CycloptsError) as fault:
        # one line, however many the parser's own message has
        message = _said(fault) if isinstance(fault, CycloptsError) else str(fault)
        most = None if isinstance(fault, InputError) else 400
        print("avtorch: " + printable(" ".join(message.split()), most), file=sys.stderr)
        return 2
    except OSError as fault:
        # a file system that fails where no command expects it to
        where = f"{fault.filename}: " if fault.filename else ""
        print("avtorch: " + printable(" ".join(f"{where}{fault.strerror or fault}".split())), file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(printable(": ".join(filter(None, ("avtorch: interrupted", str(stop))))), file=sys.stderr)
        return 130
    finally:
        COMMAND_LINE.reset(given)
    return 0


def process() -> int:
    """`main` with the arguments of the process, as the installed `avtorch` starts it; returns its exit code.

    Python looks for unreachable objects again and again while torch and matplotlib are imported, and once more for all
    of them when the process ends. Modules stay until the end, so none is ever found; the search took a fifth of the
    time of a short command.
    """
    gc.set_threshold(50_000, *gc.get_threshold()[1:])
    try:
        return main()
    finally:
        gc.freeze()  # no last search: the system takes the memory back
