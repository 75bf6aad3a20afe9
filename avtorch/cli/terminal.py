"""A terminal that no text from a file can steer."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from avtorch.errors import printable


class SafeConsole(Console):
    """A console whose own styles and movements reach the terminal, and from all text only what can be seen.

    Names of files and columns may hold terminal sequences or turn the direction of writing: they are shown escaped.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control is None and not segment.text.isprintable():
                lines = segment.text.split("\n")
                segment = Segment("\n".join(map(printable, lines)), segment.style)
            yield segment
