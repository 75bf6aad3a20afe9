"""A fleet from its logs to its rows and its answer, on a cluster in this process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.fleet import FleetLog, FleetSettings, read_rows, run_fleet
from avtorch.fleet import task as tasks
from avtorch.fleet.folder import FleetFolder, schema
from avtorch.fleet.log_list import key_of
from avtorch.io import Log
from avtorch.results import window_entry
from tests.bars import BAR
from tests.fleet.drives import QUICK, drive, write_fleet
from tests.overridden import taken_over


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """(step, car) of every task that computes from now on."""
    done: list[tuple[str, str]] = []
    rows = tasks._rows

    def counted(task: tasks.Task, local: Path) -> Any:
        done.append((task.step, Path(task.place).parent.name))
        return rows(task, local)

    monkeypatch.setattr(tasks, "_rows", counted)
    return done


@dataclass(frozen=True)
class Ran:
    """A fleet of two cars and two broken logs, and its answer."""

    logs: Path
    out: Path
    answer: dict[str, Any]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory, scheduler: str) -> Ran:
    folder = tmp_path_factory.mktemp("ran")
    write_fleet(folder / "logs", {"red": 0.4, "blue": 0.3})
    for car, text in {"green": "time,speed\n0,1\n", "black": "\x00\x01 no table"}.items():
        (folder / "logs" / car).mkdir()
        (folder / "logs" / car / "drive.csv").write_text(text)
    answer = run_fleet(folder / "logs", folder / "out", settings=QUICK, scheduler=scheduler)
    return Ran(folder / "logs", folder / "out", answer)


def stamps(out: Path) -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in sorted(out.rglob("*.parquet"))}


def test_rows_are_what_estimate_gives(tmp_path: Path, scheduler: str) -> None:
    (log,) = write_fleet(tmp_path / "logs", {"red": 0.4})
    run_fleet(log, tmp_path / "out", settings=QUICK, scheduler=scheduler)
    rows = read_rows(tmp_path / "out", "windows").to_pylist()
    found = avtorch.estimate(Log.read(log), estimator="map", dead_time=0.0)
    entries = [window_entry(w) for w in found.windows]
    assert len(rows) == len(entries) > 2
    for row, entry in zip(rows, entries, strict=True):
        assert (row["begin_s"], row["end_s"], row["rows"]) == (entry["start_s"], entry["end_s"], entry["n"])
        assert row["p_string_stable"] == entry["p_string_stable"]
        for name in ("T_L", "K_L"):
            assert {part: row[f"{name}_{part}"] for part in entry[name]} == entry[name]
        assert {n["name"]: n["value_mean"] for n in row["noise"]} == {"sigma": entry["sigma"]["mean"]}
        assert (row["car"], row["status"], row["error"]) == ("drive", "done", None)


def test_polars_reads_the_folder_of_windows(ran: Ran) -> None:
    polars = pytest.importorskip("polars")
    expected = read_rows(ran.out, "windows")
    found = polars.read_parquet(ran.out / "windows")
    assert found.columns == expected.column_names == schema("estimate").names
    assert found.height == expected.num_rows
    # two without an answer, and four windows of 2 s of each car's 8 s
    counts = dict(found.group_by("car").len().iter_rows())
    assert counts == {"red": 4, "blue": 4, "green": 1, "black": 1}
    used = found.filter(polars.col("status") == "done").sort("car", "window")
    rows = [row for row in expected.to_pylist() if row["status"] == "done"]
    rows.sort(key=lambda row: (row["car"], row["window"]))
    for column in ("T_L_mean", "K_L_sd", "begin_s", "excited", "alerts"):
        assert used[column].to_list() == [row[column] for row in rows]


def test_a_broken_log_is_a_row_that_says_why_and_the_others_are_done(ran: Ran) -> None:
    assert {car["car"]: car["reason"] for car in ran.answer["cars"]} == {
        "black": "failed",
        "green": "failed",
        "red": "sound",
        "blue": "sound",
    }
    for dataset in ("checks", "windows"):
        rows = {row["car"]: row for row in read_rows(ran.out, dataset).to_pylist()}
        assert {car: row["status"] for car, row in rows.items()} == {
            "red": "done",
            "blue": "done",
            "green": "failed",
            "black": "failed",
        }
        assert "drive.csv" in rows["green"]["error"]
        assert "accel_cmd" in rows["green"]["error"] or "from row to row" in rows["green"]["error"]


def test_a_second_call_computes_nothing(ran: Ran, computed: list[tuple[str, str]]) -> None:
    assert ran.answer["work"] == {"kept": 0, "computed": 8}
    before = stamps(ran.out)
    # no cluster either: there is none at this address
    again = run_fleet(ran.logs, ran.out, settings=QUICK, scheduler="tcp://127.0.0.1:1")
    assert (again["work"], computed, stamps(ran.out)) == ({"kept": 8, "computed": 0}, [], before)
    assert again["cars"] == ran.answer["cars"]


@pytest.mark.slow
def test_what_has_changed_is_computed_again(tmp_path: Path, scheduler: str, computed: list[tuple[str, str]]) -> None:
    write_fleet(tmp_path / "logs", {"red": 0.4, "blue": 0.3})
    out, source = tmp_path / "out", tmp_path / "logs"

    def run(settings: FleetSettings = QUICK) -> set[tuple[str, str]]:
        computed.clear()
        run_fleet(source, out, settings=settings, scheduler=scheduler)
        return set(computed)

    assert len(run()) == 4
    drive(0.8, 0.7).write(source / "red" / "drive.csv")
    assert run() == {("check", "red"), ("estimate", "red")}
    rows = [row for row in read_rows(out, "windows").to_pylist() if row["car"] == "red"]
    assert rows[-1]["T_L_mean"] == pytest.approx(0.8, abs=0.02)  # the car's own, without noise
    # how a log is read belongs to its content
    (source / "blue" / "drive.toml").write_text('[unit]\nspeed = "m/s"\n')
    assert run() == {("check", "blue"), ("estimate", "blue")}
    # settings of one step leave the rows of the others
    assert run(replace(QUICK, window=1.0)) == {("estimate", "red"), ("estimate", "blue")}
    # a new log joins
    write_fleet(source, {"green": 0.5})
    assert run(replace(QUICK, window=1.0)) == {("check", "green"), ("estimate", "green")}
    # a file of rows that was damaged
    damaged = sorted((out / "windows").glob("*.parquet"))[0]
    damaged.write_bytes(damaged.read_bytes()[:100])
    assert len(run(replace(QUICK, window=1.0))) == 1


def test_another_version_computes_again(
    tmp_path: Path, scheduler: str, computed: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_fleet(tmp_path / "logs", {"red": 0.4})
    run_fleet(tmp_path / "logs", tmp_path / "out", settings=QUICK, scheduler=scheduler)
    computed.clear()
    monkeypatch.setattr("avtorch.fleet.folder.__version__", "9.9.9")
    run_fleet(tmp_path / "logs", tmp_path / "out", settings=QUICK, scheduler=scheduler)
    assert len(computed) == 2
    assert read_rows(tmp_path / "out", "checks").to_pylist()[0]["version"] == "9.9.9"


def test_a_crash_is_tried_again_and_a_bad_log_is_not(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_fleet(tmp_path / "logs", {"red": 0.4})
    (tmp_path / "logs" / "red" / "bad.csv").write_text("a,b\n1,2\n")
    rows = tasks._rows

    def out_of_memory(task: tasks.Task, local: Path) -> Any:
        if task.step == "estimate" and local.name == "drive.csv":
            raise MemoryError("no room")
        return rows(task, local)

    options: dict[str, Any] = {"settings": QUICK, "scheduler": scheduler}
    with monkeypatch.context() as crowded:
        crowded.setattr(tasks, "_rows", out_of_memory)
        answer = run_fleet(tmp_path / "logs", tmp_path / "out", **options)
    errors = {Path(log["log"]).name: log["errors"] for log in answer["cars"][-1]["logs"] + answer["cars"][0]["logs"]}
    assert errors["drive.csv"] == {"estimate": "MemoryError: no room"}
    again = run_fleet(tmp_path / "logs", tmp_path / "out", **options)
    assert again["work"] == {"kept": 3, "computed": 1}
    assert not next(log for car in again["cars"] for log in car["logs"] if log["log"].endswith("drive.csv"))["errors"]
    # on request, as after installing what was missing
    assert run_fleet(tmp_path / "logs", tmp_path / "out", retry=True, **options)["work"] == {"kept": 2, "computed": 2}


def test_a_log_that_is_not_there_is_a_row_and_is_looked_for_again(tmp_path: Path, scheduler: str) -> None:
    (tmp_path / "fleet.csv").write_text("log,car\na.csv,red\nb.csv,blue\n")
    drive().write(tmp_path / "a.csv")
    answer = run_fleet(tmp_path / "fleet.csv", tmp_path / "out", settings=QUICK, scheduler=scheduler)
    assert [(car["car"], car["reason"]) for car in answer["cars"]] == [("blue", "failed"), ("red", "sound")]
    assert "no such file" in answer["cars"][0]["logs"][0]["errors"]["check"]
    drive().write(tmp_path / "b.csv")
    answer = run_fleet(tmp_path / "fleet.csv", tmp_path / "out", settings=QUICK, scheduler=scheduler)
    assert {car["reason"] for car in answer["cars"]} == {"sound"}
    assert read_rows(tmp_path / "out", "checks").num_rows == 2
    # gone again, or its store is out of reach: what was computed is not lost
    (tmp_path / "b.csv").unlink()
    before = stamps(tmp_path / "out")
    answer = run_fleet(tmp_path / "fleet.csv", tmp_path / "out", settings=QUICK, scheduler=scheduler)
    assert (answer["work"], stamps(tmp_path / "out")) == ({"kept": 4, "computed": 0}, before)
    assert answer["notes"] == [f"Not read this time, its earlier rows are kept: {tmp_path / 'b.csv'}: no such file"]


def test_the_manifest_names_cars_anew_without_computing(
    tmp_path: Path, scheduler: str, computed: list[tuple[str, str]]
) -> None:
    drive().write(tmp_path / "a.csv")
    manifest = tmp_path / "fleet.csv"
    manifest.write_text("log,car,date,route\na.csv,red,2026-11-01,A9\n")
    run_fleet(manifest, tmp_path / "out", settings=QUICK, scheduler=scheduler)
    manifest.write_text("log,car,date,route\na.csv,blue,2026-11-02,A8\n")
    computed.clear()
    answer = run_fleet(manifest, tmp_path / "out", settings=QUICK, scheduler=scheduler)
    assert (computed, answer["cars"][0]["car"]) == ([], "blue")
    for row in read_rows(tmp_path / "out", "windows").to_pylist():
        assert (row["car"], row["date"], dict(row["tags"])) == ("blue", "2026-11-02", {"route": "A8"})


@pytest.mark.slow
@pytest.mark.statistical
def test_a_diagnosis_is_a_row(tmp_path: Path, scheduler: str, rotating_seed: int) -> None:
    log = taken_over(seconds=40.0, overrides=(), rng=np.random.default_rng(rotating_seed), delay_s=0.3)
    log.write(tmp_path / "late.csv")
    settings = FleetSettings(steps=("diagnose",), effects=("dead_time",), pairs=False, posterior="laplace")
    answer = run_fleet(tmp_path / "late.csv", tmp_path / "out", settings=settings, scheduler=scheduler)
    (row,) = read_rows(tmp_path / "out", "diagnoses").to_pylist()
    full = json.loads(row["answer"])
    assert (row["verdict"], full["verdict"]["names"]) == (["dead_time"], ["dead_time"])
    (cause,) = row["causes"]
    (part,) = full["budget"]["parts"]
    assert {p: cause[f"share_{p}"] for p in ("mean", "q05", "q95")} == part["share"]
    delay = cause["parameters"][0]
    assert delay["name"] == "delay_s"
    assert abs(delay["value_mean"] - 0.3) < BAR * delay["value_sd"]
    assert row["unexplained_mean"] == full["budget"]["unexplained"]["share"]["mean"]
    # how sure it says it is depends on the draw: "Probably the simulator lacks this" below 0.9
    assert "the simulator lacks this" in row["summary"].lower()
    car = answer["cars"][0]
    assert (car["reason"], car["gap"]["verdict"]) == ("gap", ["dead_time"])


@pytest.mark.slow
@pytest.mark.statistical
def test_the_sizes_of_a_cause_are_pooled_over_cars_that_were_diagnosed(
    tmp_path: Path, scheduler: str, rotating_seed: int
) -> None:
    rng = np.random.default_rng(rotating_seed)
    delays = {f"car_{number}": 0.2 + 0.03 * number for number in range(5)}
    for car, delay in delays.items():
        (tmp_path / "logs" / car).mkdir(parents=True)
        for number in range(2):
            log = taken_over(seconds=40.0, overrides=(), rng=rng, delay_s=delay)
            log.write(tmp_path / "logs" / car / f"drive_{number}.csv")
    settings = FleetSettings(steps=("diagnose",), effects=("dead_time",), pairs=False, posterior="laplace")
    answer = run_fleet(tmp_path / "logs", tmp_path / "out", settings=settings, scheduler=scheduler)

    (cause,) = answer["causes"]
    assert (cause["name"], cause["cars"], cause["diagnosed"], cause["verdict"]) == ("dead_time", 5, 5, "the model's")
    common = cause["parameters"]["delay_s"]
    assert (common["cars"], common["drives"], common["unit"]) == (5, 10, "s")
    typical = common["typical"]
    assert typical["q05"] < np.exp(np.mean(np.log(list(delays.values())))) < typical["q95"]

    by_car: dict[str, list[dict[str, Any]]] = {car: [] for car in delays}
    for row in read_rows(tmp_path / "out", "diagnoses").to_pylist():
        by_car[row["car"]].append(row["causes"][0]["parameters"][0])
    for car, delay in delays.items():
        own = next(each for each in answer["cars"] if each["car"] == car)["effects"]["dead_time"]["delay_s"]
        means, sds = (np.array([told[key] for told in by_car[car]]) for key in ("value_mean", "value_sd"))
        # between its own drives and the typical car, of which the mean counts and the median is told
        ends = np.array([*means, typical["median"]])
        assert ends.min() - 0.1 * sds.min() < own["median"] < ends.max() + 0.1 * sds.min()
        # and no further off than the worse drive says
        assert abs(own["median"] - delay) < BAR * sds.max()


def test_a_report_goes_with_its_answer(tmp_path: Path) -> None:
    folder, log = FleetFolder(tmp_path), FleetLog("a.csv", "../red car")
    done: list[dict[str, Any]] = [{"verdict": ["none"]}]
    folder.write("diagnose", log, "key", done, sha256="0", seconds=0.0, report="<p>page</p>")
    assert folder.report(log).read_text() == "<p>page</p>"
    # the manifest names another car since
    other = replace(log, car="blue")
    assert folder.kept("diagnose", other, "key") == "done"
    assert [row["car"] for row in folder.rows("diagnose", other)] == ["blue"]
    assert folder.report(other).read_text() == "<p>page</p>"
    folder.write("diagnose", other, "key", done, sha256="0", seconds=0.0)
    assert not folder.report(other).exists()


@pytest.mark.slow
def test_reports_are_written_by_the_worker_and_made_where_missing(tmp_path: Path, scheduler: str) -> None:
    for car, lag in {"red": 0.4, "blue": 0.3}.items():
        (tmp_path / "logs" / car).mkdir(parents=True)
        drive(lag, seconds=14.0).write(tmp_path / "logs" / car / "drive.csv")
    settings = FleetSettings(steps=("diagnose",), effects=("dead_time",), pairs=False, posterior="laplace")

    def fleet(**more: Any) -> dict[str, Any]:
        return run_fleet(tmp_path / "logs", tmp_path / "out", settings=settings, scheduler=scheduler, **more)

    plain = fleet()
    assert plain["failed_logs"] == 0
    assert [log["report"] for car in plain["cars"] for log in car["logs"]] == [None, None]
    full = fleet(report=str)
    assert full["work"]["computed"] == 2
    for car in full["cars"]:
        (log,) = car["logs"]
        assert log["report"].startswith("reports/drive-")
        assert (tmp_path / "out" / log["report"]).read_text().startswith(car["gap"]["summary"])
    assert fleet(report=str)["work"]["computed"] == 0
    assert fleet()["cars"] == full["cars"]


def test_logs_by_url(tmp_path: Path, scheduler: str) -> None:
    """`memory://` is a store that only this process sees, so the worker is one of its threads."""
    import fsspec

    paths = write_fleet(tmp_path / "logs", {"red": 0.4, "blue": 0.3})
    store = fsspec.filesystem("memory")
    for path in paths:
        # the store's copy has names of its own, and a mapping beside it
        store.pipe(f"/fleet/{path.parent.name}/drive.csv", path.read_bytes().replace(b"accel_cmd", b"Request"))
        store.pipe(f"/fleet/{path.parent.name}/drive.toml", b'[map]\naccel_cmd = "Request"\n')
    store.pipe("/fleet/red/broken.csv", b"a,b\n1,2\n")
    try:
        answer = run_fleet("memory://fleet", tmp_path / "out", settings=QUICK, scheduler=scheduler)
        assert [(car["car"], car["reason"]) for car in answer["cars"]] == [("red", "failed"), ("blue", "sound")]
        logs = {log["log"]: log["errors"] for log in answer["cars"][0]["logs"]}
        assert set(logs) == {"memory:///fleet/red/drive.csv", "memory:///fleet/red/broken.csv"}
        assert logs["memory:///fleet/red/broken.csv"]["check"].startswith("memory:///fleet/red/broken.csv: ")
        again = run_fleet("memory://fleet/**/drive.csv", tmp_path / "out", settings=QUICK, scheduler=scheduler)
        assert again["work"] == {"kept": 4, "computed": 0}
        assert again["notes"] == ["The folder has rows of 1 more logs, which this call did not name."]
    finally:
        store.rm("/fleet", recursive=True)


def test_a_log_that_changes_meanwhile_is_not_taken_for_the_old_one(tmp_path: Path) -> None:
    drive().write(tmp_path / "a.csv")
    log = FleetLog(str(tmp_path / "a.csv"), "a")
    (row,) = tasks.work(tasks.Task("check", log, log.identity, "0" * 64, 1, QUICK)).rows
    assert row["status"] == "crashed"
    assert "changed while the fleet ran" in row["error"]


def test_what_is_no_file_of_rows_has_no_key(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and no more")
    assert key_of(tmp_path / "a.parquet") is key_of(tmp_path / "b.parquet") is None


def test_a_call_with_nothing_to_compute_loads_neither_torch_nor_dask(tmp_path: Path, scheduler: str) -> None:
    write_fleet(tmp_path / "logs", {"red": 0.4})
    run_fleet(tmp_path / "logs", tmp_path / "out", settings=FleetSettings(steps=("check",)), scheduler=scheduler)
    command = ["fleet", str(tmp_path / "logs"), "--out", str(tmp_path / "out"), "--only", "check", "--quiet"]
    code = (
        f"import sys; from avtorch.cli.app import main; assert main({command!r}) == 0;"
        "print(*[m for m in ('torch', 'distributed', 'matplotlib', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
    assert json.loads((tmp_path / "out" / "fleet.json").read_text())["work"] == {"kept": 1, "computed": 0}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: FleetSettings(steps=("drive",)), "steps: found 'drive', needs some of check, estimate, diagnose"),  # type: ignore[arg-type]
        (lambda: FleetSettings(steps=()), "steps: found none"),
        (lambda: FleetSettings(window=float("nan")), "window: found nan"),
        (lambda: FleetSettings(dead_time=3.0), "dead_time: found 3 s"),
        (lambda: FleetSettings(target=1.0), "target: found 1"),
        (lambda: FleetSettings(seed=-1), "seed: found -1"),
        (lambda: run_fleet("fleet.csv", "out", workers=0), "workers: found 0"),
        (lambda: run_fleet("a.csv", "out", memory="lots", workers=1), "memory: found 'lots'"),
        (lambda: run_fleet("a.csv", "out", scheduler="nowhere"), "scheduler: 'nowhere' cannot be reached"),
        (lambda: run_fleet("a.csv", "out", settings=FleetSettings(map=("acel=a",))), "acel"),
        (lambda: run_fleet("a.csv", "out", settings=FleetSettings(effects=("grip",))), "grip"),
        (lambda: run_fleet("a.csv", "out", settings=FleetSettings(baseline="grip=1")), "grip"),
        (lambda: run_fleet("a.csv", "out", settings=FleetSettings(estimator="mle")), "estimator: found 'mle'"),
        (lambda: run_fleet("missing.csv", "out"), "missing.csv: no such file"),
        (lambda: read_rows("out", "diagnoses"), "has no rows"),
        (lambda: run_fleet("a.csv", "s3://bucket/out"), "out: found 's3://bucket/out'; output is local"),
        (lambda: read_rows("out", "rows"), "dataset: found 'rows', needs checks, windows, diagnoses"),
    ],
)
def test_bad_arguments_are_one_line(
    wrong: Callable[[], object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("avtorch.fleet.cluster.CONNECT_S", 0.5)
    drive().write("a.csv")
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        wrong()
