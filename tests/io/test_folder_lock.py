"""One process at a time in a folder: the second gets a message that names the first, and a killed one blocks no
other."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from avtorch.errors import InputError
from avtorch.io import sole_use
from avtorch.io.folder_lock import LOCK

HOLD = """
import sys
from avtorch.io import sole_use
with sole_use(sys.argv[1], work="a long run"):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def another_process(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """That holds the folder until its standard input ends."""
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        yield other
    finally:
        other.kill()
        other.communicate()


def test_the_second_gets_the_name_of_the_first_and_a_killed_one_blocks_no_other(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with another_process(folder) as other:
        with pytest.raises(InputError) as caught, sole_use(folder, work="mine"):
            pytest.fail("let in")
        told = str(caught.value)
        assert f"{folder}: in use by a long run (pid {other.pid} on " in told
        assert "since 20" in told
        assert "\n" not in told
        # another spelling of the same folder
        (tmp_path / "link").symlink_to(folder)
        with pytest.raises(InputError, match="in use by a long run"), sole_use(tmp_path / "link", work="mine"):
            pytest.fail("let in")
        other.kill()
        other.wait()
        assert (folder / LOCK).exists()
        with sole_use(folder, work="mine") as locked:
            assert locked
    assert not (folder / LOCK).exists()


def test_nothing_is_left(tmp_path: Path) -> None:
    with sole_use(tmp_path / "a" / "b", work="mine"):
        assert (tmp_path / "a" / "b" / LOCK).exists()
    assert list(tmp_path.iterdir()) == []
    with sole_use(tmp_path / "a", work="mine"):
        (tmp_path / "a" / "kept").touch()
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["kept"]


def test_a_block_within_a_block_is_let_in_and_another_thread_is_not(tmp_path: Path) -> None:
    said: list[str] = []

    def elsewhere() -> None:
        try:
            with sole_use(tmp_path, work="other"):
                said.append("let in")
        except InputError as fault:
            said.append(str(fault))

    def ask() -> str:
        thread = threading.Thread(target=elsewhere)
        thread.start()
        thread.join()
        return said.pop()

    with sole_use(tmp_path, work="outer"):
        with sole_use(tmp_path, work="inner") as locked:
            assert locked
        # the inner block has not let go
        assert f"in use by outer (pid {os.getpid()} on " in ask()
    assert ask() == "let in"


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_lets_work_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    import fcntl

    def none(*_: Any) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", none)
    with sole_use(tmp_path / "out", work="mine") as locked:
        assert not locked


@pytest.mark.slow
def test_whatever_the_lock_file_says_the_answer_is_one_line(tmp_path: Path) -> None:
    broken = [b"", b"[" * 5000, b'{"pid": 1}', b"\xff", b'{"pid": 1, "host": "\\n", "work": [], "since": 0}']
    with another_process(tmp_path):
        for content in broken:
            (tmp_path / LOCK).write_bytes(content)
            with pytest.raises(InputError, match="in use by ") as caught, sole_use(tmp_path, work="mine"):
                pytest.fail("let in")
            assert str(caught.value).isprintable()


def test_places_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for name in ("file/out", "x" * 300, "zero\0byte"):
        with pytest.raises(InputError, match="cannot be made"), sole_use(tmp_path / name, work="mine"):
            pytest.fail("let in")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / LOCK).symlink_to(tmp_path / "file")
    with pytest.raises(InputError, match="cannot be written"), sole_use(tmp_path / "out", work="mine"):
        pytest.fail("let in")
