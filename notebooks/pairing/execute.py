"""A source, executed cell by cell in a kernel of its own, as the notebook that is kept."""

from __future__ import annotations

import os
from base64 import b64decode, b64encode
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

from notebooks.pairing.pair import FOLDER, pair_of, unexecuted

LONGEST_S = 900
"""Time that one cell may take."""
_PICTURE = "image/png"
_COLOURS = 128


def executed(source: Path) -> NotebookNode:
    """The notebook of `source` as run in an empty folder. Raises `CellExecutionError` if a cell fails."""
    notebook = unexecuted(source)
    # the working tree is what the kernel imports, wherever it runs; one thread, so that sums have one order
    paths = [str(FOLDER.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with TemporaryDirectory() as folder, TemporaryDirectory() as sockets:
        client = NotebookClient(
            notebook,
            kernel_name="python3",
            startup_timeout=180,
            timeout=LONGEST_S,
            record_timing=False,
            resources={"metadata": {"path": folder}},
        )
        kernel = client.create_kernel_manager()
        kernel.connection_file = str(Path(sockets) / "kernel.json")
        # sockets as files of this user, where there are such: nobody else can reach them
        kernel.transport = "ipc" if os.name == "posix" else "tcp"
        client.execute(env=env)
    for cell in notebook.cells:
        cell.metadata = NotebookNode()
        if cell.cell_type == "code":
            cell.outputs = [_lasting(output) for output in _merged(cell.outputs) if not _empty(output)]
    notebook.metadata = unexecuted(source).metadata
    return notebook


def write(source: Path, notebook: NotebookNode) -> Path:
    """Publish the notebook beside its source; returns the file."""
    nbformat.validate(notebook)
    path = pair_of(source)
    path.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")
    return path


def _empty(output: NotebookNode) -> bool:
    """What a progress bar leaves."""
    return output.output_type == "display_data" and not any(output.data.values())


def _merged(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """How a stream is cut depends on the machine's pace: one output for what was printed in a row."""
    merged: list[NotebookNode] = []
    for output in outputs:
        last = merged[-1] if merged else None
        if last is not None and output.output_type == "stream" == last.output_type and output.name == last.name:
            last.text += output.text
        elif not _empty(output):
            merged.append(output)
    return merged


def _lasting(output: NotebookNode) -> NotebookNode:
    """Without what tells the run, and pictures in few colours: a third of the size."""
    data = output.get("data", {})
    if _PICTURE in data:
        data[_PICTURE] = _smaller(data[_PICTURE])
        data["text/plain"] = output.metadata.get(_PICTURE, {}).get("alt", "Figure.")
    return output


def _smaller(picture: str) -> str:
    small = BytesIO()
    with Image.open(BytesIO(b64decode(picture))) as image:
        # the palette is the picture's own, without noise in its flat areas
        few = image.convert("RGB").quantize(_COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        few.save(small, format="PNG", optimize=True)
    return b64encode(small.getvalue()).decode("ascii")
