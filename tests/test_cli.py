"""The command line: what it writes, and one line with exit code 2 for whatever it cannot use."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from avtorch.cli import main
from avtorch.io import Log, read_answer
from avtorch.report.estimates import estimates_note
from avtorch.vehicle import GLVDPlant, Leader, simulate
from tests.faulty_disk import visible

STAT = {"mean", "sd", "q05", "q95"}


def check_windows(windows: list[dict]) -> None:
    assert windows
    for w in windows:
        assert w["end_s"] > w["start_s"]
        assert isinstance(w["excited"], bool)
        assert 0 <= w["p_string_stable"] <= 1
        for name in ("T_L", "K_L"):
            assert set(w[name]) == STAT
            assert w[name]["q05"] <= w[name]["q95"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 s of a healthy vehicle behind the default leader, as a CSV."""
    path = tmp_path_factory.mktemp("log") / "drive.csv"
    run = simulate(Leader.default(duration=13.0), plant=GLVDPlant(0.3, 1.0, sigma=0.1), duration=12.0, seeds=[1])
    run.log().write(path)
    return path


# --- stability


def test_stability_matches_the_specification(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", "--T", "1.5", "--K", "0.5", "--out", str(tmp_path / "s")]) == 0
    told = capsys.readouterr().out
    assert "2.2445" in told
    assert "string stable    no" in told
    answer = json.loads((tmp_path / "s/stability.json").read_text(encoding="utf-8"))
    assert answer["schema"] == "avtorch.stability/1"
    assert answer["locally_stable"] is True
    assert answer["string_stable"] is False
    assert answer["peak_gain"] == pytest.approx(2.2445, abs=5e-5)
    string = list(answer["conditions"]["string, sufficient (Eq. 3)"].values())
    assert string == pytest.approx([-2.54, -0.825])
    assert (tmp_path / "s/stability.png").stat().st_size > 10_000


def test_stability_of_an_unstable_loop_has_no_peak(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["stability", "--dead-time", "0.8", "--json", "--plane", "tau,T", "--out", str(tmp_path)]
    assert main(arguments) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["locally_stable"] is False
    assert answer["peak_gain"] is None
    assert answer["dead_time_margin_s"] == 0


def test_negative_gain_may_come_first(tmp_path: Path) -> None:
    assert main(["stability", "--gains=-1.5,1.5,-0.8", "-q", "--out", str(tmp_path)]) == 0


# --- estimate


def test_estimate_writes_answer_and_pictures(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep/er"
    assert main(["estimate", str(drive), "--out", str(out), "--seed", "5"]) == 0
    told = capsys.readouterr().out
    assert "100 Hz" in told
    answer = json.loads((out / "estimates.json").read_text(encoding="utf-8"))
    assert answer["schema"] == "avtorch.estimates/1"
    check_windows(answer["windows"])
    assert answer["seconds_per_window"] > 0
    used = [w for w in answer["windows"] if w["excited"]]
    assert used
    for w in used:
        assert abs(w["T_L"]["mean"] - 0.3) < 5 * w["T_L"]["sd"]
        assert set(w["sigma"]) == STAT
    assert {p.name for p in out.glob("[!.]*")} == {"estimates.html", "estimates.json", "belief.png", "probability.png"}


def test_json_is_all_there_is_on_stdout(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["estimate", str(drive), "--json", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr()
    written = read_answer(tmp_path / "estimates.json")
    assert json.loads(said.out) == {key: written[key] for key in written if key != "files"}
    assert said.err == ""


@pytest.mark.slow
def test_quiet_is_quiet_and_a_seed_repeats(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    windows = []
    for folder in ("a", "b"):
        assert main(["estimate", str(drive), "--quiet", "--seed", "7", "--out", str(tmp_path / folder)]) == 0
        windows.append(json.loads((tmp_path / folder / "estimates.json").read_text(encoding="utf-8"))["windows"])
    said = capsys.readouterr()
    assert said.out == said.err == ""
    assert windows[0] == windows[1]


def test_windows_that_did_not_settle_are_reported_separately() -> None:
    def window(*, excited: bool, used: bool) -> dict:
        stat = {"mean": 0.3, "sd": 0.01, "q05": 0.28, "q95": 0.32}
        return {"excited": excited, "used": used, "T_L": stat, "K_L": stat, "alerts": []}

    good, lost, calm = (
        window(excited=True, used=True),
        window(excited=True, used=False),
        window(excited=False, used=False),
    )
    ratio = {"T_L": None, "K_L": None}
    note = estimates_note({"windows": [good, lost, calm], "spread_over_sd": ratio})
    assert note.startswith("2 of 3 windows excited, 1 of them not used")
    note = estimates_note({"windows": [lost, calm], "spread_over_sd": ratio})
    assert "first prior" in note
    away = {**good, "alerts": ["accepted_change"]}
    assert "pass its own with --accepted" in estimates_note({"windows": [away], "spread_over_sd": ratio})
    note = estimates_note({"windows": [away] * 3, "spread_over_sd": {"T_L": 2.3, "K_L": 0.9}})
    assert "avtorch diagnose" in note
    assert "--accepted" not in note
    assert estimates_note({"windows": [good, calm], "spread_over_sd": ratio}).startswith("1 of 2 windows excited; the")


# --- run


@pytest.mark.slow
def test_run_detects_the_change_and_acts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "--duration", "36", "--seed", "3", "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert "the vehicle changes" in capsys.readouterr().out
    answer = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert answer["schema"] == "avtorch.run/1"
    assert answer["change"] == {"time_s": 26.0, "T_L": 1.5, "K_L": 0.5}
    check_windows(answer["windows"])
    assert len(answer["windows"]) == 18
    assert answer["alerts"]
    assert all(alert["time_s"] > 26 and alert["why"] for alert in answer["alerts"])
    for action in answer["actions"]:
        assert set(action["strategies"]) <= {1, 2, 3}
        assert {"T_hat", "K_hat", "time_gap_s", "gains"} <= set(action["settings"])
        assert len(action["settings"]["gains"]) == 3
    for side in ("without_action", "with_action"):
        figures = answer["performance"][side]
        for key in ("speed_rms_ratio", "accel_rms_ratio", "min_spacing_m", "jerk_rms_mps3", "clipped_share"):
            assert math.isfinite(figures[key])
        assert "min_ttc_s" in figures
    pictures = {"motion.png", "region.png", "overview.png"}
    assert {p.name for p in tmp_path.glob("[!.]*")} == {"run.json", "run.html", *pictures}
    assert set(answer["files"]) == {"run.html", *pictures}, "all of one set"


@pytest.mark.slow
@pytest.mark.parametrize("extra", [["--strategy", "none"], ["--controller", "mpc"]], ids=" ".join)
def test_run_otherwise(tmp_path: Path, extra: list[str]) -> None:
    arguments = ["run", "--duration", "14", "--change-at", "6", "--quiet", "--out", str(tmp_path), *extra]
    assert main(arguments) == 0
    answer = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    check_windows(answer["windows"])
    if "none" in extra:
        assert answer["actions"] == []
        assert answer["performance"]["without_action"] == answer["performance"]["with_action"]


@pytest.mark.slow
def test_run_behind_a_recording(data_dir: Path, tmp_path: Path) -> None:
    leader = data_dir / "openacc_astazero/ASta_040719_platoon7.csv"
    arguments = ["run", "--leader", str(leader), "--duration", "10", "--change-at", "4", "-q", "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert (tmp_path / "run.json").is_file()


# --- refusals

OUT = ["--out", "OUT"]
REFUSED = {
    "unknown command": ["diagnoze"],
    "unknown option": ["stability", "--lag", "1"],
    "two values": ["stability", "0.3", "0.4"],
    "T zero": ["stability", "--T", "0"],
    "T negative": ["stability", "--T=-1"],
    "T text": ["stability", "--T", "fast"],
    "T nan": ["stability", "--T", "nan"],
    "K zero": ["stability", "--K", "0"],
    "K infinite": ["stability", "--K", "inf"],
    "negative gap": ["stability", "--tau=-1"],
    "negative dead time": ["stability", "--dead-time=-0.1"],
    "gains two": ["stability", "--gains", "1.5,1.5"],
    "gains text": ["stability", "--gains", "1.5,x,-0.8"],
    "gains nan": ["stability", "--gains", "1.5,nan,-0.8"],
    "plane of one axis": ["stability", "--plane", "T"],
    "plane of the same axis": ["stability", "--plane", "T,T"],
    "plane unknown": ["stability", "--plane", "T,mass"],
    "out is a file": ["stability", "--out", "FILE"],
    "out inside a file": ["stability", "--out", "FILE/sub"],
    "no log": ["estimate", *OUT],
    "no out": ["estimate", "LOG"],
    "unknown file": ["estimate", "nowhere.csv", *OUT],
    "log is a folder": ["estimate", "DIR", *OUT],
    "window zero": ["estimate", "LOG", "--window", "0", *OUT],
    "window negative": ["estimate", "LOG", "--window=-2", *OUT],
    "window longer than the log": ["estimate", "LOG", "--window", "100", *OUT],
    "unknown form": ["estimate", "LOG", "--form", "guess", *OUT],
    "unknown mode": ["estimate", "LOG", "--mode", "hope", *OUT],
    "unknown estimator": ["estimate", "LOG", "--estimator", "magic", *OUT],
    "mode without priors": ["estimate", "LOG", "--estimator", "rls", "--mode", "posterior", *OUT],
    "map without a name": ["estimate", "LOG", "--map", "accel", *OUT],
    "map of no signal": ["estimate", "LOG", "--map", "force=F", *OUT],
    "unknown unit": ["estimate", "LOG", "--unit", "speed=furlong", *OUT],
    "text in a number": ["estimate", "BROKEN", *OUT],
    "negative seed": ["estimate", "LOG", "--seed=-1", *OUT],
    "seed no whole number": ["estimate", "LOG", "--seed", "1.5", *OUT],
    "dead time negative": ["estimate", "LOG", "--dead-time=-0.1", *OUT],
    "dead time beyond the window": ["estimate", "LOG", "--dead-time", "3", *OUT],
    "accepted of one": ["estimate", "LOG", "--accepted", "0.4", *OUT],
    "accepted below zero": ["estimate", "LOG", "--accepted=-0.4,1", *OUT],
    "accepted text": ["estimate", "LOG", "--accepted", "0.4,x", *OUT],
    "estimate without a gap": ["estimate", "LOG", "--tau", "0", *OUT],
    "change after the end": ["run", "--change-at", "90", *OUT],
    "change before the start": ["run", "--change-at=-1", *OUT],
    "unknown strategy": ["run", "--strategy", "4", *OUT],
    "unknown controller": ["run", "--controller", "pid", *OUT],
    "gains of an mpc": ["run", "--controller", "mpc", "--strategy", "3", *OUT],
    "run T zero": ["run", "--T", "0", *OUT],
    "run K negative": ["run", "--K=-0.5", *OUT],
    "run window zero": ["run", "--window", "0", *OUT],
    "run window no multiple": ["run", "--window", "1.2345", *OUT],
    "run window too long": ["run", "--window", "200", *OUT],
    "run too long": ["run", "--duration", "10000", *OUT],
    "run of no length": ["run", "--duration", "0", *OUT],
    "run noise negative": ["run", "--noise=-1", *OUT],
    "limits swapped": ["run", "--limits", "4,-6", *OUT],
    "limits of one": ["run", "--limits", "4", *OUT],
    "unknown leader": ["run", "--leader", "nobody.csv", *OUT],
    "leader of nonsense": ["run", "--leader", "BROKEN", *OUT],
    "vehicle no whole number": ["run", "--leader", "LOG", "--vehicle", "1.5", *OUT],
    "event without a file": ["run", "--event", "3", *OUT],
    "run into a file": ["run", "--out", "FILE"],
}


@pytest.mark.parametrize("arguments", REFUSED.values(), ids=REFUSED.keys())
def test_refused_in_one_line(
    arguments: list[str],
    drive: Path,
    tmp_path: Path,
    refused: Callable[[list[str]], str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "file").write_text("precious")
    (tmp_path / "folder").mkdir()
    (tmp_path / "broken.csv").write_text("time,accel_cmd,speed\n0,0,1\n0.1,fast,1\n")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    places = {"OUT": "out", "FILE": "file", "DIR": "folder", "BROKEN": "broken.csv"}
    named = [str(drive) if a == "LOG" else a for a in arguments]
    for word, place in places.items():
        named = [str(tmp_path / place) + a[len(word) :] if a == word or a.startswith(word + "/") else a for a in named]
    assert len(refused(named)) > 25, "too short to say what would be right"
    assert not (tmp_path / "out").exists()
    assert list((tmp_path / "here").iterdir()) == []
    assert (tmp_path / "file").read_text() == "precious"


def test_an_interruption_leaves_the_older_answer_and_its_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["stability", "-q", "--out", str(tmp_path)]
    assert main(arguments) == 0
    before = visible(tmp_path)
    assert set(before) == {"stability.json", "stability.png"}

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("avtorch.plots.stability_figure", interrupted)
    assert main([*arguments, "--T", "0.7"]) == 130
    assert capsys.readouterr().err == "avtorch: interrupted\n"
    assert visible(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["estimate"], "LOG: missing; see avtorch estimate --help"),
        (
            ["compare", "before.csv"],
            "AFTER: missing; needs a file, or two of --simulator and --simulated, see avtorch compare --help",
        ),
        (["run"], "--out: missing; see avtorch run --help"),
    ],
    ids=lambda x: x[0] if isinstance(x, list) else "",
)
def test_what_is_missing_is_named(arguments: list[str], said: str, refused: Callable[[list[str]], str]) -> None:
    assert refused(arguments) == f"avtorch: {said}\n"


@pytest.mark.slow
def test_a_sound_car_of_other_values_is_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """At (0.5 s, 0.8) every window is away from the default (0.3 s, 1.0); named as sound, none is."""
    run = simulate(Leader.default(start=48.0), plant=GLVDPlant(0.5, 0.8, 0.05), duration=10.0)
    run.log().write(tmp_path / "sound.csv")
    alerts = {}
    for values in ("0.3,1.0", "0.5,0.8"):
        out = tmp_path / values
        assert main(["estimate", str(tmp_path / "sound.csv"), "--accepted", values, "--out", str(out)]) == 0
        said = " ".join(capsys.readouterr().out.split())
        answer = json.loads((out / "estimates.json").read_text(encoding="utf-8"))
        assert list(answer["assumed"]["accepted"].values()) == [float(x) for x in values.split(",")]
        alerts[values] = [a for a in answer["alerts"] if a["detector"] == "accepted_change"]
        assert ("pass its own with --accepted" in said) == bool(alerts[values])
    assert len(alerts["0.3,1.0"]) >= 2
    assert alerts["0.5,0.8"] == []


def test_a_process_ends_with_the_code() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "avtorch.cli", "stability", "--T", "0"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "avtorch: --T: found 0, needs a finite number above 0 s\n"


@pytest.mark.parametrize("command", [[], ["run"], ["estimate"], ["stability"]], ids=lambda c: " ".join(c) or "avtorch")
def test_help_is_there(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "--help"]) == 0
    assert "Usage: avtorch" in capsys.readouterr().out


@pytest.mark.slow
def test_a_log_that_only_stands_still_is_no_error(tmp_path: Path) -> None:
    time = np.arange(0.0, 6.0, 0.02)
    calm = Log.from_arrays(
        time=time, accel_cmd=np.zeros_like(time), accel=np.zeros_like(time), jerk=np.zeros_like(time)
    )
    calm.write(tmp_path / "calm.csv")
    assert main(["estimate", str(tmp_path / "calm.csv"), "-q", "--out", str(tmp_path / "out")]) == 0
    answer = json.loads((tmp_path / "out/estimates.json").read_text(encoding="utf-8"))
    check_windows(answer["windows"])
    assert not any(w["excited"] for w in answer["windows"])
    first = answer["windows"][0]
    assert all(w["T_L"] == first["T_L"] for w in answer["windows"])
    assert torch.get_default_dtype() == torch.float32, "the command leaves torch's defaults alone"
