"""What a person is told of a cause depends on its fitted sign and size; each effect brings a clause of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import pytest

from avtorch.gap import EFFECTS, DeadTime, Effect, register
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import Budget, ChancePart, ChannelError, Part, Unexplained
from avtorch.gap.simulator.effect import cause_words, named_cause


def reported(kind: type[Effect], end: str) -> dict[str, float]:
    return {p.name: getattr(p, end) for p in (kind.derived or kind.parameters) if p.reported}


@pytest.mark.parametrize("kind", EFFECTS.values(), ids=lambda kind: kind.name)
def test_every_effect_brings_a_clause(kind: type[Effect]) -> None:
    low, high = (cause_words(kind.name, reported(kind, end)) for end in ("low", "high"))
    for words in (low, high):
        # a clause within a sentence, beside others that commas part
        assert re.fullmatch(r"[a-z0-9][^,;()_]{14,75}", words), words
        assert words[-1] not in ".:"
    assert kind.name not in low
    assert cause_words(kind.name, {}) == kind.meaning


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("brake_throttle_asymmetry", (0.7, 1.0), "the brake is weaker than the throttle"),
        ("brake_throttle_asymmetry", (1.3, 1.0), "the brake is stronger than the throttle"),
        ("brake_throttle_asymmetry", (0.7, 1.8), "the brake is weaker and slower than the throttle"),
        ("brake_throttle_asymmetry", (1.01, 0.6), "the brake is quicker than the throttle"),
        ("gain_change", (0.65, 20.0), "the gain falls to 65 % during the drive"),
        ("gain_change", (1.4, 20.0), "the gain rises to 140 % during the drive"),
        ("sensor_bias", (0.25,), "the accelerometer reads 0.25 m/s² too high"),
        ("sensor_bias", (-0.25,), "the accelerometer reads 0.25 m/s² too low"),
        ("sensor_scale", (0.8,), "the accelerometer shows 20 % less than the speed: one scale is wrong"),
        ("speed_dependent_gain", (-0.2,), "commands do less the faster the car is"),
        ("speed_dependent_lag", (-0.2,), "the actuator is slower the slower the car is"),
        ("saturation", (1.5, float("-inf")), "the drive gives at most 1.5 m/s²"),
        ("saturation", (float("inf"), -3.0), "the brakes give at most 3 m/s²"),
        ("second_order_actuator", (6.0, 0.3), "the actuator overshoots with a natural frequency of 6 rad/s"),
        ("second_order_actuator", (6.0, 1.5), "the actuator has inertia with a natural frequency of 6 rad/s"),
    ],
)
def test_it_says_which_way_and_how_much(name: str, values: tuple[float, ...], words: str) -> None:
    kind = EFFECTS[name]
    keys = [p.name for p in (kind.derived or kind.parameters) if p.reported]
    assert cause_words(name, dict(zip(keys, values, strict=True))) == words


def test_an_effect_of_a_user_is_called_by_its_name_until_it_brings_words() -> None:
    @dataclass(frozen=True)
    class Silent(Effect):
        name, place, meaning, equation = "silent", "actuator", "something else", "K"
        parameters = DeadTime.parameters

    class Speaking(Silent):
        name = "speaking"

        @classmethod
        def in_words(cls, values: Mapping[str, float]) -> str:
            return f"it comes {values['delay_s']:.1f} s late"

    try:
        register(Silent)
        register(Speaking)
        assert named_cause("silent", {"delay_s": 0.2}, "9 %") == "silent (9 %)"
        assert named_cause("speaking", {"delay_s": 0.2}, "9 %") == "it comes 0.2 s late (speaking, 9 %)"
    finally:
        for name in ("silent", "speaking"):
            EFFECTS.pop(name, None)


def test_a_budget_says_them_with_their_names_behind() -> None:
    def part(name: str, share: float, key: str, value: float, *, plausible: bool = True) -> Part:
        size = Quantity(value, 0.0, value, value)
        return Part(name, (name,), 0.99, Quantity(share, 0.0, share, share), 1.2, {key: size}, plausible=plausible)

    parts = (
        part("dead_time", 0.6, "delay_s", 0.31),
        part("sensor_lag", 0.35, "lag_s", 2.1, plausible=False),
        part("dead_band", 0.01, "half_width_mps2", 0.12),
    )
    gust = {"sd_mps2": Quantity(0.27, 0.0, 0.2, 0.3), "time_constant_s": Quantity(2.0, 0.0, 1.0, 3.0)}
    budget = Budget(
        5.0,
        1.2,
        {"speed": ChannelError(1.0, 0.1, 0.1)},
        parts,
        Unexplained(Quantity(0.04, 0.0, 0.0, 0.1), material=False),
        {},
        (ChancePart("gust", 0.9, parameters=gust),),
    )
    assert str(budget) == (
        "Chiefly commands act 0.31 s late (dead_time, 60 % of the gap), then sensor_lag (35 % of the gap, "
        "physically implausible as fitted); "
        "under 3 %: dead_band; 4 % is reproducible and no known effect explains it."
    )
    gust = "wind and road push the car at random by 0.27 m/s² (gust)"
    assert budget.rest == f"The rest of the error is in part this: {gust}; else noise."
