"""A fleet on worker processes: killed, interrupted, over their memory, and those of another scheduler."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from avtorch.cli import main
from avtorch.errors import InputError
from avtorch.fleet import cluster, read_rows, run_fleet
from avtorch.fleet.cluster import Cluster
from tests.fleet.drives import QUICK, write_fleet

ROOT = Path(__file__).resolve().parents[2]
LAGS = {f"car{i}": 0.3 + 0.05 * i for i in range(6)}
NAMES = ("out", "undisturbed")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def answers(out: Path) -> list[dict[str, Any]]:
    """All rows, without what differs from run to run: their times."""
    rows = [row for dataset in ("checks", "windows") for row in read_rows(out, dataset).to_pylist()]
    return sorted(
        (row | {"seconds": None} for row in rows), key=lambda row: (row["log"], row.get("window") or 0, len(row))
    )


def pids(cluster: Cluster) -> dict[str, int]:
    """Of the worker processes by address."""
    return dict(cluster.client.run(os.getpid))  # type: ignore[call-overload]


@pytest.mark.slow
def test_workers_are_processes_of_one_thread_that_end_with_the_work(tmp_path: Path, scheduler: str) -> None:
    write_fleet(tmp_path / "logs", LAGS)
    seen: dict[str, Any] = {}

    def look(cluster: Cluster) -> None:
        seen.update(pids=pids(cluster), threads=cluster.client.nthreads())
        with urllib.request.urlopen(cluster.dashboard or "", timeout=30) as page:
            seen["status"] = page.status
        seen["memory"] = {w["memory_limit"] for w in cluster.client.scheduler_info()["workers"].values()}

    check = replace(QUICK, steps=("check",))
    run_fleet(tmp_path / "logs", tmp_path / "out", settings=check, workers=2, memory="1GiB", connected_to=look)
    assert len(set(seen["pids"].values()) - {os.getpid()}) == 2
    assert seen["status"] == 200
    assert (set(seen["threads"].values()), seen["memory"]) == ({1}, {2**30})
    for pid in seen["pids"].values():
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    run_fleet(tmp_path / "logs", tmp_path / "here", settings=check, scheduler=scheduler)
    rows = [read_rows(tmp_path / name, "checks").drop_columns(["seconds"]).to_pylist() for name in ("out", "here")]
    assert rows[0] == rows[1]
    assert len(rows[0]) == len(LAGS)


@pytest.mark.slow
def test_a_worker_killed_in_the_middle_costs_its_task_only(tmp_path: Path, scheduler: str) -> None:
    write_fleet(tmp_path / "logs", LAGS)
    clusters: list[Cluster] = []
    killed: list[int] = []

    def kill_one(words: str, done: int, of: int) -> None:
        if words.startswith(("2 of", "7 of")):
            victim = next(iter(pids(clusters[0]).values()))
            os.kill(victim, signal.SIGKILL)
            killed.append(victim)

    settings = replace(QUICK, estimator="sgld")  # long enough to be killed in
    answer = run_fleet(
        tmp_path / "logs",
        tmp_path / "out",
        settings=settings,
        workers=2,
        progress=kill_one,
        connected_to=clusters.append,
    )
    assert len(set(killed)) == 2
    assert answer["failed_logs"] == 0
    run_fleet(tmp_path / "logs", tmp_path / "undisturbed", settings=settings, scheduler=scheduler)
    # no row is lost, none doubled, and each is the same
    assert answers(tmp_path / "out") == answers(tmp_path / "undisturbed")
    assert len(answers(tmp_path / "out")) > 2 * len(LAGS)


@pytest.mark.slow
def test_a_log_that_ends_every_worker_becomes_a_row_and_the_others_are_done(tmp_path: Path) -> None:
    """It needs more memory than a worker may take: each worker that tries it is ended, not the machine's memory."""
    write_fleet(tmp_path / "logs", LAGS)
    rows = 5_000_000
    time_s = 0.01 * np.arange(rows)
    columns = {"time": time_s, "accel_cmd": np.sin(time_s), "accel": np.sin(time_s - 0.3), "speed": 20 - np.cos(time_s)}
    (tmp_path / "logs" / "large").mkdir()
    pq.write_table(pa.table(columns), tmp_path / "logs" / "large" / "drive.parquet")
    answer = run_fleet(tmp_path / "logs", tmp_path / "out", settings=QUICK, workers=2, memory="400MiB")
    errors = {car["car"]: car["logs"][0]["errors"] for car in answer["cars"]}
    large = errors.pop("large")
    assert large["check"] == "its worker ended each time: killed, or beyond its memory"
    assert large["estimate"] == "not tried: its worker ended at an earlier step"
    assert errors == {car: {} for car in LAGS}
    status = {row["car"]: row["status"] for row in read_rows(tmp_path / "out", "checks").to_pylist()}
    assert status == {"large": "crashed", **dict.fromkeys(LAGS, "done")}


@pytest.mark.slow
def test_memory_in_which_no_worker_lives_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(cluster._LOCAL, "distributed.scheduler.no-workers-timeout", "5s")
    write_fleet(tmp_path / "logs", {"car": 0.3})
    with pytest.raises(InputError, match=r"^memory: no worker lives within it, needs more"):
        run_fleet(tmp_path / "logs", tmp_path / "out", settings=QUICK, workers=1, memory="60MiB")


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[str]:
    """The address of a scheduler of its own, with two workers; each is a process that the fleet did not start."""
    file = tmp_path / "scheduler.json"
    python = [sys.executable, "-m"]
    begun: list[subprocess.Popen[bytes]] = []

    def begin(*command: str) -> None:
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        begun.append(subprocess.Popen([*python, *command], env=ENVIRONMENT, cwd=tmp_path, **quiet))

    try:
        begin(
            "distributed.cli.dask_scheduler",
            *("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)),
        )
        for name in ("one", "two"):
            begin("distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--name", name)
        deadline = time.monotonic() + 60
        while not file.exists():
            assert time.monotonic() < deadline, "the scheduler has not begun"
            time.sleep(0.05)
        time.sleep(0.1)
        yield json.loads(file.read_text(encoding="utf-8"))["address"]
    finally:
        # workers before their scheduler: one that has lost it tries for a while to find it again
        for process in reversed(begun):
            process.terminate()
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(15)


@pytest.mark.slow
def test_a_scheduler_and_workers_that_are_there_already(
    elsewhere: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = tmp_path / "logs"
    write_fleet(logs, LAGS)
    (logs / "broken.csv").write_text("a,b\n1,2\n")
    command = ["fleet", f"file://{logs}", "--out", str(tmp_path / "out"), "--scheduler", elsewhere]
    command += ["--only", "check,estimate", "--estimator", "map", "--dead-time", "0"]
    assert main([*command, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["work"] == {"kept": 0, "computed": 14}
    assert answer["failed_logs"] == 1
    run_fleet(logs, tmp_path / "here", settings=QUICK, workers=1)
    theirs, own = (
        {(Path(row["log"]).parent.name, row.get("window")): row.get("T_L_mean") for row in answers(tmp_path / name)}
        for name in ("out", "here")
    )
    assert theirs == own
    # the cluster is the user's: it goes on
    assert main([*command, "--quiet", "--window", "1"]) == 0


@pytest.mark.slow
def test_a_cluster_of_another_avtorch_is_refused(
    elsewhere: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (log,) = write_fleet(tmp_path, {"red": 0.4})
    monkeypatch.setattr("avtorch.version.__version__", "9.9.9")
    assert main(["fleet", str(log), "--out", str(tmp_path / "out"), "--scheduler", elsewhere]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "needs avtorch 9.9.9" in told


@pytest.mark.slow
def test_an_interrupted_run_is_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Ctrl-C goes to the whole group of processes, workers and all."""
    cars = {f"car{i}": 0.3 + 0.01 * i for i in range(16)}  # enough that the work is not done before the signal comes
    write_fleet(tmp_path / "logs", cars)
    out = tmp_path / "out"
    command = ["fleet", str(tmp_path / "logs"), "--out", str(out), "--only", "check,estimate", "--dead-time", "0"]
    command += ["--estimator", "sgld"]
    # on a loaded machine the work must wait for this process, which is to interrupt it, and gets little of the cores
    with subprocess.Popen(
        ["nice", "-n", "10", sys.executable, "-m", "avtorch.cli", *command, "--workers", "2"],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            deadline = time.monotonic() + 300
            while not list(out.glob("windows/*.parquet")):
                assert time.monotonic() < deadline
                assert process.poll() is None
                time.sleep(0.02)
            os.killpg(process.pid, signal.SIGINT)
            _, told = process.communicate(timeout=60)
        finally:
            if process.poll() is None:  # nothing of it is left to the tests after this one
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert told.splitlines()[-1:] == [
        f"avtorch: interrupted: finished rows are kept in {out}: the same command does what is missing"
    ]
    assert "Traceback" not in told
    assert not [p for p in out.rglob("*") if p.suffix == ".part"]
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.parquet")}
    assert len(cars) < len(before) < 2 * len(cars)
    assert main([*command, "--json", "--workers", "1"]) == 0
    work = json.loads(capsys.readouterr().out)["work"]
    assert work == {"kept": len(before), "computed": 2 * len(cars) - len(before)}
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert {row["status"] for row in answers(out)} == {"done"}
