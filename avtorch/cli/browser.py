"""`--open`: a command's page in the reader's browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from avtorch.cli.arguments import OUTPUT

if TYPE_CHECKING:
    from avtorch.cli.talk import Talk

Open = Annotated[bool, Parameter(name="--open", negative=(), group=OUTPUT, help="Show the page in your browser.")]


def show(page: Path, talk: Talk) -> None:
    """Open `page`, or say where it is: a machine without a screen has no browser."""
    # absolute, not resolved: the link stays when the next answer replaces the folder that it points to
    if not webbrowser.open(page.absolute().as_uri()):
        talk.line(f"No browser was found to open {page}")
