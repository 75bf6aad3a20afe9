"""Pictures of a page: its code runs, and each figure that a block ends with stands below that block."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from avtorch import plots

PIECE = re.compile(r"^### (?P<title>[^\n]*)$|^```python\n(?P<code>.*?)^```$", re.S | re.M)


class Picture(NamedTuple):
    """`file` drawn by the code that ends at `end` of the page, under the heading `title`."""

    title: str
    file: str
    end: int

    @property
    def mark(self) -> str:
        """Of the heading, as the site makes it."""
        return self.file.removesuffix(".png")


def drawn(text: str, folder: Path) -> Iterator[Picture]:
    """Run the page's blocks one after the other; write the figure that a block ends with into `folder`."""
    names: dict[str, object] = {"__name__": "page"}
    title = ""
    for piece in PIECE.finditer(text):
        if piece["title"] is not None:
            title = piece["title"]
            continue
        figure = run(piece["code"], names)
        if isinstance(figure, Figure):
            file = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") + ".png"
            plots.save(figure, folder / file)
            yield Picture(title, file, piece.end())


def run(code: str, names: dict[str, object]) -> object:
    """Run `code` as a cell of a notebook; returns the value of its last line, None where that is a statement."""
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "page", "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), "page", "eval"), names)


def with_pictures(text: str, pictures: list[Picture], folder: str) -> str:
    """The page with each picture below its code, and small ones that lead there before the first block."""
    small = "\n".join(f"[![{p.title}]({folder}/{p.file})](#{p.mark})" for p in pictures)
    for p in reversed(pictures):
        text = (
            f"{text[: p.end]}\n\n```{{image}} {folder}/{p.file}\n:alt: {p.title}\n:loading: lazy\n```\n{text[p.end :]}"
        )
    return text.replace("```python", f"```{{container}} thumbnails\n{small}\n```\n\n```python", 1)
