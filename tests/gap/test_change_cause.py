"""The cause of a change: what is named between two drives of one car or of two, and the form of the answer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

import avtorch
from avtorch.errors import InputError
from avtorch.gap import ConstantResistance, DeadTime, Effect, SensorBias, plant
from avtorch.gap.engine.coordinates import EFFECTS
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.joint import JointModel, block_scores, of_car, of_effect, of_growth
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.recorder import base_fit
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.comparison import (
    ChangeCause,
    ChangePart,
    Comparison,
    _of_effect,
    cause_of_change,
    detectable_text,
)
from avtorch.gap.result.log_facts import LogFacts
from avtorch.io import Log
from avtorch.report.comparison import comparison_html, comparison_tables
from benchmarks.blindtest import DrivePlan, draw_car, simulate
from tests.bars import LEVEL, student
from tests.gap.cars import log_of

KINDS: list[type[Effect]] = [ConstantResistance, SensorBias]
T_L, K_L = 0.35, 0.95
SECONDS = 60.0
BLOCKS = 12  # of either side, in such drives


@dataclass(frozen=True)
class Case:
    """What the car after has of its own, and where its size stands in the answer."""

    name: str
    key: str
    size: float
    effects: Sequence[Effect] = ()
    gain: float = K_L


CASES = {
    "bias": Case("sensor_bias", "bias_mps2", 0.3, [SensorBias(0.3)]),
    "resistance": Case("constant_resistance", "resistance_mps2", 0.4, [ConstantResistance(0.4)]),
    "gain": Case("K_L", "change", -0.25, gain=0.7),
    "delay": Case("dead_time", "change_s", 0.25, [DeadTime(0.25)]),
}


def _cause(before: Log, after: Log) -> ChangeCause:
    return cause_of_change(_model(before, after), KINDS)


def _model(before: Log, after: Log) -> JointModel:
    return JointModel.of(DriveData.of([before, after]), 1, plant([]))


@pytest.fixture(scope="module")
def model() -> JointModel:
    """Of two drives of one car."""
    return _model(*(log_of(seconds=60.0, seed=seed) for seed in (1, 2)))


def _pair(case: Case, seed: int, both: Sequence[Effect] = ()) -> tuple[Log, Log]:
    rng = np.random.default_rng(seed)
    one, two = (int(x) for x in rng.integers(2**31, size=2))
    before = log_of(both, seconds=SECONDS, seed=one, T_L=T_L, K_L=K_L)
    return before, log_of([*both, *case.effects], seconds=SECONDS, seed=two, T_L=T_L, K_L=case.gain)


@pytest.mark.statistical
@pytest.mark.parametrize(
    "which", ["gain", *(pytest.param(x, marks=pytest.mark.slow) for x in ("bias", "resistance", "delay"))]
)
def test_a_change_is_named_with_its_size(which: str, rotating_seed: int) -> None:
    """Each is larger than one that was named in ten of ten pairs of such drives (docs/simulators.md)."""
    case = CASES[which]
    found = _cause(*_pair(case, rotating_seed))
    assert found.answer in ("named", "ambiguous")
    assert found.names == (case.name,)
    size = found.parts[0].parameters[case.key]
    assert abs(size.mean - case.size) < student(BLOCKS - 1) * size.sd
    assert size.q05 < size.mean < size.q95
    if case.name == "K_L":
        for key, truth in (("before", K_L), ("after", case.gain)):
            side = found.parts[0].parameters[key]
            assert abs(side.mean - truth) < student(BLOCKS - 1) * side.sd
    assert found.probability is not None
    assert found.probability > 0.5
    assert case.name in found.why


@pytest.mark.slow
@pytest.mark.statistical
def test_one_car_names_no_cause(rotating_seed: int) -> None:
    """One in ten at most may name a cause, or find something unexplained: measured less often (docs/simulators.md)."""
    pairs = 12
    seeds = np.random.default_rng(rotating_seed).integers(2**31, size=(pairs, 2)).tolist()
    found = [_cause(*(log_of(seconds=60.0, seed=seed) for seed in two)) for two in seeds]
    alarms = sum(cause.answer != "none" for cause in found)
    assert binom.sf(alarms - 1, pairs, 0.1) > LEVEL
    for cause in found:
        # 4 standard errors over blocks: the drives are of one kind, and none of them is blind to a gain
        assert 0 < cause.detectable["K_L"] < 1


@pytest.mark.slow
@pytest.mark.statistical
def test_what_both_drives_have_is_no_change(rotating_seed: int) -> None:
    """A resistance before and after alike, and a gain that drops between: the gain alone is named."""
    found = _cause(*_pair(CASES["gain"], rotating_seed, both=[ConstantResistance(0.3)]))
    assert found.names == ("K_L",)


@pytest.mark.slow
@pytest.mark.statistical
def test_what_is_gone_has_the_opposite_sign(rotating_seed: int) -> None:
    after, before = _pair(CASES["resistance"], rotating_seed)
    (part,) = _cause(before, after).parts
    assert part.name == "constant_resistance"
    assert part.less
    size = part.parameters["resistance_mps2"]
    assert abs(size.mean + 0.4) < student(BLOCKS - 1) * size.sd
    assert str(part).startswith("less constant_resistance (resistance -")


def test_both_sides_share_what_has_not_changed(model: JointModel) -> None:
    gain = of_car("K_L")
    x = np.append(model.start.x, -0.3)
    fit = model.at((gain,), x)
    before, after = fit.sides
    assert before["T_L"] == after["T_L"]
    assert before["dead_time"] == after["dead_time"]
    assert after["K_L"] == pytest.approx(before["K_L"] * np.exp(-0.3))
    # the sides are those rows of both drives, in the same coefficients
    rows = model.whole.log == 1
    assert np.array_equal(model.sides[1].command, model.whole.command[rows])
    assert sum(side.frame_count for side in model.sides) == model.whole.frame_count
    same = model.at((gain,), np.append(model.start.x, 0.0))
    assert same.objective == pytest.approx(model.start.objective, abs=1.0)
    assert fit.objective < same.objective - 10


def test_an_effect_of_both_sides_may_be_larger_on_one(model: JointModel) -> None:
    both = of_effect(EFFECTS["dead_band"], ((0.1,),), "both")
    fit = model.at((both,), np.append(model.start.x, 0.1))
    (name,) = (c.name for c in both.coordinates)
    assert [h[name] for h in fit.sides] == [0.1, 0.1]
    more = of_growth(both, np.array([0.1]))
    fit = model.at((both, more), np.append(fit.x, 0.05))
    assert [h[name] for h in fit.sides] == pytest.approx([0.1, 0.15])
    assert [h.effects.count("dead_band") for h in fit.sides] == [1, 1]


def test_scores_of_blocks_add_up_to_the_gradient(model: JointModel) -> None:
    """The transform is orthonormal: what rows of a block say of a coordinate sums to what the coefficients say."""
    fit = model.start
    for k, h in enumerate(fit.sides):
        left = model.left(fit, h)
        each = block_scores(h, fit.noise[k], fit.derivatives[k], left)
        white = whiten(h.data, fit.noise[k], left)
        whole = [whiten(h.data, fit.noise[k], d) @ white for d in fit.derivatives[k]]
        scale = [np.linalg.norm(whiten(h.data, fit.noise[k], d)) for d in fit.derivatives[k]]
        # rows at the ends of a stretch are under one frame only
        assert each.sum(1) == pytest.approx(whole, abs=1e-6 + 3.0 * max(scale))


# the form of the answer ----------------------------------------------------------------------------------------------
BIAS = ChangePart(
    "sensor_bias", ("sensor_bias", "constant_resistance"), 0.97, {"bias_mps2": Quantity(0.2, 0.01, 0.18, 0.22)}
)
AMBIGUOUS = ChangeCause((BIAS,), "ambiguous", {"T_L": 0.2, "K_L": 0.05, "dead_time": float("inf")}, "Because.")


def test_the_answer_as_json() -> None:
    answer = json.loads(json.dumps(AMBIGUOUS.to_dict(), allow_nan=False))
    assert answer == {
        "answer": "ambiguous",
        "names": ["sensor_bias"],
        "alias_set": ["sensor_bias", "constant_resistance"],
        "probability": 0.97,
        "parameters": {"sensor_bias.bias_mps2": {"mean": 0.2, "sd": 0.01, "q05": 0.18, "q95": 0.22}},
        "parts": [
            {
                "names": ["sensor_bias"],
                "alias_set": ["sensor_bias", "constant_resistance"],
                "probability": 0.97,
                "parameters": {"bias_mps2": {"mean": 0.2, "sd": 0.01, "q05": 0.18, "q95": 0.22}},
                "less": False,
            }
        ],
        "detectable": {"T_L": 0.2, "K_L": 0.05, "dead_time": None},
        "why": "Because.",
    }
    nothing = ChangeCause((), "none", {"T_L": 0.2}, "No change is named.").to_dict()
    assert nothing["names"] == []
    assert nothing["probability"] is None


def test_a_least_change_has_its_unit() -> None:
    assert [detectable_text("K_L", 0.051), detectable_text("dead_time", 0.024)] == ["5%", "0.024 s"]
    assert detectable_text("dead_time", float("inf")) == "none"
    assert detectable_text("K_L", 0.0031) == "0.3%", "no 0%"


def test_the_terminal_has_rows_for_the_cause() -> None:
    facts = LogFacts.of([log_of(seconds=20.0)])
    comparison = Comparison(facts, facts, {}, {}, 0.5, False, "inconclusive", "", cause=AMBIGUOUS)
    named, none = (_text(replace(comparison, cause=c)) for c in (AMBIGUOUS, replace(AMBIGUOUS, parts=())))
    assert "sensor_bias | 0.97" in named
    assert "constant_resistance" in named
    assert "0.2 (0.18 to 0.22)" in named
    assert "least change that would show" in none
    assert "5%" in none
    assert "sensor_bias" not in _text(replace(comparison, cause=None))
    assert comparison.to_dict()["cause"] == AMBIGUOUS.to_dict()
    assert replace(comparison, cause=None).to_dict()["cause"] is None


def test_terminal_and_page_say_what_there_is_less_of() -> None:
    before, after = (LogFacts.of([log_of(seconds=20.0, seed=seed)]) for seed in (1, 2))
    fewer = replace(AMBIGUOUS, parts=(replace(BIAS, less=True),))
    for cause in (fewer, AMBIGUOUS):
        comparison = Comparison(before, after, {}, {}, 0.5, False, "inconclusive", "", cause=cause)
        page = comparison_html(comparison)
        assert ("less sensor_bias" in page) == ("less sensor_bias" in _text(comparison)) == (cause is fewer)
        assert "No change of T_L and K_L is detected" in page


def test_the_heading_of_one_drive_and_two_simulators_is_of_the_simulators() -> None:
    facts = LogFacts.of([log_of(seconds=20.0)])
    page = comparison_html(Comparison(facts, facts, {}, {}, 0.5, False, "closer", "", cause=None))
    assert "The simulator after is closer to the car" in page
    assert "No change of T_L and K_L" not in page


def _text(comparison: Comparison) -> str:
    cells = [cell for t in comparison_tables(comparison) for row in (t.columns, *t.rows) for cell in row]
    return " | ".join(cells)


def test_a_side_too_short_for_a_cause() -> None:
    long, short = log_of(seconds=60.0), log_of(seconds=16.0)
    for sides, name in (((short, long), "before"), ((long, short), "after")):
        with pytest.raises(InputError, match=rf"{name}: found \d frames, needs 3 or more"):
            _model(*sides)


@pytest.mark.slow
@pytest.mark.parametrize(("one", "two"), [("lap1.csv", "lap2.csv"), ("lap2.csv", "lap3.csv")])
def test_two_laps_of_one_car_name_no_cause(one: str, two: str, data_dir: Path) -> None:
    """The car was not changed between laps; every effect of the table is tried."""
    comparison = avtorch.compare(*(Log.read(data_dir / "genesis" / lap) for lap in (one, two)))
    assert comparison.cause is not None
    assert comparison.cause.names == ()
    assert not comparison.changed
    assert "No change is named" in comparison.why or "No cause is named" in comparison.why


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "first", "before", "after"), [(11, 11002, 0.1, 0.1), (21, 5002, 0.25, 0.1)])
def test_a_dead_band_of_both_drives_is_no_change_of_it(seed: int, first: int, before: float, after: float) -> None:
    """Where no name of both sides competed, the first was `hand_over` at 0.99 beside a dead band at 0.93."""
    car = draw_car(np.random.default_rng([seed, 1]))
    logs = []
    for number, width in enumerate((before, after)):
        plan = DrivePlan("following", 120.0, 50, first + number)
        effects = {"dead_band": {"half_width_mps2": width}}
        run = simulate(car, plan.pilot(), seconds=120.0, rate_hz=50, effects=effects, seed=plan.seed)
        logs.append(Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed))
    cause = avtorch.compare(*logs).cause
    assert cause is not None
    if before == after:
        assert cause.names == ()
    else:
        assert cause.names == ("dead_band",)
        size = cause.parts[0].parameters["half_width_mps2"]
        assert size.q05 < after - before < size.q95


@pytest.mark.slow
def test_what_leaves_a_set_costs_what_it_did_to_enter() -> None:
    """Priced by another measure the bias left again, and the search went in a circle."""
    car, plan = draw_car(np.random.default_rng([12, 3])), DrivePlan("steps", 120.0, 50, 12006)
    both = {"speed_dependent_gain": {"gain_slope": -0.3, "reference_speed_mps": 12.0}}
    logs = []
    for number, effects in enumerate((both, {**both, "sensor_bias": {"bias_mps2": 0.1}})):
        one = replace(plan, seed=plan.seed + number)
        run = simulate(car, one.pilot(), seconds=120.0, rate_hz=50, effects=effects, seed=one.seed)
        logs.append(Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed))
    cause = avtorch.compare(*logs).cause
    assert cause is not None
    assert cause.names == ("sensor_bias",)


def test_a_limit_out_of_reach_is_not_reported() -> None:
    h = base_fit(DriveData.of(log_of([])))
    h.effects.append("saturation")
    h["drive_limit"], h["brake_limit"] = 4e-9, 0.6
    assert list(_of_effect(h, of_effect(EFFECTS["saturation"], (), "after"))) == ["accel_min_mps2"]


def test_a_side_has_its_own_rows_of_all_that_has_rows() -> None:
    """`count` was the whole's: the recorder of the side after lost other rows, and held a speed from another one on."""
    before, after = (log_of([], seed=seed) for seed in (1, 2))
    lost = np.ones(after.rows, bool)
    lost[100::40] = False
    assert after.accel_cmd is not None
    own = {"accel_cmd": after.accel_cmd, "accel": after.accel, "speed": after.speed}
    after = Log.from_arrays(time=after.time[lost], **{k: x[lost] for k, x in own.items() if x is not None})
    whole = DriveData.of([before, after])
    rows = {f.name for f in fields(DriveData) if np.shape(getattr(whole, f.name))[:1] == whole.time.shape}
    assert {"count", "command", "position"} <= rows
    for side in JointModel.of(whole, 1, None).sides:
        assert all(len(getattr(side, name)) == len(side.time) for name in rows)
        np.testing.assert_allclose(side.low_pass(side.time - side.time[0], 0.1)[-1], side.time[-1] - side.time[0] - 0.1)
