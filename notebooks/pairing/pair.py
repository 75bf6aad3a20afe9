"""What a pair is, and in which ways one may be out of step."""

from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

import jupytext
import nbformat
from nbformat import NotebookNode

FOLDER = Path(__file__).resolve().parents[1]
SOURCES = tuple(sorted(FOLDER.glob("*.py")))
RECORDINGS = frozenset({"5_real_cars"})
"""Notebooks that show little without recordings: executed only where there are some."""

_METADATA = {
    "jupytext": {"formats": "ipynb,py:percent"},
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"file_extension": ".py", "mimetype": "text/x-python", "name": "python"},
}
_PATH = re.compile(r"(?:(?<![\w./\]])/(?:home|root|work|tmp|usr|opt|Users|private|mnt)/|\b[A-Z]:\\)[^\s'\"]*")


def pair_of(source: Path) -> Path:
    """The notebook beside a source."""
    return source.with_suffix(".ipynb")


def unexecuted(source: Path) -> NotebookNode:
    """The cells of a source, as jupytext reads it; each with an id that follows from its text alone."""
    notebook = jupytext.read(source, fmt="py:percent")
    notebook.metadata = nbformat.from_dict(_METADATA)
    seen: dict[str, int] = {}
    for cell in notebook.cells:
        text = sha256(f"{cell.cell_type}\n{cell.source}".encode()).hexdigest()[:8]
        seen[text] = seen.get(text, 0) + 1
        cell.id = text if seen[text] == 1 else f"{text}-{seen[text]}"
        cell.metadata = NotebookNode()
    return notebook


def faults(source: Path) -> list[str]:
    """In which ways the pair of `source` is out of step with it; none where all is well."""
    if not pair_of(source).exists():
        return [f"{pair_of(source).name} is missing"]
    kept = nbformat.read(pair_of(source), as_version=4)
    asked = unexecuted(source)
    found = [] if len(kept.cells) == len(asked.cells) else [f"{len(kept.cells)} cells, needs {len(asked.cells)}"]
    if kept.metadata != asked.metadata:
        found.append(f"metadata: found {kept.metadata}")
    code = 0
    for number, (cell, own) in enumerate(zip(kept.cells, asked.cells, strict=False), 1):
        place = f"cell {number}"
        found += [
            f"{place}: its {what} is another" for what in ("cell_type", "source", "id") if cell[what] != own[what]
        ]
        if cell.metadata:
            found.append(f"{place}: has metadata {dict(cell.metadata)}")
        if cell.cell_type == "code":
            code += 1
            if cell.execution_count != code:
                found.append(f"{place}: executed as {cell.execution_count}, needs {code}")
            found += [f"{place}: {fault}" for output in cell.outputs for fault in _of_output(output)]
    return found


def _of_output(output: NotebookNode) -> list[str]:
    if output.output_type == "error":
        return [f"ends with {output.ename}: {output.evalue}"]
    if output.output_type == "stream" and output.name == "stderr":
        return [f"writes to standard error: {output.text[:80]!r}"]
    paths = [path for text in texts(output) for path in _PATH.findall(text)]
    return [f"names a path of a machine, {path}" for path in paths]


def texts(output: NotebookNode) -> list[str]:
    """All that an output says in words."""
    if output.output_type == "stream":
        return [output.text]
    return [content for kind, content in sorted(output.get("data", {}).items()) if kind.startswith("text/")]
