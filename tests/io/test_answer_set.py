"""The files of an answer appear together: whatever fails, and whenever the process ends."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from errno import EPERM
from pathlib import Path

import pytest

from avtorch.errors import InputError
from avtorch.io import answer_set, atomic
from tests.faulty_disk import Call, disk, fails, interrupts, visible

NAMES = ("a.json", "b.png", "c.csv", "d.toml")


def publish(folder: Path, mark: str, files: tuple[str, ...]) -> None:
    with answer_set(folder, NAMES) as staged:
        for name in files:
            with atomic(staged / name) as stream:
                stream.write(f"{mark} {name}")


def before(folder: Path) -> None:
    """An answer of three files, one of another command, and a file that is nobody's."""
    publish(folder, "old", ("a.json", "b.png", "d.toml"))
    with answer_set(folder, ("x.json", "x.png")) as staged:
        for name in ("x.json", "x.png"):
            (staged / name).write_text(f"another {name}")
    (folder / "notes.txt").write_text("mine")


def after(folder: Path) -> None:
    publish(folder, "new", ("a.json", "b.png", "c.csv"))


def nothing(folder: Path) -> None:
    pass


def of_an_earlier_version(folder: Path) -> None:
    folder.mkdir()
    for name in ("a.json", "b.png", "d.toml", "x.json", "notes.txt"):
        (folder / name).write_text(f"old {name}")


def touched(folder: Path) -> None:
    """One link was replaced by a file, as editors do, one was removed, and one is the user's own."""
    before(folder)
    (folder / "d.toml").unlink()
    (folder / "d.toml").write_text("by hand")
    (folder / "b.png").unlink()
    (folder.parent / "elsewhere").write_text("mine")
    (folder / "c.csv").symlink_to("../elsewhere")


def copied(folder: Path) -> None:
    """A copy that followed the links has files in their places."""
    before(folder.with_name("first"))
    shutil.copytree(folder.with_name("first"), folder)
    shutil.rmtree(folder.with_name("first"))


def starts(*quick: Callable, slow: tuple[Callable, ...]) -> list:
    return [pytest.param(x, marks=[pytest.mark.slow] if x in slow else [], id=x.__name__) for x in (*quick, *slow)]


@pytest.fixture(autouse=True)
def no_wait_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: None)


class Sweep:
    """The same publication again and again, each time with a fault at a later call."""

    def __init__(self, tmp_path: Path, start: Callable[[Path], None]) -> None:
        self.tmp_path, self.n = tmp_path, 0
        (tmp_path / "start").mkdir()
        start(tmp_path / "start" / "out")
        self.old, self.new = visible(self.fresh()), {}
        folder = self.fresh()
        after(folder)
        self.new = visible(folder)
        assert self.old != self.new

    def fresh(self) -> Path:
        self.n += 1
        here = self.tmp_path / str(self.n)
        shutil.copytree(self.tmp_path / "start", here, symlinks=True)
        return here / "out"

    def is_whole(self, folder: Path) -> None:
        """Nothing is mixed, and what may be left over is gone once the next answer is there."""
        assert visible(folder) in (self.old, self.new)
        after(folder)
        assert visible(folder) == self.new
        assert [p.name for p in folder.iterdir() if p.is_symlink() and not p.exists()] == []
        hidden = sorted(p.name for p in (folder / ".avtorch").iterdir())
        assert hidden == ["answer", os.readlink(folder / ".avtorch/answer")]
        shutil.rmtree(folder.parent)


@pytest.mark.parametrize("onwards", [False, True], ids=["one call fails", "all fail from there on"])
@pytest.mark.parametrize("start", starts(nothing, slow=(of_an_earlier_version, touched)))
def test_a_disk_that_fails_at_the_nth_call(start: Callable, onwards: bool, tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, start)
    refused = 0
    for n in range(1, 1000):
        folder = sweep.fresh()
        said = None
        with disk(folder, fails(n, onwards=onwards)) as calls:
            try:
                after(folder)
            except InputError as fault:
                said = str(fault)
        if said is not None:
            refused += 1
            assert str(folder) in said
            assert ".avtorch" not in said
            assert "\n" not in said
        # a reported failure may leave the new answer there, and the message then states that
        assert visible(folder) == (sweep.new if said is None or "is there" in said else sweep.old)
        sweep.is_whole(folder)
        if len(calls) < n:
            break
    else:
        raise AssertionError("the sweep has no end")
    assert refused > 20, "the faults must have met something"


@pytest.mark.parametrize("start", starts(slow=(touched,)))
def test_an_interruption_at_the_nth_call(start: Callable, tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, start)
    for n in range(1, 1000):
        folder = sweep.fresh()
        said = None
        with disk(folder, interrupts(n)) as calls:
            try:
                after(folder)
            except KeyboardInterrupt as stop:
                said = str(stop)
        assert visible(folder) == (sweep.new if said is None or "the new answer is in" in said else sweep.old)
        sweep.is_whole(folder)
        if len(calls) < n:
            return
    raise AssertionError("the sweep has no end")


@pytest.mark.slow
@pytest.mark.parametrize("start", starts(before, slow=(of_an_earlier_version, touched, copied)))
def test_a_reader_at_any_moment(start: Callable, tmp_path: Path) -> None:
    """A killed process leaves what a reader finds at that moment; the next answer must succeed from it."""
    sweep = Sweep(tmp_path, start)
    folder = sweep.fresh()
    seen: list[dict[str, str]] = []

    def look(n: int, name: str) -> None:
        seen.append(visible(folder))
        here = tmp_path / f"killed at {n}"
        here.mkdir()
        if folder.exists():
            shutil.copytree(folder, here / "out", symlinks=True)
        if (folder.parent / "elsewhere").exists():
            shutil.copy(folder.parent / "elsewhere", here)

    with disk(folder, look) as calls:
        after(folder)
    changes = [one for one, next_one in zip(seen, [*seen[1:], visible(folder)], strict=True) if one != next_one]
    assert changes == [sweep.old], "one moment at which everything changes"
    for n in range(1, len(calls) + 1):
        sweep.is_whole(tmp_path / f"killed at {n}" / "out")


KILLED = """
import os, sys
from pathlib import Path
from tests.faulty_disk import disk, visible
from tests.io import test_answer_set as t

os.fsync = lambda handle: None
root, start = Path(sys.argv[1]), getattr(t, sys.argv[2])
sweep = t.Sweep(root, start)
ended = []
for n in range(1, 1000):
    folder = sweep.fresh()
    child = os.fork()
    if child == 0:
        def end(count, name):
            if count == n:
                os._exit(9)
        with disk(folder, end):
            t.after(folder)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    ended.append(code)
    sweep.is_whole(folder)
    if code != 9:
        break
assert ended[-1] == 0 and len(ended) > 20, ended
print(len(ended))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process that can be forked and ended at the n-th call")
@pytest.mark.parametrize("start", starts(slow=(touched,)))
def test_a_process_that_ends_at_the_nth_call(start: Callable, tmp_path: Path) -> None:
    """In a process of its own, which has no threads that a fork could leave behind."""
    command = [sys.executable, "-c", KILLED, str(tmp_path), start.__name__]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def test_what_is_written_twice_in_one_moment(tmp_path: Path) -> None:
    with answer_set(tmp_path / "out", NAMES) as staged:
        publish(staged, "one", ("a.json",))
        publish(staged, "two", ("b.png",))
        assert visible(tmp_path / "out") == {}
    assert set(visible(tmp_path / "out")) == {"a.json", "b.png"}


def test_a_block_that_raises_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with answer_set(tmp_path, NAMES) as staged:
            (staged / "a.json").write_text("half")
            raise RuntimeError("own")

    with pytest.raises(RuntimeError, match="own"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_faults_name_the_place_that_was_given(tmp_path: Path) -> None:
    def write(name: str) -> None:
        with answer_set(tmp_path / "out", NAMES) as staged, atomic(staged / name / "a.json"):
            pass

    (tmp_path / "out" / "a.json").mkdir(parents=True)
    with pytest.raises(InputError, match=rf"^{tmp_path}/out/a.json: is a directory"):
        publish(tmp_path / "out", "new", ("b.png",))
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"file: the answer cannot be written \(Not a directory\)"):
        publish(tmp_path / "file", "new", ("b.png",))
    with pytest.raises(ValueError, match=r"z.png written, needs names out of a.json"):
        publish(tmp_path / "other", "new", ("z.png",))
    os.mkfifo(tmp_path / "out" / "d.toml")
    (tmp_path / "out" / "a.json").rmdir()
    with pytest.raises(InputError, match=r"d.toml: is no regular file"):
        publish(tmp_path / "out", "new", ("b.png",))


def test_the_last_answer_leaves_no_trace(tmp_path: Path) -> None:
    publish(tmp_path, "old", ("a.json",))
    publish(tmp_path, "none", ())
    assert list(tmp_path.iterdir()) == []


def test_the_folder_may_move_and_its_files_may_be_edited(tmp_path: Path) -> None:
    publish(tmp_path / "out", "old", ("a.json", "d.toml"))
    (tmp_path / "out").rename(tmp_path / "moved")
    (tmp_path / "moved" / "d.toml").write_text("edited")
    assert (tmp_path / "moved" / "a.json").read_text() == "old a.json"
    publish(tmp_path / "moved", "new", ("a.json",))
    assert [p.name for p in (tmp_path / "moved").iterdir() if not p.name.startswith(".")] == ["a.json"]


def test_a_set_that_another_process_is_writing_is_left_alone(tmp_path: Path) -> None:
    """What an ended process left goes; what a living one writes does not."""
    (tmp_path / ".avtorch" / "set-left").mkdir(parents=True)
    with answer_set(tmp_path, ("x.json", "x.png")) as other:
        publish(tmp_path, "new", ("a.json",))
        assert other.is_dir()
        assert not (tmp_path / ".avtorch" / "set-left").exists()
        (other / "x.json").write_text("another")
    assert set(visible(tmp_path)) == {"a.json", "x.json"}


# --- without symbolic links


@pytest.fixture
def no_links(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(EPERM, os.strerror(EPERM))

    monkeypatch.setattr(os, "symlink", refused)


def test_without_links_files_are_moved(no_links: None, tmp_path: Path) -> None:
    after(tmp_path)
    assert not [p for p in tmp_path.iterdir() if p.is_symlink()]
    assert not (tmp_path / ".avtorch").exists()
    publish(tmp_path, "newer", ("a.json", "d.toml"))
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"a.json": "newer a.json", "d.toml": "newer d.toml"}


def looks_then(fault: Call, folder: Path, sweep: Sweep) -> Call:
    def call(count: int, name: str) -> None:
        assert visible(folder) in (sweep.old, sweep.new) or "a.json" not in visible(folder)
        fault(count, name)

    return call


@pytest.mark.slow
def test_without_links_an_answer_that_is_not_whole_lacks_its_first_file(no_links: None, tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, of_an_earlier_version)
    for n in range(1, 1000):
        folder = sweep.fresh()

        with disk(folder, looks_then(fails(n, onwards=True), folder, sweep)) as calls:
            said = None
            try:
                after(folder)
            except InputError as fault:
                said = str(fault)
        seen = visible(folder)
        if said is None:
            assert seen == sweep.new
        else:
            assert seen == sweep.old or ("a.json" not in seen and "whole only with a.json" in said)
        after(folder)
        assert visible(folder) == sweep.new
        if len(calls) < n:
            return
    raise AssertionError("the sweep has no end")
