"""Scores of effects in front of recordings, on verdicts that are made up."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from avtorch.gap.simulator.effect import effect_class
from benchmarks.blindtest.in_front import IN_FRONT
from benchmarks.blindtest.in_front_score import SIZE_OF, Injected, score_in_front
from benchmarks.blindtest.intervals import wilson


def said(*names: str, **parameters: float) -> dict[str, Any]:
    """An answer with these names; a parameter of a set of effects as `effect__parameter`."""
    told = {key.replace("__", "."): {"mean": value} for key, value in parameters.items()}
    entry = {"name": "+".join(sorted(names)), "probability": 0.9, "parameters": told}
    other = {"name": "dead_band", "probability": 0.1, "parameters": {"half_width_mps2": {"mean": 9.0}}}
    return {"verdict": {"names": list(names)}, "effects": [other, entry]}


def one(
    effect: str, put_in: dict[str, float], answer: dict | None, control: dict | None = None, size: float = 1.0
) -> Injected:
    return Injected("lap", effect, size, put_in, said("unknown") if control is None else control, answer)


def budgeted(*names: str, interval: float = 0.1, **parameters: float) -> dict[str, Any]:
    """An answer of `avtorch.diagnosis/2`, whose budget tells the parameters; `effects` tells none of them."""
    parts = []
    for name in names:
        own = {key.partition("__")[2]: value for key, value in parameters.items() if key.startswith(f"{name}__")}
        told = {key: {"mean": x, "q05": x - interval, "q95": x + interval} for key, x in own.items()}
        share = {"mean": 1 / len(names), "q05": 0.0, "q95": 1.0}
        parts.append({"names": [name], "alias_set": [name], "probability": 0.9, "share": share, "parameters": told})
    unexplained = {"share": {"mean": 0.0, "q05": 0.0, "q95": 0.0}, "material": False}
    bare = said(*names)
    return bare | {
        "schema": "avtorch.diagnosis/2",
        "verdict": {"names": list(names), "partial": False},
        "budget": {"parts": parts, "chance": [], "unexplained": unexplained},
    }


LATE = {"delay_s": 0.4}


def test_every_effect_in_front_has_a_size_that_both_sides_tell() -> None:
    assert SIZE_OF.keys() == IN_FRONT.keys()
    for effect, (parameter, without, _) in SIZE_OF.items():
        own = {p.name: p for p in effect_class(effect).parameters}
        assert own[parameter].reported, effect
        assert without == own[parameter].neutral, effect


@pytest.mark.parametrize(
    ("names", "held", "extra", "nothing"),
    [
        (("dead_time",), True, (), False),
        (("dead_time", "gust"), True, ("gust",), False),
        (("gust",), False, ("gust",), False),
        (("unknown",), False, (), True),
        (("none",), False, (), True),
        ((), False, (), True),
        (("backlash", "dead_time"), True, (), False),  # the control lacks backlash too
    ],
)
def test_names_are_held_against_injection_and_control(
    names: tuple[str, ...], held: bool, extra: tuple[str, ...], nothing: bool
) -> None:
    trial = one("dead_time", LATE, said(*names), said("backlash"))
    assert (trial.held, trial.extra, trial.nothing_named) == (held, extra, nothing)
    assert not trial.in_control


@pytest.mark.parametrize(("found", "right"), [(0.3, True), (0.29, False), (0.5, True), (0.51, False), (0.4, True)])
def test_a_size_is_right_within_a_quarter(found: float, right: bool) -> None:
    trial = one("dead_time", LATE, said("dead_time", delay_s=found))
    assert trial.size_ratio == pytest.approx(found / 0.4)
    assert trial.size_right is right


def test_sizes_are_on_top_of_the_controls() -> None:
    control = said("dead_time", delay_s=0.2)
    trial = one("dead_time", LATE, said("dead_time", delay_s=0.6), control)
    assert trial.in_control
    assert trial.size_ratio == pytest.approx(1.0)
    weak = one("sensor_scale", {"scale": 1.2}, said("sensor_scale", scale=1.1 * 1.2), said("sensor_scale", scale=1.1))
    assert weak.size_ratio == pytest.approx(1.0)
    rough = one("gust", {"sd_mps2": 0.3}, said("gust", sd_mps2=0.5), said("gust", sd_mps2=0.4))
    assert rough.size_ratio == pytest.approx(1.0)
    calmer = one("gust", {"sd_mps2": 0.3}, said("gust", sd_mps2=0.3), said("gust", sd_mps2=0.4))
    assert calmer.size_ratio == 0.0


def test_a_factor_counts_by_its_distance_from_one() -> None:
    """0.85 is 30 % above a brake's gain of 0.65, yet not half of the loss."""
    put_in = {"brake_gain_ratio": 0.65, "brake_lag_ratio": 1.0}
    half = one("brake_throttle_asymmetry", put_in, said("brake_throttle_asymmetry", brake_gain_ratio=math.sqrt(0.65)))
    assert half.size_ratio == pytest.approx(0.5)
    assert half.size_right is False
    wrong_way = one("gain_change", {"gain_ratio": 0.7, "change_s": 9.0}, said("gain_change", gain_ratio=1 / 0.7))
    assert wrong_way.size_ratio == pytest.approx(-1.0)


def test_sizes_of_a_set_of_effects_and_of_those_untold() -> None:
    pair = one("dead_time", LATE, said("gust", "dead_time", dead_time__delay_s=0.4, gust__sd_mps2=0.1))
    assert pair.size_right is True
    untold = one("dead_time", LATE, said("dead_time"))
    assert (untold.size_ratio, untold.size_right, untold.held) == (None, None, True)
    lost = one("dead_time", LATE, said("dead_time", delay_s=0.4), said("dead_time"))
    assert lost.size_ratio is None  # the control names it and does not tell its size
    wrong = one("dead_time", LATE, said("gust", sd_mps2=0.4))
    assert wrong.size_ratio is None


def test_of_two_limits_the_stricter_one_is_seen() -> None:
    put_in = {"accel_max_mps2": 1.2}
    alone = one("saturation", put_in, said("saturation", accel_max_mps2=1.5))
    assert alone.size_ratio == pytest.approx(1.25)
    assert alone.size_right is True
    weaker = one("saturation", put_in, said("saturation", accel_max_mps2=0.9), said("saturation", accel_max_mps2=0.9))
    assert weaker.size_ratio == pytest.approx(1.0)
    untold = one("saturation", put_in, said("saturation", accel_max_mps2=math.inf))
    assert (untold.size_ratio, untold.covered) == (None, None)


def test_a_budget_tells_sizes_and_their_intervals() -> None:
    three = budgeted("dead_time", "gust", "road_grade", dead_time__delay_s=0.44, gust__sd_mps2=0.1)
    trial = one("dead_time", LATE, three, budgeted("road_grade"))
    assert (trial.held, trial.size_ratio, trial.size_right) == (True, pytest.approx(1.1), True)
    assert trial.extra == ("gust",)
    assert trial.covered is True
    assert one("dead_time", LATE, budgeted("dead_time", dead_time__delay_s=0.44, interval=0.03)).covered is False
    assert one("dead_time", LATE, said("dead_time", delay_s=0.4)).covered is None  # no interval
    had = budgeted("dead_time", dead_time__delay_s=0.2)
    again = one("dead_time", LATE, budgeted("dead_time", dead_time__delay_s=0.6), had)
    assert again.size_ratio == pytest.approx(1.0)
    assert again.covered is None  # the interval is of both together
    found = score_in_front([trial, one("dead_time", LATE, budgeted("dead_time", dead_time__delay_s=0.9)), again])
    assert (found["totals"]["bounded"], found["totals"]["covered"]) == (2, 1)
    assert found["totals"]["shares"]["covered"] == 0.5


def test_counts_and_shares() -> None:
    trials = [
        one("dead_time", LATE, said("dead_time", delay_s=0.41), size=0.5),
        one("dead_time", LATE, said("dead_time", "gust", dead_time__delay_s=0.9), size=0.5),
        one("dead_time", LATE, said("unknown"), size=1.25),
        one("sensor_bias", {"bias_mps2": 0.2}, None, size=0.5),
        one("sensor_bias", {"bias_mps2": 0.2}, said("sensor_bias"), said("sensor_bias"), size=0.5),
    ]
    found = score_in_front(trials)
    keys = ("trials", "held", "in_control", "sized", "size_right", "extra", "nothing_named", "failed")
    assert [(c["effect"], c["size"], *(c[key] for key in keys)) for c in found["table"]] == [
        ("dead_time", 0.5, 2, 2, 0, 2, 1, 1, 0, 0),
        ("dead_time", 1.25, 1, 0, 0, 0, 0, 0, 1, 0),
        ("sensor_bias", 0.5, 2, 1, 1, 0, 0, 0, 0, 1),
    ]
    totals = found["totals"]
    assert [totals[key] for key in keys] == [5, 3, 1, 2, 1, 1, 1, 1]
    shares = {"held": 0.6, "size_right": 0.5, "covered": None, "extra": 0.2, "nothing_named": 0.2}
    assert totals["shares"] == shares
    assert [(one["size"], one["trials"], one["held"]) for one in found["by_size"]] == [(0.5, 4, 3), (1.25, 1, 0)]
    assert found["by_size"][0]["intervals"]["held"] == list(wilson(3, 4) or ())
    assert totals["intervals"]["held"] == list(wilson(3, 5) or ())
    assert totals["intervals"]["size_right"] == list(wilson(1, 2) or ())
    json.dumps([one.to_dict() for one in trials], allow_nan=False)
    nothing = score_in_front([])["totals"]
    assert nothing["shares"]["held"] is None
    assert nothing["intervals"]["held"] is None
