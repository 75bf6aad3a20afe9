"""A terminal that text from a file cannot control."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from avtorch.errors import printable


class SafeConsole(Console):
    """A console that sends its own styles and cursor movements to the terminal, but only visible characters of any
    text.

    Names of files and columns may hold terminal sequences or turn the direction of writing: they are shown escaped.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control is None and not segment.text.isprintable():
                lines = segment.text.split("\n")
                segment = Segment("\n".join(map(printable, lines)), segment.style)
            yield segment
