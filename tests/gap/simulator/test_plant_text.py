"""Plants in text from others: each value is in its domain, or one line names the one that is not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import avtorch.gap as gap
from avtorch.cli.simulators import read_simulator
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Effect, GapPlant, plant
from avtorch.gap.simulator.parameter import Domain

WRONG = {
    "infinite": ("dead_time=inf", "dead_time.delay_s is inf, needs a number (5e-08 to 500 s), or 0"),
    "nan": ("dead_time=nan", "dead_time.delay_s is nan"),
    "far": ("dead_time=1e308", "dead_time.delay_s is 1e+308"),
    "overflow": ("dead_time=1e999", "dead_time.delay_s is inf"),
    "digits": ("dead_time=" + 4000 * "9", "dead_time.delay_s is inf"),
    "whole": ("T_L = " + 4000 * "9" + "\n", "T_L is inf, needs a number (0.0001 to 1000 s)"),
    "wide_digit": ("dead_time=１", "found 'dead_time=１', needs effects, each once, with numbers, as dead_time=0.2"),
    "twice": (
        "dead_time=0.1,dead_time=0.2",
        "found 'dead_time=0.1,dead_time=0.2', needs effects, each once",
    ),
    "effect_twice": ("gust,gust", "found 'gust,gust', needs effects, each once"),
    "no_parameter": ("dead_time.=1", "found 'dead_time.=1', needs effects"),
    "true": ("[dead_time]\ndelay_s = true\n", "dead_time.delay_s: found True, needs a number"),
    "true_lag": ("T_L = true\n", "T_L: found True, needs a number"),
    "table": ("T_L = {a = 1}\n", "T_L: found {'a': 1}, needs a number"),
    "tables": ("[[dead_time]]\n", "dead_time.delay_s: found [{}], needs a number"),
    "list": ("[dead_time]\ndelay_s = [0.1, 0.2]\n", "dead_time.delay_s: found [0.1, 0.2], needs a number"),
    "no_knot": ("[road_grade]\nknot_m = 0\n", "road_grade.knot_m is 0, needs a number (10 to 10000 m)"),
    "knots": ("[road_grade]\nknots = 1000000000\n", "needs a whole number (4 to 4096)"),
    "half_knot": ("[road_grade]\nknots = 8.5\n", "needs a whole number (4 to 4096)"),
    "short": ("[road_grade]\nprofile = [1, 2]\n", "a list of 2 values, needs a list of 4 to 4096 numbers"),
    "long": ("[road_grade]\nprofile = [" + "1," * 5000 + "]\n", "a list of 5000 values"),
    "nested": ("[road_grade]\nprofile = [[1], 2, 3, 4]\n", "road_grade.profile[0]: found [1], needs a number"),
    "in_list": ("[road_grade]\nprofile = [1, 2, nan, 4]\n", "road_grade.profile[2] is nan"),
    "no_list": ("[road_grade]\nprofile = 1\n", "road_grade.profile: found 1, needs a list of 4 to 4096 numbers"),
    "falling": ("[gear_shift]\nspeeds = [7, 4]\n", "gear_shift.speeds: found [7, 4], needs numbers that rise"),
    "effect": ("dead_tim=0.2", "found 'dead_tim', needs an effect's name; perhaps dead_time"),
    "no_effect": ("zzz=0.2", "found 'zzz', needs one of aerodynamic_drag, "),
    "negative": ("T_L=-1", "T_L is -1, needs a number (0.0001 to 1000 s)"),
    "unknown": ("[dead_time]\nlag = 1\n", "dead_time: found 'lag', needs one of delay_s"),
    "text": ("[dead_time]\ndelay_s = '" + 5000 * "x" + "'\n", "dead_time.delay_s: found 'xxx"),
    "steered": ('[dead_time]\n"\\u001b[2J" = 1\n', r"dead_time: found '\x1b[2J'"),
    "syntax": ("T_L = 0.3\n[dead_time\n", "plant: line 2, column 11: is no readable TOML"),
    "deep": ("a = " + 5000 * "[" + "\n", "nested too deeply"),
    "dots": (20_000 * "a." + "a = 1\n", "more than 64 dots"),
    "huge": ("#" + 1_000_000 * " " + "\n", "needs 1,000,000 at most"),
    "long_name": (9000 * "x" + "=1", "(8960 more characters)"),
}


def said(text: str) -> str:
    with pytest.raises(InputError) as fault:
        GapPlant.from_toml(text)
    line = str(fault.value)
    assert line.isprintable()
    assert len(line) < 500
    return line


@pytest.mark.parametrize("case", WRONG)
def test_wrong_text_is_one_line(case: str) -> None:
    text, what = WRONG[case]
    assert what in said(text)


@pytest.mark.parametrize("cls", EFFECTS.values(), ids=list(EFFECTS))
@pytest.mark.parametrize("value", ["nan", "true", "[0.1]", "'0.1'", "{}", "-1e13", "1e13", "1979-05-27"])
def test_no_field_of_any_effect_takes_it(cls: type[Effect], value: str) -> None:
    for name in cls.domains():
        if name in ("profile", "speeds") and value == "[0.1]":
            continue  # a list is right there; its length is refused elsewhere
        assert f"{cls.name}.{name}" in said(f"[{cls.name}]\n{name} = {value}\n")


def test_infinity_is_read_only_where_it_means_no_limit() -> None:
    taken = {
        f"{cls.name}.{name}"
        for cls in EFFECTS.values()
        for name in cls.domains()
        if name not in ("profile", "speeds") and any(_is_read(f"[{cls.name}]\n{name} = {x}\n") for x in ("inf", "-inf"))
    }
    assert taken == {"saturation.accel_max_mps2", "saturation.accel_min_mps2", "rate_limit.jerk_max_mps3"}


def _is_read(text: str) -> bool:
    try:
        GapPlant.from_toml(text)
    except InputError:
        return False
    return True


@pytest.mark.parametrize("cls", EFFECTS.values(), ids=list(EFFECTS))
def test_draws_of_every_prior_come_back_from_text(cls: type[Effect], fresh_seed: int) -> None:
    """A thousand typical ranges are wide enough for whatever a fit finds: draws of the prior, and six of its SDs."""
    generator = torch.Generator().manual_seed(fresh_seed)
    for _ in range(20):
        values = {p.name: p.sample(generator=generator) for p in cls.parameters if p.name != "change_s"}
        car = plant([cls().replaced(values)])
        again = GapPlant.from_toml(car.to_toml())
        assert again.to_toml() == car.to_toml()
        for name, value in car.values().items():
            assert torch.equal(again.values()[name], value), name
    for z in (-6.0, 6.0):
        values = {p.name: p.constrain(torch.full(p.typical().shape, z)) for p in cls.parameters}
        car = plant([cls().replaced({k: v.double() for k, v in values.items() if k != "change_s"})])
        assert GapPlant.from_toml(car.to_toml()).to_toml() == car.to_toml()


def test_text_is_written_as_toml_or_not_at_all() -> None:
    assert "delay_s = 1.0\n" in plant([gap.DeadTime(True)]).to_toml()
    with pytest.raises(InputError, match=r"dead_time\.delay_s: found nan"):
        plant([gap.DeadTime(float("nan"))]).to_toml()


def test_a_plant_is_a_regular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    for path, what in (
        (tmp_path / "pipe.toml", "is no regular file"),
        (Path("/dev/zero"), "is no regular file"),
        (tmp_path, "is a directory"),
        (Path("a\0.toml"), "no such file"),
        (Path(300 * "x" + ".toml"), "no such file"),
        (Path("/etc/passwd"), "line 1, column"),
    ):
        with pytest.raises(InputError) as fault:
            plant(baseline=path)
        assert what in str(fault.value)
        assert str(fault.value).isprintable()
        assert "root:x" not in str(fault.value)
    with pytest.raises(InputError, match="is no regular file"):
        read_simulator("--baseline", str(tmp_path / "pipe.toml"))


def test_the_command_line_reports_it_in_one_line(tmp_path: Path, refused: Callable[[list[str]], str]) -> None:
    for baseline in ("dead_time=inf", "\x1b[2J=1", str(tmp_path), "[[", "road_grade.knot_m=0", 50_000 * "a"):
        command = ["diagnose", "absent.csv", "--baseline", baseline, "--out", str(tmp_path / "out")]
        assert len(refused(command)) < 700


def test_a_domain_of_a_parameter_holds_its_typical_range() -> None:
    for cls in EFFECTS.values():
        for parameter in cls.parameters:
            domain = Domain.of(parameter)
            for value in (parameter.low, parameter.high):
                assert domain.value(parameter.name, value) == value
