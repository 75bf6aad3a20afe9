"""Parts without a name stand beside those with one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from avtorch.gap.engine.average import ModelAverage
from avtorch.gap.engine.family import FORMS
from avtorch.gap.engine.roughness import SIGNS
from avtorch.gap.result.hypotheses import parts_of, said_of_unnamed


def average(parts: dict[str, float]) -> ModelAverage:
    return ModelAverage({"none": 1.0}, {}, (), {}, parts)


def posterior() -> Any:
    plain = SimpleNamespace(force=None)
    return cast(Any, SimpleNamespace(weight=SimpleNamespace(examined=SimpleNamespace(hypothesis=plain))))


def test_free_forms_are_parts_the_likeliest_first() -> None:
    found = parts_of(average({"gain": 0.2, "delay": 0.7}), ("unknown",), posterior())
    assert [(p.name, p.form, p.family, p.probability) for p in found] == [
        (None, "delay", "time", 0.7),
        (None, "gain", "time", 0.2),
    ]
    assert "a delay that wanders" in said_of_unnamed(found)


def test_what_is_unlikely_is_not_said() -> None:
    assert said_of_unnamed(parts_of(average({"gain": 0.2}), ("none",), posterior())) == ""


def test_every_free_form_has_a_family() -> None:
    for form in ("linear", "sided", "cycle", "sensor", "map", "gain", "braking", "delay", *SIGNS):
        assert FORMS[form]
