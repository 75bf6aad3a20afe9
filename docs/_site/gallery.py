"""The gallery: the code of `gallery.md` runs when the site is built, and each picture stands below its code.

The page itself holds no picture, so none of them is kept, and none can be older than its code.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from pictures import drawn, with_pictures
from reference import FOLDER
from sphinx.application import Sphinx

from avtorch import plots

PAGE = "gallery"


def read(app: Sphinx, docname: str, content: list[str]) -> None:
    if docname != PAGE:
        return
    folder = Path(app.srcdir) / FOLDER / PAGE
    folder.mkdir(parents=True, exist_ok=True)
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)  # what a block writes is not kept
        try:
            pictures = list(drawn(content[0], folder))
        finally:
            os.chdir(here)
    for old in folder.glob("*.png"):
        if old.name not in {p.file for p in pictures}:
            old.unlink()
    content[0] = with_pictures(content[0], pictures, f"{FOLDER}/{PAGE}")
    for source in Path(plots.__file__).parent.glob("*.py"):
        app.env.note_dependency(str(source), docname=docname)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", read)
    return {"parallel_read_safe": True}
