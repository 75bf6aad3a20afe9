"""Fixtures shared by the whole suite."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest


@pytest.fixture
def rotating_seed(request: pytest.FixtureRequest) -> int:
    """A seed that changes with every run, so that no statistical test lives off a lucky one; printed when a test fails.

    Set AVTORCH_SEED to repeat a failure.
    """
    seed = int(os.environ.get("AVTORCH_SEED", time.time_ns() % 2**31))
    print(f"AVTORCH_SEED={seed} for {request.node.nodeid}")
    return seed


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real recordings, named by AVTORCH_DATA; the tests that need it are skipped only where that is unset."""
    folder = os.environ.get("AVTORCH_DATA")
    if folder is None:
        pytest.skip("AVTORCH_DATA is not set")
    path = Path(folder)
    assert path.is_dir(), f"AVTORCH_DATA={folder} is not a directory"
    return path
