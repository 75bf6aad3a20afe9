"""Fixtures shared by the whole suite."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests import shapes

shapes.install()

pytest_plugins = ("tests.redraws", "pytester")


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
