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


@pytest.fixture
def fresh_seed(request: pytest.FixtureRequest) -> int:
    """The same for damages and other inputs drawn at random: each must be met, so a failure is not drawn again."""
    seed = int(os.environ.get("AVTORCH_SEED", time.time_ns() % 2**31))
    print(f"AVTORCH_SEED={seed} for {request.node.nodeid}")
    return seed


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A statistical test that fails is drawn once more, with a seed of its own; two failures are a failure.

    Some seven hundred tests draw anew in every run. One at five standard errors hardly ever fails by chance, seven
    hundred now and then do. What is wrong fails twice. A named seed is not drawn again, nor is a test that crashes.
    """
    if "AVTORCH_SEED" not in os.environ:
        for item in items:
            if "rotating_seed" in getattr(item, "fixturenames", ()):
                item.add_marker(pytest.mark.flaky(reruns=1, only_rerun=["AssertionError"]))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What was drawn again is told in full, with its seed: a mismatch too small to fail twice is still to be read."""
    again = terminalreporter.stats.get("rerun", [])
    if again:
        terminalreporter.section("drawn again after a failure")
    for report in again:
        terminalreporter.line(f"{report.nodeid}\n{report.longreprtext}\n{report.capstdout}")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real recordings, named by AVTORCH_DATA; the tests that need it are skipped only where that is unset."""
    folder = os.environ.get("AVTORCH_DATA")
    if folder is None:
        pytest.skip("AVTORCH_DATA is not set")
    path = Path(folder)
    assert path.is_dir(), f"AVTORCH_DATA={folder} is not a directory"
    return path
