"""The commands put together, and what happens when one is refused or interrupted.

The commands import torch and matplotlib only once their arguments are read: help and a mistyped option answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cyclopts import App, CycloptsError, MissingArgumentError

from avtorch.cli.check import check
from avtorch.cli.check_simulator import check_simulator
from avtorch.cli.command_line import given
from avtorch.cli.compare import compare
from avtorch.cli.diagnose import diagnose
from avtorch.cli.estimate import estimate
from avtorch.cli.fleet import fleet
from avtorch.cli.one_thread import use_one_thread
from avtorch.cli.out_folder import alone_in_out
from avtorch.cli.paper import paper
from avtorch.cli.run import run
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
app.command(check)
app.command(check_simulator)
app.command(watch)
for _command in (run, estimate, diagnose, compare, fleet, stability, validate, paper):
    app.command(alone_in_out(_command))


def _missing(fault: MissingArgumentError) -> str:
    """Name the missing argument and give an example; the parser only reports that one is missing."""
    command = " ".join(fault.command_chain or ())
    argument = fault.argument
    if argument is None or argument.tokens:
        return str(fault)
    if argument.name == "--out":
        return f"--out: missing; needs a folder for the answer and the pictures, such as --out out/{command}"
    if argument.index is not None:
        return f"{argument.name.lstrip('-').upper()}: missing; needs a file, see avtorch {command} --help"
    return f"{argument.name}: missing; see avtorch {command} --help"


def main(tokens: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 2 for bad input (one line on stderr), 130 when interrupted."""
    use_one_thread()
    try:
        with given(sys.argv[1:] if tokens is None else tokens):
            app(tokens, exit_on_error=False, print_error=False)
    except (InputError, CycloptsError) as fault:
        # one line, however many the parser's own message has
        message = _missing(fault) if isinstance(fault, MissingArgumentError) else str(fault)
        most = None if isinstance(fault, InputError) else 400
        print("avtorch: " + printable(" ".join(message.split()), most), file=sys.stderr)
        return 2
    except OSError as fault:
        # a file system that fails where no command expects it to
        where = f"{fault.filename}: " if fault.filename else ""
        print("avtorch: " + printable(" ".join(f"{where}{fault.strerror or fault}".split())), file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(f"avtorch: interrupted; {printable(str(stop)) or 'no answer was written'}", file=sys.stderr)
        return 130
    return 0
