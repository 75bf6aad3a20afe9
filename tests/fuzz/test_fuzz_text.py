"""Damaged TOML and odd options: refused in one printable line, or read as written."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from avtorch.cli.arguments import accepted_pair, limits_pair, three_gains
from avtorch.gap import EFFECTS, GapPlant, plant
from avtorch.io import Log
from avtorch.io.mapping import read_mapping

from .mutations import AWKWARD, fuzzed, mutated, outcome
from .test_fuzz_readers import COLUMNS, text

MAPPINGS = [
    b'[map]\naccel = "a b"\n[unit]\nspeed = "km/h"\naccel = "g"\n',
    b'[unit]\nspeed = 0.5\naccel = "-1"\n[stamp]\nspeed = "own"\n',
    b'map = {accel = "ACC"}\n[state]\nengaged = "1, 3"\n',
    b"# nothing\n",
]
UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 1609.344 / 3600, "g": 9.80665}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("fuzz")
    accel = COLUMNS["accel"]
    more = {"a b": accel, "ACC": accel, "own": COLUMNS["time"]}
    (made / "lap.csv").write_bytes(text(COLUMNS | more))
    return made


@fuzzed("mapping")
@given(raw=mutated(MAPPINGS))
def test_damaged_mapping(folder: Path, raw: bytes) -> None:
    (folder / "lap.toml").write_bytes(raw)
    mapping = outcome(lambda: read_mapping(folder / "lap.csv"))
    log = outcome(lambda: Log.read(folder / "lap.csv"))
    if log is None:
        return
    assert mapping is not None
    told = tomllib.loads(raw.decode("utf-8-sig"))
    assert mapping.column == {k: str(v) for k, v in told.get("map", {}).items()}
    assert mapping.unit == {k: str(v).strip() for k, v in told.get("unit", {}).items()} or "unit" in told
    unit = str(told.get("unit", {}).get("speed", "1")).strip()
    factor = UNITS[unit] if unit in UNITS else _number(unit)
    if factor is not None and "speed" not in mapping.column and log.speed is not None and log.rows == 24:
        assert log.speed == pytest.approx(np.array(COLUMNS["speed"]) * factor, rel=1e-12)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


PLANTS = [plant([cls()]).to_toml().encode() for cls in EFFECTS.values()]
PLANTS += [plant([cls() for cls in EFFECTS.values()]).to_toml().encode(), plant().to_toml().encode()]
PLANTS.append(b"[road_grade]\ngrade_rms = 0.03\nprofile = [0.1, -0.2, 0.3, 0.4, 0.5]\nknots = 5\nknot_m = 80.0\n")
PLANTS.append(b"T_L = 0.5\ndead_time = 0.2\n[gear_shift]\nspeeds = [4.0, 7.5]\n")

PLANTS.append(b"T_L = 0.5\nK_L = " + 1200 * b"[" + b"\n")


@fuzzed("plant")
@given(raw=mutated(PLANTS))
def test_damaged_plant(folder: Path, raw: bytes) -> None:
    path = folder / "plant.toml"
    path.write_bytes(raw)
    car = outcome(lambda: plant(baseline=path))
    if car is None:
        return
    check_plant(car)
    told = tomllib.loads(raw.decode("utf-8-sig"))
    fields = {name: value for name, value in told.items() if not isinstance(value, dict)}
    effects = {effect.name: effect for effect in car.effects}
    assert set(effects) == set(told) - {"T_L", "K_L", "sigma"}
    if "damping_ratio" not in told.get("second_order_actuator", {}):
        assert all(getattr(car, name) == fields[name] for name in ("T_L", "K_L", "sigma") if name in fields)
    for name, table in told.items():
        for key, value in table.items() if isinstance(table, dict) else ():
            if not isinstance(value, list) and key not in ("damping_ratio", "natural_frequency_radps"):
                assert getattr(effects[name], key) == value, (name, key)


def check_plant(car: GapPlant) -> None:
    """It holds finite numbers or states that there is no limit; its own text is TOML and restores it."""
    again = GapPlant.from_toml(car.to_toml())
    assert again.to_toml() == car.to_toml()
    for name, value in car.values().items():
        assert bool(value.isfinite().all()) or name.startswith(("saturation.", "rate_limit.")), name


_ODD = st.sampled_from([x.decode("latin-1") for x in AWKWARD]) | st.text(max_size=6)
NAMES = [*EFFECTS, "T_L", "K_L", "sigma", "glvd", "dead_time.delay_s", "road_grade.knot_m", "gust.sd_mps2"]
WORDS = st.sampled_from(NAMES) | _ODD
NUMBERS = st.one_of(st.floats().map(repr), st.integers().map(str), st.floats(0, 3).map(repr), _ODD)
ITEMS = st.one_of(WORDS, st.tuples(WORDS, NUMBERS).map("=".join), st.tuples(WORDS, NUMBERS).map(" = ".join))


@fuzzed("words")
@given(words=st.lists(ITEMS, max_size=4))
def test_odd_words_for_a_plant(words: list[str]) -> None:
    said = ",".join(words)
    car = outcome(lambda: GapPlant.from_toml(said))
    if car is not None:
        check_plant(car)
        assert len(car.effects) <= len(words) or "[" in said or "\n" in said


OPTIONS = [three_gains, accepted_pair, limits_pair]


PAIRS = st.tuples(st.sampled_from(["speed", "accel", "time", "x"]) | _ODD, NUMBERS).map("=".join)


@fuzzed("options")
@given(
    numbers=st.lists(NUMBERS, max_size=4).map(",".join),
    option=st.sampled_from(OPTIONS),
    pairs=st.lists(PAIRS, max_size=2),
    name=st.sampled_from(["map", "unit", "stamp"]),
)
def test_odd_options(folder: Path, numbers: str, option: Callable, pairs: list[str], name: str) -> None:
    values = outcome(lambda: option(numbers))
    if values is not None:
        assert all(map(math.isfinite, values))
        assert list(values) == [float(x) for x in numbers.split(",")]
    (folder / "plain.csv").write_bytes(text(COLUMNS))
    assume(not any("\0" in x for x in pairs))
    log = outcome(lambda: Log.read(folder / "plain.csv", **{name: pairs}))
    assert log is None or log.rows <= 24
