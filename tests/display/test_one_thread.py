"""A long call from Python uses one thread, as a command does, and leaves the user's number as it was."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import scipy.linalg  # noqa: F401  (its own OpenBLAS)
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from avtorch.display.progress import shows_progress


@shows_progress
def work(fails: bool = False, *, progress: object = None) -> list[int]:
    """Threads of all pools while it runs."""
    if fails:
        raise ValueError("no")
    return counts()


def counts() -> list[int]:
    """Of torch, and of each pool of linear algebra."""
    return [torch.get_num_threads(), *(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas")]


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """A user with two threads in each pool."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with threadpool_limits(2, user_api="blas"):
        yield monkeypatch
    torch.set_num_threads(before)


def test_one_thread_within_and_as_before_behind(two: pytest.MonkeyPatch) -> None:
    two.delenv("OMP_NUM_THREADS", raising=False)
    assert len(counts()) > 1
    assert set(work()) == {1}
    with pytest.raises(ValueError, match="no"):
        work(fails=True)
    assert set(counts()) == {2}


def test_what_the_user_set_stays(two: pytest.MonkeyPatch) -> None:
    two.setenv("OMP_NUM_THREADS", "2")
    assert set(work()) == {2}
