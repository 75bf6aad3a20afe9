"""What is found of effects by simulation, what they declare of themselves, and which ones a caller may ask for."""

from __future__ import annotations

from collections.abc import Callable

import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Effect, ForceTable, Saturation, SensorBias, plant
from avtorch.gap.simulator.effect import chosen_effects, delay_effect, delay_key
from avtorch.gap.simulator.effect_response import is_gain, is_linear, is_one_sided, push_signs, shown_at
from avtorch.io import Log
from tests.gap.records import log_of

NONLINEAR = {"saturation", "dead_band", "backlash", "rate_limit"}
BENT = ForceTable((0.0, 2.0), (0.0, 30.0), ((0.0, 0.0), (0.0, -1.0)))


@pytest.mark.parametrize(
    ("which", "names"),
    [
        (lambda kind: not is_linear(kind()), NONLINEAR),
        (lambda kind: is_one_sided(kind()), {"saturation", "brake_throttle_asymmetry"}),
        (lambda kind: push_signs(kind) == {-1}, {"aerodynamic_drag", "viscous_drag", "constant_resistance"}),
        (lambda kind: push_signs(kind) == {1}, {"low_speed_creep"}),
        (lambda kind: push_signs(kind) == {-1, 1}, {"gust", "road_grade", "sensor_bias"}),
        (is_gain, {"sensor_scale"}),
        (
            lambda kind: kind.memory,
            {
                *[
                    "gear_shift",
                    "backlash",
                    "dead_time",
                    "hand_over",
                    "sensor_lag",
                    "speed_lag",
                    "command_hold",
                    "gust",
                ],
                "driveline_oscillation",
            },
        ),
        (lambda kind: kind.random, {"gust", "outliers", "command_hold"}),
    ],
)
def test_the_responses_tell_what_effects_are(which: Callable[[type[Effect]], bool], names: set[str]) -> None:
    assert {kind.name for kind in EFFECTS.values() if which(kind)} == names


def test_an_effect_is_judged_as_it_is() -> None:
    assert not is_one_sided(Saturation(2.0, -2.0))
    assert is_one_sided(BENT)
    assert not is_linear(BENT)
    speeds = {name: shown_at(kind()) for name, kind in EFFECTS.items()}
    other = {"aerodynamic_drag": 25.0, "viscous_drag": 25.0, "low_speed_creep": 1.0}
    assert {name: v for name, v in speeds.items() if v != 12.0} == other


@pytest.mark.parametrize("kind", EFFECTS.values(), ids=lambda kind: kind.name)
def test_what_it_declares_is_of_its_own_parameters(kind: type[Effect]) -> None:
    assert {name for name in (kind.own_onset, kind.shift) if name is not None} <= {p.name for p in kind.parameters}


def test_one_effect_stands_for_a_bare_delay() -> None:
    kind = delay_effect()
    assert [k for k in EFFECTS.values() if k.shift is not None] == [kind]
    assert delay_key() in plant([kind]).parameters()


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ("sensor_bias", "effects: found 'sensor_bias', needs a list of names or classes"),
        ("", "effects: found '', needs a list of names or classes"),
        (["sensor_bais"], "effect: found 'sensor_bais', needs an effect's name; perhaps sensor_bias"),
        ([3], "effects: found '3', needs names or classes of effects"),
        ([Log], "effects: found .*, needs names or classes of effects"),
        (["sensor_bias", SensorBias], "effects: found sensor_bias twice, needs each effect once"),
    ],
)
def test_effects_that_are_none(effects: object, message: str) -> None:
    log = log_of(seconds=20.0)
    with pytest.raises(InputError, match=message):
        avtorch.diagnose(log, effects=effects)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        avtorch.compare(log, log, effects=effects)  # type: ignore[arg-type]


def test_effects_by_name_and_by_class() -> None:
    assert chosen_effects(["dead_time", SensorBias]) == [EFFECTS["dead_time"], SensorBias]
    assert chosen_effects(None) == [EFFECTS[name] for name in sorted(EFFECTS)]
