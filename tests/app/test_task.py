"""The command that a tab shows is the one that it runs, and a run can be ended at any moment."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from avtorch.app.task import Job, Task
from avtorch.cli import main

FAULTY = "time,accel_cmd,speed\n0,1,x\n0.1,1,2\n"


def test_the_command_is_quoted() -> None:
    task = Task(["-my drive.csv"], "out/my_drive", {"speed": "v x"}, {"speed": "km/h"})
    assert task.command == (
        "avtorch diagnose './-my drive.csv' '--map=speed=v x' --unit=speed=km/h --credibility --out out/my_drive"
    )
    assert Task(["a.csv", "b.csv"], "out/b").command == "avtorch compare a.csv b.csv --out out/b"


@pytest.mark.parametrize(
    "task", [Task(["a'.csv"], "out/a"), Task(["a.csv", "b.csv"], "out/b"), Task(["a.csv"], "out/a", follower=True)]
)
def test_the_python_compiles(task: Task) -> None:
    compile(task.python, "shown", "exec")


def run(task: Task, folder: Path, slots: int = 1) -> Job:
    return Job(task, folder, threading.Semaphore(slots))


@pytest.mark.slow
def test_a_broken_file_fails_with_the_words_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "drive.csv").write_text(FAULTY)
    job = run(Task(["drive.csv"], "out/drive"), tmp_path)
    job.thread.join(120)
    assert job.state == "failed"
    assert main(["diagnose", str(tmp_path / "drive.csv"), "--out", str(tmp_path / "own")]) == 2
    assert f"avtorch: {tmp_path}/{job.fault}\n" == capsys.readouterr().err


def test_what_waits_can_be_cancelled(tmp_path: Path) -> None:
    slots = threading.Semaphore(0)
    job = Job(Task(["drive.csv"], "out/drive"), tmp_path, slots)
    assert job.state == "waiting"
    job.cancel()
    slots.release()
    job.thread.join(10)
    assert job.state == "cancelled"


def test_a_run_ends_when_cancelled_and_leaves_nothing(tmp_path: Path) -> None:
    import avtorch

    avtorch.simulate(avtorch.Leader.default(start=40.0, duration=60.0, dt=0.05)).log().write(tmp_path / "drive.csv")
    job = run(Task(["drive.csv"], "out/drive"), tmp_path)
    while job.state == "waiting":
        time.sleep(0.05)
    time.sleep(0.5)
    begun = time.monotonic()
    job.cancel()
    job.thread.join(60)
    assert job.state == "cancelled"
    assert job.fault == ""
    assert time.monotonic() - begun < 30  # by force after five seconds, on a machine under load
    assert not (tmp_path / "out" / "drive" / "report.html").exists()
