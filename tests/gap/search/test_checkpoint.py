"""Stored fits are accepted only intact and for their own search; a search with them gives the same result bit for
bit."""

from __future__ import annotations

import json
import os
import random
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import avtorch
from avtorch.blindtest import Car, simulate
from avtorch.blindtest.drives import Recorded
from avtorch.errors import InputError
from avtorch.gap import DeadTime, SensorBias, plant
from avtorch.gap.search.checkpoint import SCHEMA, read_fits
from avtorch.gap.search.fitted_work import difference, fitted_work
from avtorch.gap.search.search import Search
from avtorch.gap.search.time_budget import TimeBudget
from avtorch.io import Log, read_sealed, write_sealed
from tests.damage import KINDS, damaged
from tests.gap.records import command_over

ONLY: dict[str, Any] = {"effects": ["sensor_bias", "dead_time"], "pairs": False}
EFFECTS = [SensorBias, DeadTime]


def drive(seed: int, bias: float = 0.25) -> Log:
    """20 s of the reference vehicle at 20 Hz."""
    command = command_over(np.arange(400) / 20)
    run = simulate(
        Car(),
        Recorded(command, start_speed=25.0),
        seconds=20,
        rate_hz=20,
        effects={"sensor_bias": {"bias_mps2": bias}},
        seed=seed,
    )
    return Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)


@pytest.fixture(scope="module")
def log() -> Log:
    return drive(3)


@pytest.fixture(scope="module")
def diagnosed(log: Log, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], bytes]:
    """An answer, and the file of its fits."""
    path = tmp_path_factory.mktemp("fits") / "fits.json"
    answer = avtorch.diagnose(log, checkpoint=path, **ONLY).to_dict()
    return answer, path.read_bytes()


@pytest.fixture
def kept(diagnosed: tuple[dict[str, Any], bytes], tmp_path: Path) -> Path:
    path = tmp_path / "fits.json"
    path.write_bytes(diagnosed[1])
    return path


def work(log: Log) -> dict[str, Any]:
    return fitted_work([log], plant(), EFFECTS, pairs=False)


def refused(path: Path, of: dict[str, Any]) -> str:
    """The one line in which it is."""
    with pytest.raises(InputError) as caught:
        read_fits(path, of)
    told = str(caught.value)
    assert told.startswith(f"{path}: ")
    assert told.isprintable()
    assert "--no-resume" in told
    assert "another folder" in told
    return told


@pytest.mark.slow
def test_a_search_goes_on_to_the_same_answer(log: Log, diagnosed: tuple[dict[str, Any], bytes], kept: Path) -> None:
    """From any of its fits on, and from a search that had taken another way."""
    found = read_sealed(kept, schema=SCHEMA)
    fits = found.content["fits"]
    assert len(fits) >= 2
    for part in (fits[:1], fits[1:], []):
        write_sealed(kept, {"fits": part, "steps": []}, schema=SCHEMA, of=found.of)
        assert avtorch.diagnose(log, checkpoint=kept, **ONLY).to_dict() == diagnosed[0]
    # a fit of the same name that began elsewhere, as under a budget, is none of this search
    strange = [{**fit, "inputs": "0" * 64, "z": [2.0] * len(fit["z"])} for fit in fits]
    write_sealed(kept, {"fits": strange, "steps": []}, schema=SCHEMA, of=found.of)
    assert avtorch.diagnose(log, checkpoint=kept, **ONLY).to_dict() == diagnosed[0]


@pytest.mark.slow
def test_a_spent_budget_is_gone_on_from_to_the_same_answer(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever in the search the time was over."""
    given: dict[str, Any] = {**ONLY, "pairs": True}
    whole = avtorch.diagnose(log, **given).to_dict()
    left = [0]

    def spent(self: TimeBudget) -> bool:
        left[0] -= 1
        self.complete = self.complete and left[0] >= 0
        return left[0] < 0

    for chances in (1, 2, 3):
        path = tmp_path / f"{chances}.json"
        left[0] = chances
        with monkeypatch.context() as patch:
            patch.setattr(TimeBudget, "spent", spent)
            assert not avtorch.diagnose(log, checkpoint=path, **given).complete
        assert avtorch.diagnose(log, checkpoint=path, **given).to_dict() == whole


def test_damaged_files_of_fits_are_refused(
    log: Log, diagnosed: tuple[dict[str, Any], bytes], kept: Path, fresh_seed: int
) -> None:
    """A hundred of them: bits, numbers, ends, pieces, and structure."""
    rng, whole, of = random.Random(fresh_seed), diagnosed[1], work(log)
    fits = read_fits(kept, of)
    for turn in range(100):
        kind = turn % (KINDS + 1)
        if kind < KINDS:
            content = damaged(whole, kind, rng)
        else:  # by hand, as JSON
            text = json.loads(whole)
            entry = rng.choice(text["content"]["fits"])
            entry[rng.choice(sorted(entry))] = rng.choice([None, [], 1e9, "none", {"a": 1}])
            content = json.dumps(text, indent=rng.choice([None, 1])).encode()
        kept.write_bytes(content)
        refused(kept, of)
    kept.write_bytes(whole)
    assert read_fits(kept, of) == fits


FAULTS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no fits": lambda c: c.clear(),
    "more than fits": lambda c: c.update(more=1),
    "fits of another type": lambda c: c.update(fits={"a": 1}),
    "an entry of another type": lambda c: c["fits"].append(3),
    "an entry without noise": lambda c: c["fits"][0].pop("noise"),
    "a name of another type": lambda c: c["fits"][0].update(name=["none"]),
    "an onset before the record": lambda c: c["fits"][0].update(onset=-1),
    "an onset between rows": lambda c: c["fits"][0].update(onset=1.5),
    "a mode that is no list": lambda c: c["fits"][0].update(z=0.1),
    "a mode of words": lambda c: c["fits"][0].update(z=["0.1", "0.2"]),
    "a mode nested": lambda c: c["fits"][0].update(z=[[0.1], [0.2]]),
    "a mode that goes on": lambda c: c["fits"][0].update(z=[0.1] * 1000),
    "a mode of truths": lambda c: c["fits"][0].update(z=[True, False]),
    "a noise it does not know": lambda c: c["fits"][0]["noise"].update(more=1.0),
    "a noise that is missing": lambda c: c["fits"][0]["noise"].pop("accel_sd"),
    "a noise below 0": lambda c: c["fits"][0]["noise"].update(accel_sd=-1.0),
    "a noise without a time constant": lambda c: c["fits"][0]["noise"].update(process_time=0.0),
    "a noise of words": lambda c: c["fits"][0]["noise"].update(accel_sd="1"),
    "no prior": lambda c: c["fits"][0].update(log_prior=None),
}


@pytest.mark.parametrize("change", FAULTS.values(), ids=list(FAULTS))
def test_entries_are_checked_even_with_a_right_checksum(log: Log, kept: Path, change: Callable) -> None:
    found = read_sealed(kept, schema=SCHEMA)
    change(found.content)
    write_sealed(kept, found.content, schema=SCHEMA, of=found.of)
    refused(kept, work(log))


def test_a_mode_of_another_candidate_is_refused(log: Log, kept: Path) -> None:
    found = read_sealed(kept, schema=SCHEMA)
    for change in ({"z": [0.1]}, {"name": "gust"}, {"onset": 7}):
        fits = [{**fit, **change} for fit in found.content["fits"]]
        write_sealed(kept, {"fits": fits, "steps": []}, schema=SCHEMA, of=found.of)
        with pytest.raises(InputError, match=r"fits\.json: the fit of \w+ does not match its recorded start"):
            avtorch.diagnose(log, checkpoint=kept, **ONLY)


def test_fits_of_other_work_are_refused(log: Log, kept: Path) -> None:
    """Copied from another run, or with other settings, in Python as on the command line: said in one line."""
    other = drive(4, bias=0.1)
    for logs, change, told in (
        (other, {}, "was begun with other logs (arrays, 400 rows)"),
        ([log, other], {}, "was begun with other logs"),
        (log, {"effects": ["sensor_bias"]}, "was begun with effects sensor_bias, dead_time"),
        (log, {"pairs": True}, "was begun with pairs False"),
        (log, {"baseline": "dead_time=0.1"}, "was begun with baseline T_L=0.3, K_L=1"),
        (log, {"baseline": "T_L=0.30000001"}, "was begun with another baseline"),
        (log, {"accel_kind": "specific-force"}, "was begun with accel_kind kinematic"),
    ):
        with pytest.raises(InputError) as caught:
            avtorch.diagnose(logs, checkpoint=kept, **{**ONLY, **change})
        assert told in str(caught.value)
        assert str(caught.value).isprintable()
    # one row of one signal is enough
    speed = log.speed.copy()  # type: ignore[union-attr]
    speed[200] = np.nextafter(speed[200], 0)
    assert "other logs" in refused(kept, work(replace(log, speed=speed)))
    # the name of the file is not
    read_fits(kept, work(replace(log, name="renamed.csv")))
    assert "avtorch 9.9, not" in refused_as(kept, log, avtorch="9.9")
    assert "other kinds of settings" in refused_as(kept, log, more=1)


def refused_as(path: Path, log: Log, **of: Any) -> str:
    """For a file whose schema declares it."""
    found = read_sealed(path, schema=SCHEMA)
    write_sealed(path, found.content, schema=SCHEMA, of={**found.of, **of})
    return refused(path, work(log))


@pytest.mark.slow
def test_neither_prior_nor_posterior_nor_seed_belong_to_a_fit(log: Log, kept: Path) -> None:
    """They are taken up again, and the answer is that of a run from the start with the same settings."""
    other: dict[str, Any] = {**ONLY, "prior": {"none": 3.0}, "seed": 7}
    again = avtorch.diagnose(log, checkpoint=kept, **other)
    assert again.to_dict() == avtorch.diagnose(log, **other).to_dict()


def test_an_earlier_avtorchs_fits_are_refused(log: Log, kept: Path) -> None:
    kept.write_text(json.dumps({"fits": []}), encoding="utf-8")
    assert "from an earlier avtorch that wrote no checksum" in refused(kept, work(log))


def test_a_symlink_a_fifo_and_a_large_file_are_refused(log: Log, kept: Path, tmp_path: Path) -> None:
    link, nowhere, fifo, large = (tmp_path / name for name in ("link", "nowhere", "fifo", "large"))
    link.symlink_to(kept)
    nowhere.symlink_to(tmp_path / "missing")
    os.mkfifo(fifo)
    with large.open("wb") as stream:
        stream.truncate(2**40)
    for path, told in (
        (link, "a symbolic link"),
        (nowhere, "a symbolic link"),
        (fifo, "a named pipe"),
        (large, "larger than 16 MiB"),
    ):
        with pytest.raises(InputError, match=rf"{path.name}: is {told}"):
            avtorch.diagnose(log, checkpoint=path, **ONLY)
    assert not (tmp_path / "missing").exists()


TRAILER = """
from dataclasses import dataclass
from typing import ClassVar

from avtorch.gap import Effect, Parameter

@dataclass(frozen=True)
class Trailer(Effect):
    force: float = 0.1
    name: ClassVar[str] = "trailer"
    place: ClassVar = "body"
    meaning: ClassVar[str] = "a trailer pulls"
    equation: ClassVar[str] = "-f"
    parameters: ClassVar = (Parameter("force", "m/s²", 0.0, 0.01, 0.3),)

    def apply(self, x, row):
        return x * 0 - FACTOR * self.force
"""


@pytest.mark.parametrize("typed", [True, False])
def test_an_own_effect_that_was_changed_is_another_one(log: Log, tmp_path: Path, typed: bool) -> None:
    """As its author has it today, in a file or `typed` into an interpreter; fits of the earlier one are not its."""

    def today(turn: int, factor: str) -> dict[str, Any]:
        source, name = TRAILER.replace("FACTOR", factor), f"trailer_{turn}_{typed}"
        path, module = tmp_path / f"{name}.py", ModuleType(name)
        if not typed:
            path.write_text(source, encoding="utf-8")
            module.__file__ = str(path)
        sys.modules[name] = module
        try:
            exec(compile(source, str(path), "exec", dont_inherit=True), vars(module))
            return fitted_work([log], plant(), [SensorBias, module.Trailer], pairs=False)
        finally:
            del sys.modules[name]

    before, same, after = (today(i, factor) for i, factor in enumerate(("1.0", "1.0", "2.0")))
    assert before == same
    assert before["effects"] == after["effects"]
    assert "other code" in str(difference(before, after))


def test_a_search_without_a_file_keeps_none(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Search([log], plant(), effects=[], pairs=False).run()
    assert list(tmp_path.iterdir()) == []
