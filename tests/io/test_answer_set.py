"""The files of an answer: each whole, old or new, and a mixed set is recognised, whatever fails and whenever."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from avtorch.errors import InputError
from avtorch.io import answer_set, atomic, read_answer, sole_use, write_json
from tests.faulty_disk import disk, fails, interrupts, old_or_new, tree, visible

NAMES = ("a.json", "b.png", "c.csv", "d.toml")


def publish(folder: Path, mark: str, files: tuple[str, ...]) -> None:
    with answer_set(folder, NAMES) as staged:
        for name in files:
            if name == "a.json":
                write_json(staged / name, {"of": mark})
                continue
            with atomic(staged / name) as stream:
                stream.write(f"{mark} {name}")


def before(folder: Path) -> None:
    """An answer of three files, one of another command, and a file that is nobody's."""
    publish(folder, "old", ("a.json", "b.png", "d.toml"))
    with answer_set(folder, ("x.json", "x.png")) as staged:
        write_json(staged / "x.json", {"of": "another"})
        (staged / "x.png").write_text("another")
    (folder / "notes.txt").write_text("mine")


def after(folder: Path) -> None:
    publish(folder, "new", ("a.json", "b.png", "c.csv"))


def nothing(folder: Path) -> None:
    pass


def of_links(folder: Path) -> None:
    """Names that are links elsewhere."""
    before(folder)
    for name in ("a.json", "b.png"):
        (folder / name).rename(folder.parent / name)
        (folder / name).symlink_to(f"../{name}")


def starts(*quick: Callable, slow: tuple[Callable, ...]) -> list:
    return [pytest.param(x, marks=[pytest.mark.slow] if x in slow else [], id=x.__name__) for x in (*quick, *slow)]


@pytest.fixture(autouse=True)
def no_wait_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: None)


class Sweep:
    """The same publication again and again, each time with a fault at a later call."""

    def __init__(self, tmp_path: Path, start: Callable[[Path], None]) -> None:
        self.tmp_path, self.n = tmp_path, 0
        self.followed: set[tuple] = set()
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

    def judge(self, folder: Path) -> str:
        """The new promise; and the next answer clears up what is left, tried once for folders that are alike."""
        found, lies = old_or_new(folder, "a.json", self.old, self.new), tree(folder.parent)
        if lies not in self.followed:
            self.followed.add(lies)
            after(folder)
            assert visible(folder) == self.new
            assert read_answer(folder / "a.json")["of"] == "new"
            assert [p.name for p in folder.iterdir() if p.name.startswith(".")] == []
        shutil.rmtree(folder.parent)
        return found


@pytest.mark.parametrize("onwards", [False, True], ids=["one call fails", "all fail from there on"])
@pytest.mark.parametrize("start", starts(before, slow=(nothing, of_links)))
def test_a_disk_that_fails_at_the_nth_call(start: Callable, onwards: bool, tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, start)
    said: list[str] = []
    for n in range(1, 1000):
        folder = sweep.fresh()
        told = ""
        with disk(folder, fails(n, onwards=onwards)) as calls:
            try:
                after(folder)
            except InputError as fault:
                told = str(fault)
        if told:
            said.append(told)
            assert str(folder) in told
            assert ".avtorch-" not in told
            assert "\n" not in told
        seen = visible(folder)
        found = sweep.judge(folder)
        if not told:
            assert found == "new"
        elif "files of two answers" not in told:
            assert seen == sweep.old
        if len(calls) < n:
            break
    else:
        raise AssertionError("the sweep has no end")
    assert len(said) > 15, "the faults must have met something"
    assert any("files of two answers" in told for told in said)


def test_an_interruption_at_the_nth_call(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, before)
    for n in range(1, 1000):
        folder = sweep.fresh()
        said = None
        with disk(folder, interrupts(n)) as calls:
            try:
                after(folder)
            except KeyboardInterrupt as stop:
                said = str(stop)
        seen = visible(folder)
        sweep.judge(folder)
        if said == "":  # before the first file was put in place, or after the last
            assert seen in (sweep.old, sweep.new)
        if len(calls) < n:
            return
    raise AssertionError("the sweep has no end")


@pytest.mark.parametrize("start", starts(before, slow=(nothing, of_links)))
def test_a_reader_at_any_moment(start: Callable, tmp_path: Path) -> None:
    """A killed process leaves what a reader finds at that moment; the next answer must succeed from it."""
    sweep = Sweep(tmp_path, start)
    folder = sweep.fresh()
    found: list[str] = []

    def look(n: int, name: str) -> None:
        found.append(old_or_new(folder, "a.json", sweep.old, sweep.new))
        here = tmp_path / f"killed at {n}"
        shutil.copytree(folder.parent, here, symlinks=True)

    with disk(folder, look) as calls:
        after(folder)
    order = ["old", "mixed", "new"]
    assert found == sorted(found, key=order.index)
    for n in range(1, len(calls) + 1):
        sweep.judge(tmp_path / f"killed at {n}" / "out")


KILLED = """
import os, sys
from pathlib import Path
from tests.faulty_disk import disk
from tests.io import test_answer_set as t

os.fsync = lambda handle: None
sweep = t.Sweep(Path(sys.argv[1]), t.before)
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
    sweep.judge(folder)
    if code != 9:
        break
assert ended[-1] == 0 and len(ended) > 15, ended
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process that can be forked and ended at the n-th call")
def test_a_process_that_ends_at_the_nth_call(tmp_path: Path) -> None:
    """In a process of its own, which has no threads that a fork could leave behind."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])}
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def test_what_is_written_twice_comes_at_once(tmp_path: Path) -> None:
    with answer_set(tmp_path / "out", NAMES) as staged:
        publish(staged, "one", ("a.json",))
        publish(staged, "two", ("b.png",))
        assert visible(tmp_path / "out") == {}
    assert list(read_answer(tmp_path / "out" / "a.json")["files"]) == ["b.png"]


def test_a_block_that_raises_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with answer_set(tmp_path / "out", NAMES) as staged:
            (staged / "a.json").write_text("half")
            raise RuntimeError("own")

    with pytest.raises(RuntimeError, match="own"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_faults_name_the_place_that_was_given(tmp_path: Path) -> None:
    (tmp_path / "out" / "a.json").mkdir(parents=True)
    with pytest.raises(InputError, match=rf"^{tmp_path}/out/a.json: is a directory"):
        publish(tmp_path / "out", "new", ("b.png",))
    (tmp_path / "out" / "a.json").rmdir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"file: cannot be made"):
        publish(tmp_path / "file", "new", ("b.png",))


def test_the_last_answer_leaves_no_trace(tmp_path: Path) -> None:
    publish(tmp_path, "old", ("a.json", "b.png"))
    publish(tmp_path, "none", ())
    assert list(tmp_path.iterdir()) == []


def test_the_folder_may_move_and_be_copied_and_an_edit_is_recognised(tmp_path: Path) -> None:
    publish(tmp_path / "out", "old", ("a.json", "d.toml"))
    (tmp_path / "out").rename(tmp_path / "moved")
    shutil.copytree(tmp_path / "moved", tmp_path / "copied", symlinks=True)
    for place in ("moved", "copied"):
        assert not any(path.is_symlink() for path in (tmp_path / place).iterdir())
        assert read_answer(tmp_path / place / "a.json")["of"] == "old"
    (tmp_path / "moved" / "d.toml").write_text("edited")
    with pytest.raises(InputError, match=r"a.json: d.toml is missing, edited or of another answer"):
        read_answer(tmp_path / "moved" / "a.json")
    for text in ("{", "[]", '{"files": 1}', '{"files": {"../moved/d.toml": ""}}'):
        (tmp_path / "copied" / "a.json").write_text(text)
        with pytest.raises(InputError, match=r"a\.json: "):
            read_answer(tmp_path / "copied" / "a.json")


def test_answers_of_two_commands_in_one_folder(tmp_path: Path) -> None:
    with answer_set(tmp_path, ("x.json", "x.png")) as other:
        publish(tmp_path, "new", ("a.json",))
        write_json(other / "x.json", {"of": "another"})
        (tmp_path / ".avtorch-killed").mkdir()
    assert set(visible(tmp_path)) == {"a.json", "x.json"}
    publish(tmp_path, "newer", ("a.json", "b.png"))
    assert {p.name for p in tmp_path.iterdir()} == {"a.json", "b.png", "x.json"}
    assert json.loads((tmp_path / "x.json").read_text()) == {"of": "another"}


def test_two_processes_do_not_write_into_one_folder(tmp_path: Path) -> None:
    command = f"from avtorch.io import answer_set\nwith answer_set({str(tmp_path)!r}, ['a.json']): pass"
    with sole_use(tmp_path, work="a long run"):
        done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True)
    assert "in use by a long run" in done.stderr
