"""`avtorch app`: the workbench, a page on this machine."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from avtorch.errors import InputError


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
