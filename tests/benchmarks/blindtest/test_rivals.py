"""The rivals do what a careful engineer would: strong causes are named, a plain drive mostly is not accused."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest import Car, DrivePlan, draw_case, simulate
from benchmarks.blindtest.answerers import RIVALS, rivals
from benchmarks.blindtest.answers import read_answer
from benchmarks.blindtest.rivals import black_box, likelihood_bic, sparse_regression
from benchmarks.blindtest.rivals.maximum_likelihood import Fitter
from benchmarks.blindtest.rivals.residuals import Residuals
from tests.bars import BAR


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
