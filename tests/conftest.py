"""Fixtures shared by the whole suite."""

from __future__ import annotations

import gc
import importlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import shapes
from tests.report.in_chromium import PROGRAM

shapes.install()

pytest_plugins = ("tests.redraws", "pytester")


def pytest_collection_finish() -> None:
    """What the imports have left in memory stays; a search for garbage that goes through it takes 0.2 s."""
    gc.freeze()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real recordings, named by AVTORCH_DATA; the tests that need it are skipped only where the variable is
    unset."""
    folder = os.environ.get("AVTORCH_DATA")
    if folder is None:
        pytest.skip("AVTORCH_DATA is not set")
    path = Path(folder)
    assert path.is_dir(), f"AVTORCH_DATA={folder} is not a directory"
    return path


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings and Parquet are read in the test's own process: most of a short test would be the start of another.

    That one is in `io/formats/test_apart.py` and `io/test_log.py`.
    """
    from avtorch.io.formats import apart
    from avtorch.io.formats.apart_process import answered

    def asked(path: Any, kind: Any, wanted: Any) -> tuple[dict[str, Any], memoryview]:
        reader = importlib.import_module(f"avtorch.io.formats.{kind.reader}")
        wanted = wanted.pattern if isinstance(wanted, re.Pattern) else wanted if wanted is None else list(wanted)
        told, content = answered(reader.open_file(path, kind), wanted)
        return told, memoryview(content)

    monkeypatch.setattr(apart, "_asked", asked)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[[list[str]], str]:
    """What a command line is refused with: exit code 2 and one printable line, without a traceback."""
    from avtorch.cli import main

    def said(arguments: list[str]) -> str:
        capsys.readouterr()
        assert main(arguments) == 2
        told = capsys.readouterr()
        assert "Traceback" not in told.out
        assert told.err.startswith("avtorch: ")
        assert told.err.endswith("\n")
        assert told.err[:-1].isprintable(), told.err
        return told.err

    return said


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium: one a process, for a second one cannot be started beside it."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as play:
        # the sandbox needs rights that containers lack, and the pages are our own
        program = play.chromium.launch(executable_path=PROGRAM, args=["--no-sandbox"])
        yield program
        program.close()
