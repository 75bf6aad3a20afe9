"""The executed notebooks as pages: copied from `../notebooks`, with links that the site can follow; none is run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from code_host import LINK, on_site
from reference import FOLDER
from sphinx.application import Sphinx

PLACE = f"{FOLDER}/notebooks"
_UP = "../" * (PLACE.count("/") + 1)


def copy(app: Sphinx) -> None:
    """Each `.ipynb`; those of notebooks that are no more go."""
    made = Path(app.srcdir) / PLACE
    made.mkdir(parents=True, exist_ok=True)
    pages = {path.name: page(path) for path in (Path(app.srcdir).parent / "notebooks").glob("*.ipynb")}
    for old in made.glob("*.ipynb"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        target = made / name
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")


def page(path: Path) -> str:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    for cell in notebook["cells"]:
        if cell["cell_type"] == "markdown":
            text = "".join(cell["source"])
            cell["source"] = LINK.sub(lambda m: on_site(f"{_UP}../notebooks/{m[1]}", _UP), text)
        else:
            # where the reader of pages looks for a picture's text alternative
            alternatives = [alt for output in cell["outputs"] for alt in _alternatives(output)]
            if alternatives:
                cell["metadata"] = {"mystnb": {"image": {"alt": " ".join(alternatives)}}}
    return json.dumps(notebook, ensure_ascii=False)


def _alternatives(output: dict[str, Any]) -> list[str]:
    kinds = output.get("metadata", {}).values()
    return [kind["alt"] for kind in kinds if isinstance(kind, dict) and "alt" in kind]


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", copy)
    return {"parallel_read_safe": True}
