"""The file of constants: read whole or refused in one line, and what the answers go by."""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError, asdict
from pathlib import Path
from typing import Any

import pytest

from avtorch.errors import InputError
from avtorch.gap.answer import verdict
from avtorch.gap.selection.calibration import CALIBRATION, PATH, Calibration, document
from avtorch.io import fingerprint


def changed(tmp_path: Path, change: Any) -> Path:
    """A copy of the shipped file after `change` of its content."""
    content = document()
    change(content)
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_every_number_of_the_file_is_a_constant() -> None:
    constants = document()["constants"]
    for group, own in asdict(Calibration.read()).items():
        assert own == {
            name: tuple(e["value"]) if isinstance(e["value"], list) else e["value"]
            for name, e in constants[group].items()
        }
    fitted = {(group, name) for group, own in constants.items() for name, e in own.items() if e["by"] == "fitted"}
    assert {group for group, _ in fitted} == {"odds", "unknown"}
    assert len(fitted) == 13
    assert all(e["unit"] and e["meaning"].endswith(".") for own in constants.values() for e in own.values())


def test_the_file_has_the_provenance_of_its_numbers() -> None:
    origin = document()["provenance"]
    assert {"seed", "cases", "mix", "kinds", "families", "date", "commit", "held_out", "made_by"} <= origin.keys()
    assert sum(origin["kinds"].values()) == origin["cases"]
    assert len(origin["commit"]) == 40


def test_alias_sets_take_their_ratios_from_it() -> None:
    assert CALIBRATION.alias_sets.ratio == verdict.ALIAS_RATIO
    assert CALIBRATION.alias_sets.unknown_ratio == verdict.UNKNOWN_RATIO


def test_constants_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        CALIBRATION.odds.power = 1.0  # pyright: ignore[reportAttributeAccessIssue]
    assert fingerprint(CALIBRATION) == fingerprint(Calibration.read())


def _without(part: str, name: str) -> Any:
    return lambda content: content["constants"][part].pop(name)


def _with(part: str, name: str, value: object) -> Any:
    return lambda content: content["constants"][part][name].update(value=value)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (_without("odds", "power"), "odds: misses power; needs effect, power"),
        (lambda c: c["constants"].pop("unknown"), "constants: misses unknown"),
        (lambda c: c["constants"]["odds"].update(more=c["constants"]["odds"]["unit"]), "has the unknown more"),
        (lambda c: c["constants"]["odds"]["unit"].pop("meaning"), r"odds\.unit: misses meaning"),
        (lambda c: c["constants"]["odds"]["unit"].update(by="guess"), "needs fitted or chosen"),
        (_with("odds", "power", float("nan")), r"odds\.power: found nan, needs a finite number"),
        (_with("odds", "power", "4"), r"odds\.power: found '4', needs a finite number"),
        (_with("odds", "power", True), "needs a finite number"),
        (_with("odds", "power", [4.0]), "needs a finite number"),
        (_with("remainder", "sizes", [1.0, float("inf")]), "needs a list of finite numbers"),
        (_with("remainder", "sizes", []), "needs a list of finite numbers"),
        (_with("remainder", "memory_order", 7.5), "needs a whole number above 0"),
        (lambda c: c.update(schema="avtorch.calibration/2"), "needs 'avtorch.calibration/1'"),
        (lambda c: c.pop("fingerprint"), "misses fingerprint"),
    ],
)
def test_anything_else_is_refused_in_one_line(tmp_path: Path, change: Any, told: str) -> None:
    with pytest.raises(InputError, match=told) as refused:
        Calibration.read(changed(tmp_path, change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("content", [None, b"{", b"[]", b"\xff"])
def test_a_file_that_is_none_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "calibration.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"calibration\.json"):
        Calibration.read(path)


def test_it_lies_in_the_package() -> None:
    import avtorch

    assert PATH.is_relative_to(Path(avtorch.__file__).parent)
