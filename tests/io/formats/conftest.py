"""Readers run in a process of their own, where nobody sees the warnings of libraries; here often in the test's.

What a reader holds open goes with its process, too.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.filterwarnings("ignore"))


@pytest.fixture(scope="module", autouse=True)
def unheard() -> Iterator[None]:
    """Files that readers have left open are closed before the tests of others begin."""
    yield
    gc.collect()
