"""Each notebook is kept as its source and as executed: the two are in step, and the second is what the first gives."""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import nbformat
import pytest
from nbformat import NotebookNode
from nbformat.v4 import new_output

from notebooks.pairing.execute import executed
from notebooks.pairing.pair import FOLDER, SOURCES, faults, pair_of, texts

ROOT = FOLDER.parent
QUICK = FOLDER / "1_vehicle_and_stability.py"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.stem)
def test_pair_is_in_step_with_its_source(source: Path) -> None:
    """Otherwise `make notebooks` executes it again."""
    assert faults(source) == []


def test_every_executed_notebook_has_a_source() -> None:
    assert sorted(FOLDER.glob("*.ipynb")) == [pair_of(source) for source in SOURCES]


def test_executed_notebooks_are_small() -> None:
    """A clone downloads them in every version."""
    assert sum(pair_of(source).stat().st_size for source in SOURCES) < 4e6


def _code(notebook: NotebookNode) -> NotebookNode:
    return next(cell for cell in notebook.cells if cell.cell_type == "code")


def _printed(text: str, name: str = "stdout") -> Callable[[NotebookNode], object]:
    return lambda notebook: _code(notebook).outputs.append(new_output("stream", name=name, text=text))


def _failed(notebook: NotebookNode) -> None:
    _code(notebook).outputs.append(new_output("error", ename="InputError", evalue="window: too long", traceback=[]))


DAMAGE: dict[str, tuple[Callable[[NotebookNode], object], str]] = {
    "source": (lambda n: n.cells[0].update(source="# Another title"), "cell 1: its source is another"),
    "kind": (lambda n: n.cells.__setitem__(0, nbformat.v4.new_raw_cell(n.cells[0].source)), "its cell_type is another"),
    "cells": (lambda n: n.cells.pop(), "cells, needs"),
    "not executed": (lambda n: _code(n).update(execution_count=None), "executed as None, needs 1"),
    "random id": (lambda n: n.cells[0].update(id="5f2c9a70"), "its id is another"),
    "times": (lambda n: n.cells[0].metadata.update(execution={}), "has metadata"),
    "kernel": (lambda n: n.metadata.kernelspec.update(name="mine"), "metadata: found"),
    "error": (_failed, "ends with InputError"),
    "warning": (_printed("deprecated", "stderr"), "writes to standard error"),
    "path": (_printed("read from /home/me/drive.csv"), "names a path of a machine, /home/me/drive.csv"),
    "path of Windows": (_printed(r"read from C:\Users\me"), "names a path of a machine"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_pair_out_of_step_is_refused(damage: str, tmp_path: Path) -> None:
    source = tmp_path / QUICK.name
    shutil.copy(QUICK, source)
    notebook = nbformat.read(pair_of(QUICK), as_version=4)
    nbformat.write(notebook, pair_of(source))
    assert faults(source) == []
    spoil, told = DAMAGE[damage]
    spoil(notebook)
    nbformat.write(notebook, pair_of(source))
    assert any(told in fault for fault in faults(source))


def test_a_missing_pair_is_a_fault(tmp_path: Path) -> None:
    shutil.copy(QUICK, tmp_path)
    assert faults(tmp_path / QUICK.name) == [f"{QUICK.stem}.ipynb is missing"]


def test_web_addresses_and_shares_are_no_paths(tmp_path: Path) -> None:
    source = tmp_path / QUICK.name
    shutil.copy(QUICK, source)
    notebook = nbformat.read(pair_of(QUICK), as_version=4)
    _printed("out/tmp/a.csv, https://example.org/home/x, m/s/work/tmp")(notebook)
    nbformat.write(notebook, pair_of(source))
    assert faults(source) == []


def _same(found: str, kept: str) -> bool:
    """Word for word, and numbers within 2 %: other processors round otherwise, and a sampler carries that on."""
    numbers = [[float(x) for x in NUMBER.findall(text)] for text in (found, kept)]
    words = [NUMBER.sub("#", text).split() for text in (found, kept)]  # columns are as wide as their numbers
    return words[0] == words[1] and numbers[0] == pytest.approx(numbers[1], rel=0.02)


@pytest.mark.slow
def test_executed_again_a_notebook_says_the_same() -> None:
    kept, again = nbformat.read(pair_of(QUICK), as_version=4), executed(QUICK)
    assert [cell.id for cell in again.cells] == [cell.id for cell in kept.cells]
    for cell, other in zip(again.cells, kept.cells, strict=True):
        assert cell.get("execution_count") == other.get("execution_count")
        found, old = cell.get("outputs", []), other.get("outputs", [])
        assert [o.output_type for o in found] == [o.output_type for o in old]
        for output, before in zip(found, old, strict=True):
            assert output.get("data", {}).keys() == before.get("data", {}).keys()
            said = list(zip(texts(output), texts(before), strict=True))
            assert said
            assert all(_same(*pair) for pair in said), said


@pytest.mark.slow
def test_what_a_bar_and_the_pace_of_printing_leave_is_not_kept(tmp_path: Path) -> None:
    source = tmp_path / "bar.py"
    source.write_text(
        "# %%\n"
        "import sys, time\n"
        "from avtorch.display import progress, progress_bar\n"
        "progress.AFTER_S = 0.0\n"
        "with progress_bar('work') as step:\n"
        "    for i in range(3):\n"
        "        print(i, flush=True)\n"
        "        time.sleep(0.3)\n"
        "        step(i, 3)\n"
        "print(type(progress.bar_here()).__name__)\n",
        encoding="utf-8",
    )
    (cell,) = executed(source).cells
    assert [(output.output_type, output.text) for output in cell.outputs] == [("stream", "0\n1\n2\nNotebookBar\n")]


def test_binder_installs_what_ci_pins() -> None:
    lines = (ROOT / ".binder/requirements.txt").read_text(encoding="utf-8").splitlines()
    asked = [line for line in lines if not line.startswith("#")]
    (constraints,) = (line.split()[1] for line in asked if line.startswith("--constraint"))
    assert (ROOT / ".binder" / constraints).resolve() == ROOT / "constraints.txt"
    assert not [line for line in asked if re.search(r"[=<>~]=", line)]  # so that there is one list of versions
    (index,) = (line.split()[1] for line in asked if line.startswith("--extra-index-url"))
    assert f"TORCH_INDEX ?= {index}\n" in (ROOT / "Makefile").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (extras,) = (re.findall(r"\[(.*)\]", line)[0].split(",") for line in asked if line.startswith("--editable"))
    assert {"notebooks", "validate"} <= set(extras) <= set(project["optional-dependencies"])
    (python,) = re.findall(r"python-3\.(\d+)", (ROOT / ".binder/runtime.txt").read_text(encoding="utf-8"))
    (least,) = re.findall(r">=3\.(\d+)", project["requires-python"])
    assert int(python) >= int(least)
