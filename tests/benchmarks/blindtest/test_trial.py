"""A trial: it keeps what was answered and does only what is missing; its command, its rivals, its confusion matrix."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest import Car, DrivePlan, draw_case, simulate
from benchmarks.blindtest import __main__ as command
from benchmarks.blindtest.answerers import RIVALS, rivals
from benchmarks.blindtest.answers import read_answer
from benchmarks.blindtest.confusion import confusion, confusion_figure
from benchmarks.blindtest.reply import reply
from benchmarks.blindtest.rivals import black_box, likelihood_bic, random_guess, sparse_regression
from benchmarks.blindtest.rivals.maximum_likelihood import Fitter
from benchmarks.blindtest.rivals.residuals import Residuals
from benchmarks.blindtest.trial import run_trial
from tests.bars import BAR

SHORT = {"seconds": 60.0, "tiers": ("easy",)}
KEYS = {
    *("cases", "seed", "top1", "alias_set", "false_alarm", "unknown_auroc", "unknown_fpr95"),
    *("unknown_confidently_blamed", "ece", "brier", "macro_f1", "pairs_exact", "pairs_jaccard", "closed_error"),
    *("placebo_closed", "onset_error_s", "seconds_per_case", "baselines", "confusion"),
}


class Asked:
    """Answers `none`, and records the logs that it was given."""

    def __init__(self) -> None:
        self.logs: list[Log] = []

    def __call__(self, log: Log) -> dict[str, Any]:
        self.logs.append(log)
        return reply(log, {"none": 1.0}, why="always")


@pytest.mark.slow
def test_answers_are_kept_and_only_missing_ones_are_asked_for(tmp_path: Path) -> None:
    first, steps = Asked(), []
    found = run_trial(6, 4, tmp_path, answerers={"says_none": first}, progress=lambda *s: steps.append(s), **SHORT)
    assert [log.name for log in first.logs] == [f"case_{i:05d}" for i in range(6)]
    assert steps == [(i, 6) for i in range(7)]
    assert json.loads((tmp_path / "blindtest.json").read_text(encoding="utf-8")) == found
    assert found["schema"] == "avtorch.blindtest/1"
    assert found.keys() >= KEYS
    assert found["false_alarm"] in (0.0, None)
    assert found["baselines"] == {}

    again, guess = Asked(), {"random_guess": random_guess}
    (tmp_path / "answers" / "says_none" / "case_00003.json").unlink()
    more = run_trial(7, 4, tmp_path, answerers={"says_none": again, **guess}, **SHORT)
    assert [log.name for log in again.logs] == ["case_00003", "case_00006"]
    assert set(more["baselines"]) == {"random_guess"}
    assert KEYS - {"cases", "seed", "baselines"} <= more["baselines"]["random_guess"].keys()
    assert sum(sum(row.values()) for row in more["confusion"].values()) == 7
    # truths are stored apart from the input of an answerer
    assert not {"truth", "logs"} & {p.name for p in (tmp_path / "answers").rglob("*")}


@pytest.mark.slow
def test_several_causes_are_divided_alike_when_drawn_again(tmp_path: Path) -> None:
    options: dict[str, Any] = {"mix": {"several": 1.0}, "seconds": 30.0, "signals": ("speed",)}
    found = run_trial(1, 5, tmp_path, answerers={"says_none": Asked()}, **options)
    assert found["several"]["recall"] == 0.0
    assert found["counts"]["several"]["exact"] == 1
    truth = json.loads((tmp_path / "truth" / "case_00000.json").read_text(encoding="utf-8"))
    assert list(truth["budget"]["by_channel"]) == ["speed"]
    # the truth is compared with the kept one
    assert run_trial(1, 5, tmp_path, answerers={"other": Asked()}, **options)["failed"] == 0


def test_other_settings_need_another_folder(tmp_path: Path) -> None:
    run_trial(1, 4, tmp_path, answerers={"says_none": Asked()}, **SHORT)
    with pytest.raises(InputError, match="trial with seed 4; found 5"):
        run_trial(1, 5, tmp_path, answerers={"says_none": Asked()}, **SHORT)
    with pytest.raises(InputError, match="signals"):
        run_trial(1, 4, tmp_path, answerers={"says_none": Asked()}, signals=("speed",), **SHORT)
    # a vehicle that has changed makes another case of the same number
    truth = tmp_path / "truth" / "case_00000.json"
    truth.write_text(json.dumps(json.loads(truth.read_text(encoding="utf-8")) | {"visibility": 1.0}), encoding="utf-8")
    with pytest.raises(InputError, match="comes out otherwise"):
        run_trial(1, 4, tmp_path, answerers={"other": Asked()}, **SHORT)


@pytest.mark.slow
def test_who_fails_or_breaks_the_schema_has_not_answered(tmp_path: Path) -> None:
    def fails(log: Log) -> dict[str, Any]:
        raise ValueError("out of ideas")

    def breaks(log: Log) -> dict[str, Any]:
        answer = reply(log, {"none": 1.0}, why="half")
        answer["effects"][0]["probability"] = 0.5
        return answer

    def not_finite(log: Log) -> dict[str, Any]:
        return reply(log, {"none": 1.0}, why="nan") | {"onset_s": float("nan")}

    def no_budget(log: Log) -> dict[str, Any]:
        odd = {"parts": ["dead_time"], "chance": [], "unexplained": {"share": {"mean": 0.0}}}
        return reply(log, {"none": 1.0}, why="odd") | {"schema": "avtorch.diagnosis/2", "budget": odd}

    every = {"fails": fails, "breaks": breaks, "not_finite": not_finite, "no_budget": no_budget}
    found = run_trial(2, 4, tmp_path, answerers=every, **SHORT)
    assert found["failed"] == 2
    assert found["failures"] == ["ValueError: out of ideas"]
    assert {v for row in found["confusion"].values() for v in row} == {"failed"}
    assert "probabilities sum to 0.5" in found["baselines"]["breaks"]["failures"][0]
    assert found["baselines"]["not_finite"]["failed"] == 2
    assert found["baselines"]["no_budget"]["failed"] == 2
    assert "not of avtorch.diagnosis/1 or avtorch.diagnosis/2" in found["baselines"]["no_budget"]["failures"][0]


@pytest.mark.slow
def test_two_processes_say_the_same_as_one(tmp_path: Path) -> None:
    guess = {"random_guess": random_guess}
    one = run_trial(4, 4, tmp_path / "one", answerers=guess, signals=("accel",), **SHORT)
    two = run_trial(4, 4, tmp_path / "two", answerers=guess, workers=2, signals=("accel",), **SHORT)
    times = ("seconds_per_case", "cpu_seconds_per_case", "intervals")
    assert {k: v for k, v in two.items() if k not in times} == {k: v for k, v in one.items() if k not in times}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"n": 0}, "n: found 0"),
        ({"workers": 0}, "workers: found 0"),
        ({"answerers": {}}, "answerers: found none"),
        ({"answerers": {"../up": random_guess}}, "answerers: found the name"),
        ({"signals": ("jerk",)}, "signals: found"),
    ],
)
def test_bad_arguments_are_refused(change: dict, told: str, tmp_path: Path) -> None:
    given = {"n": 1, "seed": 0, "out": tmp_path / "out", "answerers": {"guess": random_guess}} | change
    with pytest.raises(InputError, match=told):
        run_trial(**given)
    assert not (tmp_path / "out").exists()


# `python -m benchmarks.blindtest`: its files, how it goes on, and one line for whatever it cannot use.
@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """In place of the diagnosis one that answers `none` at once; the list names the cases it was given."""
    asked: list[str] = []

    def says_none(log: Log) -> dict[str, Any]:
        asked.append(log.name)
        return reply(log, {"none": 1.0}, why="always")

    monkeypatch.setattr(command, "avtorch", says_none)
    return asked


@pytest.mark.slow
def test_writes_answer_and_picture_and_goes_on(
    quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep/er"
    line = ["--seed", "3", "--out", str(out), "--rivals", "none", "--mix", "none", "--recorder", "ordinary"]
    command.main([*line, "--n", "2"])
    told = " ".join(capsys.readouterr().out.split())
    assert {"blindtest.json", "confusion.png", "trial.json", "truth", "answers"} == {p.name for p in out.iterdir()}
    answer = json.loads((out / "blindtest.json").read_text(encoding="utf-8"))
    assert "2 cases: " in told
    needed = answer["needed"]["false_alarm"]
    assert f"Too few cases for intervals of ± 5 points, which take {needed} none (of 2)" in told
    truth = json.loads((out / "truth" / "case_00000.json").read_text(encoding="utf-8"))
    assert 0.02 <= truth["recorder"]["speed_lag_s"] <= 0.08
    command.main([*line, "--n", "3"])
    answer = json.loads((out / "blindtest.json").read_text(encoding="utf-8"))
    assert (answer["cases"], answer["mix"], answer["draw"]) == (3, {"none": 1.0}, {"recorder": "ordinary"})
    assert list(answer["baselines"]) == ["random_guess"]
    assert quick == [f"case_{i:05d}" for i in range(3)]
    with pytest.raises(InputError, match="holds a trial with draw"):
        command.main(["--n", "3", *line[:-2]])


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (["--n", "1", "--mix", "none=0.5,several=0.4"], "--mix: found 'none=0.5,several=0.4'"),
        (["--n", "1", "--mix", "none=0.5,none=0.5"], "--mix: found 'none=0.5,none=0.5'"),
        (["--n", "1", "--mix", "none=x"], "--mix: found 'none=x'"),
        ([], "required: --n"),
    ],
)
def test_what_is_wrong_is_refused(line: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        command.main([*line, "--seed", "1"])
    assert end.value.code == 2
    assert told in capsys.readouterr().err


# The rivals do what a careful engineer would: strong causes are named, a plain drive mostly is not accused.
def drive_of(effects: dict, seed: int, *, seconds: float = 60.0, rate_hz: int = 25, manoeuvre: str = "steps") -> Log:
    drive = DrivePlan(manoeuvre, seconds, rate_hz, seed)  # type: ignore[arg-type]
    run = simulate(Car(), drive.pilot(), seconds=seconds, rate_hz=rate_hz, effects=effects, seed=seed)
    return Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)


def needs_pysindy() -> None:
    # importing it warns; the rival's own import keeps that quiet
    if find_spec("pysindy") is None:
        pytest.skip("PySINDy, of the extra bench, is not installed")


STRONG = {
    "dead_time": {"delay_s": 0.3},
    "sensor_scale": {"scale": 1.25},
    "outliers": {"fraction": 0.03, "scale": 9.0},
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", STRONG)
def test_maximum_likelihood_names_a_strong_cause(name: str, rotating_seed: int) -> None:
    answer = likelihood_bic(drive_of({name: STRONG[name]}, rotating_seed))
    # a second, spurious effect may come with it
    assert name in answer["verdict"]["names"]
    single = next(e for e in answer["effects"] if name in e["name"].split("+"))
    assert single["log_evidence"] > 20


@pytest.mark.statistical
def test_fit_of_a_plain_car_is_where_it_should_be(rotating_seed: int) -> None:
    log = drive_of({}, rotating_seed, seconds=300.0, manoeuvre="following", rate_hz=40)
    fit = Fitter(Residuals.of(log, rate_hz=log.rate_hz)).fit()
    values = fit.values()
    car = Car()
    assert abs(values["T_L"][0] - car.T_L) < BAR * values["T_L"][1] + 0.005
    assert abs(values["K_L"][0] - car.K_L) < BAR * values["K_L"][1] + 0.005
    assert np.sqrt(fit.sizes) == pytest.approx([car.process_sd, car.accel_sd, car.speed_sd], rel=0.35)


@pytest.mark.slow
@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize("signals", [("accel", "speed"), ("accel",), ("speed",)])
def test_answers_are_of_the_schema(name: str, signals: tuple[str, ...]) -> None:
    if name == "sparse_regression":
        needs_pysindy()
    case = draw_case(0, 11, seconds=60.0)
    answer = RIVALS[name](case.log(signals=signals))
    told = read_answer(case.truth(), answer)
    assert answer["schema"] == "avtorch.diagnosis/1"
    assert told.verdict in told.alias_set
    assert told.probabilities[told.verdict] == max(told.probabilities.values())
    assert answer["verdict"]["abstained"] == (told.verdict == "unknown")
    assert all(q["q05"] <= q["mean"] <= q["q95"] for e in answer["effects"] for q in e["parameters"].values())


@pytest.mark.slow
@pytest.mark.statistical
def test_black_box_sees_that_something_is_amiss_and_no_more(rotating_seed: int) -> None:
    plain = black_box(drive_of({}, rotating_seed, seconds=300.0))
    late = black_box(drive_of({"dead_time": {"delay_s": 0.4}}, rotating_seed, seconds=300.0))
    assert late["verdict"]["names"] == ["unknown"]
    assert late["gap"]["p_value"] < 1e-4 < plain["gap"]["p_value"]


@pytest.mark.statistical
def test_sparse_regression_names_a_long_delay(rotating_seed: int) -> None:
    needs_pysindy()
    answer = sparse_regression(drive_of({"dead_time": {"delay_s": 0.4}}, rotating_seed, seconds=300.0))
    assert answer["verdict"]["names"] == ["dead_time"]


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pysindy", None)
    with pytest.raises(InputError, match=r"avtorch\[bench\]"):
        sparse_regression(drive_of({}, 1))
    with pytest.raises(InputError, match=r"avtorch\[bench\]"):
        rivals("sparse_regression")


def test_rivals_by_name() -> None:
    assert list(rivals("none")) == ["random_guess"]
    assert list(rivals("black_box,likelihood_bic")) == ["likelihood_bic", "black_box", "random_guess"]
    with pytest.raises(InputError, match="rivals: found 'oracle'"):
        rivals("oracle")


# The confusion matrix shows every case once, in the right cell.
COUNTS = {
    "none": {"none": 9, "gust": 1},
    "unknown": {"unknown": 3, "aerodynamic_drag": 2},
    "sensor_lag": {"sensor_lag": 4, "dead_time+sensor_lag": 1},
    "dead_time+gust": {"dead_time+gust": 5, "dead_time+sensor_lag": 2, "failed": 1},
    "aerodynamic_drag+gust": {"aerodynamic_drag": 2},
    "dead_time+gust+sensor_lag": {"dead_time+gust+sensor_lag": 1, "dead_time+gust": 1},
}


def cells(ax) -> dict[tuple[str, str], int]:
    rows = [t.get_text().rsplit("  (", 1)[0] for t in ax.get_yticklabels()]
    columns = [t.get_text() for t in ax.get_xticklabels()]
    return {
        (rows[round(t.get_position()[1])], columns[round(t.get_position()[0])]): int(t.get_text()) for t in ax.texts
    }


def test_every_case_is_drawn_once_and_sets_are_put_together() -> None:
    ax = Figure().subplots()
    assert confusion(ax, COUNTS) is ax
    assert cells(ax) == {
        ("none", "none"): 9,
        ("none", "gust"): 1,
        ("outside the table", "outside the table"): 3,
        ("outside the table", "aerodynamic drag"): 2,
        ("sensor lag", "sensor lag"): 4,
        ("sensor lag", "other causes"): 1,
        ("several causes", "several causes"): 6,
        ("several causes", "other causes"): 3,
        ("several causes", "no answer"): 1,
        ("several causes", "aerodynamic drag"): 2,
    }
    assert [t.get_text() for t in ax.get_yticklabels()] == [
        "none  (10)", "sensor lag  (5)", "several causes  (12)", "outside the table  (5)"
    ]  # fmt: skip


def test_figure_and_nothing_to_draw() -> None:
    figure = confusion_figure({"confusion": COUNTS, "cases": 32, "answerer": "avtorch", "signals": ["accel"]})
    assert "22 of 32" in figure.axes[0].get_title(loc="left")
    # the narrowest there is: nothing is cut off at the edge
    few = {"confusion": {"none": {"none": 1}}, "cases": 1, "answerer": "avtorch", "signals": ["accel", "speed"]}
    small = confusion_figure(few)
    small.draw_without_rendering()
    title = small.axes[0]._left_title  # type: ignore[attr-defined]
    assert title.get_window_extent().x1 <= small.bbox.x1
    with pytest.raises(InputError, match="counts: found no case"):
        confusion(Figure().subplots(), {})
