"""A trial's files: each believed only whole, in its place, and of this trial; a damaged answer is asked for again."""

from __future__ import annotations

import errno
import json
import os
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from avtorch.blindtest import draw_case
from avtorch.errors import InputError
from avtorch.io import Damaged, Log, read_sealed, sole_use, write_sealed
from avtorch.trial import reply, run_trial
from avtorch.trial.folder import ANSWER, TRIAL, TRUTH, TrialFolder
from tests.damage import KINDS, damaged

SHORT: dict[str, Any] = {"seconds": 60.0, "tiers": ("easy",)}
TIMES = ("seconds_per_case", "cpu_seconds_per_case", "intervals", "notes")


def says_none(log: Log) -> dict[str, Any]:
    return reply(log, {"none": 1.0}, why="always")


def says_gust(log: Log) -> dict[str, Any]:
    return reply(log, {"gust": 1.0}, why="always")


ASKED = {"says_none": says_none, "says_gust": says_gust}


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a trial of two cases, and its score."""
    folder = tmp_path_factory.mktemp("trial")
    return folder, run_trial(2, 4, folder, answerers=ASKED, keep_logs=True, **SHORT)


@pytest.fixture
def root(trial: tuple[Path, dict[str, Any]], tmp_path: Path) -> Path:
    return Path(shutil.copytree(trial[0], tmp_path / "trial"))


def settled(root: Path) -> TrialFolder:
    folder = TrialFolder(root)
    folder.settle(read_sealed(root / "trial.json", schema=TRIAL).content)
    return folder


def again(root: Path, **more: Any) -> dict[str, Any]:
    return run_trial(2, 4, root, answerers=ASKED, **{**SHORT, **more})


def without_times(found: dict[str, Any]) -> dict[str, Any]:
    own = {key: value for key, value in found.items() if key not in TIMES}
    return own | {"baselines": {name: without_times(x) for name, x in found.get("baselines", {}).items()}}


def test_truth_and_answer_come_back_as_they_were(root: Path) -> None:
    folder = settled(root)
    assert folder.truth(1) == json.loads(json.dumps(draw_case(1, 4, **SHORT).truth()))
    kept = folder.answer("says_none", 1)
    assert kept["answer"]["verdict"]["names"] == ["none"]
    assert kept["error"] is None
    assert again(root)["notes"] == []


FILES = {"trial.json": TRIAL, "truth/case_00001.json": TRUTH, "answers/says_none/case_00001.json": ANSWER}


def read(root: Path, name: str, settings: Any) -> Any:
    """What a file holds, by way of the folder."""
    folder = TrialFolder(root)
    folder.settle(settings)
    return folder.answer("says_none", 1) if "answers" in name else folder.truth(1)


@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_refused(root: Path, name: str, fresh_seed: int) -> None:
    """A hundred of each: bits, numbers, ends, pieces."""
    rng, path = random.Random(fresh_seed), root / name
    settings = read_sealed(root / "trial.json", schema=TRIAL).content
    whole, before = path.read_bytes(), read(root, name, settings)
    for turn in range(100):
        path.write_bytes(damaged(whole, turn % KINDS, rng))
        with pytest.raises(InputError, match=f"{path.name}: ") as caught:
            read(root, name, settings)
        assert str(caught.value).isprintable()
        assert "needs another folder" in str(caught.value) or "or use another folder" in str(caught.value)
    path.write_bytes(whole)
    assert read(root, name, settings) == before


CHANGES: dict[str, tuple[str, Callable[[dict[str, Any]], Any]]] = {
    "no answer": (ANSWER, lambda c: c.clear()),
    "neither answer nor error": (ANSWER, lambda c: c.update(answer=None)),
    "answer and error": (ANSWER, lambda c: c.update(error="failed")),
    "an error of another type": (ANSWER, lambda c: c.update(answer=None, error=3)),
    "time below 0": (ANSWER, lambda c: c.update(seconds=-1.0)),
    "time of words": (ANSWER, lambda c: c.update(cpu_seconds="1")),
    "probabilities that do not sum to 1": (ANSWER, lambda c: c["answer"]["effects"][0].update(probability=0.5)),
    "no verdict": (ANSWER, lambda c: c["answer"].pop("verdict")),
    "effects of another type": (ANSWER, lambda c: c["answer"].update(effects=3)),
    "an answer of another type": (ANSWER, lambda c: c.update(answer=[1])),
    "no truth": (TRUTH, lambda c: c.pop("truth")),
    "a truth of another type": (TRUTH, lambda c: c.update(truth=[])),
}


@pytest.mark.parametrize(("schema", "change"), CHANGES.values(), ids=list(CHANGES))
def test_contents_are_checked_whatever_the_checksum_says(root: Path, schema: str, change: Callable) -> None:
    name = next(name for name, own in FILES.items() if own == schema)
    found = read_sealed(root / name, schema=schema)
    change(found.content)
    write_sealed(root / name, found.content, schema=schema, of=found.of)
    with pytest.raises(Damaged, match=r"case_00001\.json: "):
        read(root, name, read_sealed(root / "trial.json", schema=TRIAL).content)


def test_a_file_in_anothers_place_is_noticed(root: Path) -> None:
    folder = settled(root)
    shutil.copy(folder.truth_path(0), folder.truth_path(1))
    with pytest.raises(InputError, match=r"truth/case_00001\.json: is of another case"):
        again(root)
    shutil.copy(folder.answer_path("says_gust", 0), folder.answer_path("says_none", 0))
    with pytest.raises(InputError, match="is of another answerer"):
        folder.answer("says_none", 0)
    other = root.parent / "other"
    run_trial(1, 5, other, answerers=ASKED, **SHORT)
    shutil.copy(other / "truth" / "case_00000.json", folder.truth_path(0))
    with pytest.raises(InputError, match="is of another trial"):
        again(root)


@pytest.mark.slow
def test_a_damaged_answer_is_asked_for_again_and_named(root: Path, trial: tuple[Path, dict[str, Any]]) -> None:
    """It can be computed again; a truth may have been changed after the answers were known."""
    folder = settled(root)
    gone, damaged, moved = (folder.answer_path("says_none", 0), *(folder.answer_path("says_gust", i) for i in (0, 1)))
    gone.unlink()
    damaged.write_bytes(damaged.read_bytes().replace(b"gust", b"none"))
    shutil.copy(folder.answer_path("says_none", 1), moved)
    found = again(root)
    assert without_times(found) == without_times(trial[1])
    assert len(found["notes"]) == 2
    assert f"{damaged}: is damaged or was changed by hand" in found["notes"][0]
    assert f"{moved}: is of another answerer" in found["notes"][1]
    assert all(note.endswith("the case was answered again.") for note in found["notes"])
    assert json.loads((root / "blindtest.json").read_text(encoding="utf-8")) == found
    assert again(root)["notes"] == []

    truth = folder.truth_path(1)
    truth.write_text(re.sub(r'("verdict": ")\w+', r"\1other", truth.read_text(encoding="utf-8")), encoding="utf-8")
    before = {p: p.read_bytes() for p in root.rglob("*.json")}
    with pytest.raises(InputError, match=r"case_00001\.json: is damaged .* remove it to have the case drawn again"):
        again(root)
    assert {p: p.read_bytes() for p in root.rglob("*.json")} == before
    truth.unlink()
    assert without_times(again(root)) == without_times(trial[1])


def test_a_log_that_was_changed_is_drawn_again(root: Path) -> None:
    shown: list[Log] = []

    def looks(log: Log) -> dict[str, Any]:
        shown.append(log)
        return says_none(log)

    path = settled(root).log_path(0)
    case = draw_case(0, 4, **SHORT).log()
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    cells = lines[30].split(",")
    cells[lines[0].split(",").index("accel_cmd")] = "0.123"
    path.write_text("\n".join([*lines[:30], ",".join(cells), *lines[31:]]) + "\n", encoding="utf-8")
    assert (Log.read(path).accel_cmd != case.accel_cmd).any()  # type: ignore[operator]
    run_trial(1, 4, root, answerers={"looks": looks}, keep_logs=True, **SHORT)
    assert (shown[0].accel_cmd == case.accel_cmd).all()  # type: ignore[operator]
    assert path.read_text(encoding="utf-8") == text


def test_an_earlier_avtorchs_folder_and_no_files_are_refused(root: Path) -> None:
    settings = read_sealed(root / "trial.json", schema=TRIAL).content
    whole = (root / "trial.json").read_bytes()
    (root / "trial.json").write_text(json.dumps({"schema": "avtorch.trial/1", **settings}), encoding="utf-8")
    with pytest.raises(InputError, match=r"trial\.json: .* from an earlier avtorch .*; needs another folder$"):
        again(root)
    (root / "trial.json").write_bytes(whole)
    folder = settled(root)
    for path, make in (
        (folder.answer_path("says_none", 0), lambda p: os.mkfifo(p)),
        (folder.answer_path("says_none", 0), lambda p: p.symlink_to(folder.answer_path("says_none", 1))),
        (folder.truth_path(0), lambda p: p.mkdir()),
    ):
        path.unlink()
        make(path)
        with pytest.raises(InputError, match=rf"{path.parent.name}/{path.name}: is a "):
            again(root)


def test_two_processes_in_one_folder_are_distinguished(root: Path) -> None:
    """A thread stands for the other process: to the lock they are alike."""
    import threading

    said: list[str] = []

    def other() -> None:
        with pytest.raises(InputError) as caught:
            again(root)
        said.append(str(caught.value))

    with sole_use(root, work="avtorch blindtest"):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        # the command holds the folder, and the trial within it is let in
        assert again(root)["notes"] == []
    assert f"{root}: in use by avtorch blindtest (pid {os.getpid()}" in said[0]


def test_a_disk_that_is_full_for_a_moment_is_no_fault_of_the_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer was good: it is not kept as one that failed."""
    write, calls = os.replace, [0]

    def full_once(source: Any, target: Any) -> None:
        if "answers" in str(target):
            calls[0] += 1
            if calls[0] == 1:
                raise OSError(errno.ENOSPC, "No space left on device")
        write(source, target)

    monkeypatch.setattr(os, "replace", full_once)
    with pytest.raises(InputError, match="No space left on device"):
        run_trial(1, 4, tmp_path, answerers={"says_none": says_none}, **SHORT)
    found = run_trial(1, 4, tmp_path, answerers={"says_none": says_none}, **SHORT)
    assert found["failed"] == 0
