"""The answer of a diagnosis: its numbers, its form, and what is refused."""

from __future__ import annotations

import importlib.util
import json
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.gap import AerodynamicDrag, DeadTime, GapPlant, RoadGrade, Saturation, plant
from avtorch.gap.quantity import Quantity, unit_of, words_of
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.gap_size import GapSize
from avtorch.gap.result.hypotheses import Candidate, candidate_name, listed_candidates
from avtorch.gap.result.log_facts import LogFacts
from avtorch.io import Log
from tests.faulty_disk import visible
from tests.gap.verdicts import verdict_of

ROOT = Path(__file__).resolve().parents[3]
DELAY = {"delay_s": Quantity(0.2, 0.01, 0.18, 0.22)}
LAG = Quantity(0.5, 0.01, 0.48, 0.52)
GAIN = Quantity(1.0, 0.01, 0.98, 1.02)
FACTS = LogFacts(100, 1, 1.0, 100.0)


def candidates(**weights: float) -> tuple[Candidate, ...]:
    """By name, `_and_` for the plus of a pair."""
    return tuple(
        Candidate(name.replace("_and_", "+"), p, None if name == "unknown" else 10 * p) for name, p in weights.items()
    )


def diagnosis(given: tuple[Candidate, ...], **more: object) -> Diagnosis:
    return Diagnosis(
        FACTS,
        {"T_L": LAG, "K_L": GAIN},
        GapSize(True, 1e-6, 0.1, 0.05, 0.2, 0.1, 0.5, 5.0),
        given,
        **{"verdict": verdict_of(given), **more},  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def contract() -> Callable[[dict], list[str]]:
    """The faults that the contract of answers finds; skipped where it does not lie beside the recordings."""
    data = os.environ.get("AVTORCH_DATA")
    beside = ROOT.parent / "shared" if data is None else Path(data).parent
    path = beside / "contract.py"
    if not path.is_file():
        pytest.skip("no contract.py beside the recordings")
    spec = importlib.util.spec_from_file_location("contract", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def faults(answer: dict) -> list[str]:
        check = module.Check()
        module.FORMS["diagnosis"](check, answer)
        return check.faults

    return faults


# --- numbers


def test_quantity_of_draws() -> None:
    draws = np.arange(1001.0).reshape(7, 143)
    q = Quantity.of_draws(draws)
    assert q.mean == 500
    assert q.sd == pytest.approx(draws.std(ddof=1))
    assert (q.q05, q.q95) == (50, 950)
    assert Quantity.of_draws(torch.tensor([2.0])) == Quantity(2.0, 0.0, 2.0, 2.0)


@pytest.mark.parametrize("bad", [(math.nan, 1, 0, 1), (0, -1, 0, 1), (0, 1, 1, 0), (0, math.inf, 0, 1)])
def test_quantity_refuses_what_is_no_number(bad: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="quantity: found"):
        Quantity(*bad)
    with pytest.raises(InputError, match="draws: found none"):
        Quantity.of_draws([])


def test_units_by_the_key() -> None:
    keys = {
        "delay_s": ("s", "delay"),
        "half_width_mps2": ("m/s²", "half width"),
        "jerk_max_mps3": ("m/s³", "jerk max"),
        "natural_frequency_radps": ("rad/s", "natural frequency"),
        "frequency_hz": ("Hz", "frequency"),
        "drag_per_m": ("1/m", "drag"),
        "dead_time.delay_s": ("s", "dead time.delay"),
        "gain_ratio": ("-", "gain ratio"),
        "T_L": ("s", "T_L"),
        "K_L": ("-", "K_L"),
    }
    for key, told in keys.items():
        assert (unit_of(key), words_of(key)) == told
    from avtorch.gap import EFFECTS

    for cls in EFFECTS.values():
        for p in cls.parameters:
            assert unit_of(p.name) == p.unit.replace("sigma", "-"), p.name


# --- candidates and verdict


def test_listed_sums_to_one_and_drops_the_improbable() -> None:
    given = candidates(none=0.0, gust=5e-5, dead_time=0.7, dead_time_and_gust=0.2, unknown=1e-9)
    ranked = listed_candidates(given)
    assert [c.name for c in ranked] == ["dead_time", "dead_time+gust", "unknown", "none"]
    assert math.fsum(c.probability for c in ranked) == 1.0
    assert ranked[0].probability == pytest.approx(0.7 / 0.9)
    assert ranked[0].log_evidence == 7.0


def test_a_pair_has_one_name() -> None:
    assert candidate_name(["gust", "dead_time"]) == candidate_name("gust+dead_time") == "dead_time+gust"
    assert Candidate("dead_time+gust", 0.5).effects == ("dead_time", "gust")
    assert Candidate("none", 0.5).effects == ()


# --- the whole


def test_answer_has_the_form_of_the_contract(contract: Callable[[dict], list[str]]) -> None:
    single = Candidate("dead_time", 0.8, 120.0, DELAY, {"T_L": LAG, "K_L": GAIN}, 12.5)
    pair = Candidate("dead_time+gust", 0.1, 110.0, {"dead_time.delay_s": LAG, "gust.sd_mps2": LAG})
    for top in ("dead_time", "dead_time+gust", "none", "unknown"):
        others = [single, pair, Candidate("none", 0.05, 0.0), Candidate("unknown", 0.05)]
        raised = tuple(c if c.name != top else Candidate(top, 1.0, c.log_evidence, c.parameters) for c in others)
        found = diagnosis(raised, onset_s=12.5, remaining=(single,), notes=("a note",), complete=False)
        answer = json.loads(json.dumps(found.to_dict(), allow_nan=False))
        assert contract(answer) == []
        assert found.winner.name == top
        assert answer["remaining"][0]["parameters"]["delay_s"]["mean"] == 0.2
        assert (answer["complete"], answer["notes"]) == (False, ["a note"])


def test_numbers_that_were_not_measured_are_null() -> None:
    gap = GapSize(False).to_dict()
    assert gap["detected"] is False
    assert gap["p_value"] is None
    assert gap["one_step"] == {"rmse": None, "floor": None}
    assert set(gap["rollout"].values()) == {None}


def test_printed_it_reports_its_result() -> None:
    found = diagnosis(candidates(dead_time=0.8, unknown=0.1, none=0.1), onset_s=12.0, notes=("Mind the gap.",))
    told = str(found).splitlines()
    assert told[0] == (
        "Probably the simulator lacks this (probability 0.80): the command acts after a delay (dead_time)."
    )
    assert found.verdict.why in told
    assert "The gap begins at 12.0 s of the log's time." in told
    assert told[-1] == "Mind the gap."
    assert "dead_time" in repr(found)
    assert "Probably the simulator lacks this" in repr(found).splitlines()[0]
    assert len(repr(found).splitlines()) <= 10


@pytest.mark.parametrize(("name", "said"), [("none", "nothing"), ("unknown", "no cause is named")])
def test_printed_it_names_no_cause_where_nothing_was_measured(name: str, said: str) -> None:
    weights = {"none": 0.05, "unknown": 0.05, "dead_time": 0.1} | {name: 0.85}
    bare = replace(diagnosis(candidates(**weights)), gap=GapSize(name == "unknown"))
    assert said in str(bare).splitlines()[0]
    assert "None" not in str(bare)


def test_written_files_read_back(tmp_path: Path) -> None:
    given = candidates(aerodynamic_drag_and_dead_time=0.8, none=0.15, unknown=0.05)
    repaired = plant([DeadTime(0.21), AerodynamicDrag(4e-4)], T_L=0.31, K_L=0.97)
    folder = tmp_path / "deep" / "er"
    assert [p.name for p in diagnosis(given, plant=repaired).write(folder)] == ["diagnosis.json", "plant.toml"]
    answer = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    assert answer["verdict"]["names"] == ["aerodynamic_drag", "dead_time"]
    read = GapPlant.from_toml((folder / "plant.toml").read_text(encoding="utf-8"))
    assert {name: float(x) for name, x in read.values().items()} == {
        name: float(x) for name, x in repaired.values().items()
    }
    # without a plant, that of an earlier answer does not stay
    assert [p.name for p in diagnosis(given).write(folder)] == ["diagnosis.json"]
    assert [p.name for p in folder.glob("[!.]*")] == ["diagnosis.json"]


def test_an_onset_is_said_from_the_start_and_on_the_clock() -> None:
    """Of a log that counts from 1970: `onset_s` stays on its clock, as the schema has it."""
    of = candidates(dead_time=0.8, unknown=0.1, none=0.1)
    log = replace(FACTS, epochs_s=(1_700_000_000.0,))
    found = replace(diagnosis(of), log=log, onset_s=1_700_000_012.0)
    clock = "1700000012 s, as Unix time 2023-11-14 22:13:32 UTC"
    assert f"The gap begins at 12.0 s from the log's start ({clock})." in str(found).splitlines()
    assert found.to_dict()["onset_s"] == 1_700_000_012.0
    assert found.to_dict()["onset_from_start_s"] == 12.0
    assert found.to_dict()["log"]["epochs_s"] == [1_700_000_000.0]


def test_a_plant_notes_that_a_late_effect_acts_from_the_start(tmp_path: Path) -> None:
    def written(onset_s: float | None, **chances: float) -> str:
        given = candidates(**chances, none=0.15, unknown=0.05)
        diagnosis(given, plant=plant([DeadTime(0.2)]), onset_s=onset_s).write(tmp_path)
        return (tmp_path / "plant.toml").read_text(encoding="utf-8")

    late = written(132.4, aerodynamic_drag_and_dead_time=0.8)
    first, rest = late.split("\n", 1)
    assert first.startswith("# In the log aerodynamic_drag and dead_time from 132.4 s of the log's time on;")
    assert first.endswith(" in this plant from the start.")
    assert rest == plant([DeadTime(0.2)]).to_toml()
    assert GapPlant.from_toml(late).effects == (DeadTime(0.2),)
    assert "#" not in written(None, dead_time=0.8)
    # its moment is a parameter, which the plant has
    assert "#" not in written(132.4, gain_change=0.8)


@pytest.mark.parametrize(
    "effect", [Saturation(1.2, -math.inf), RoadGrade(0.03, torch.linspace(-1, 1, 5, dtype=torch.float64), 5)]
)
def test_plants_with_more_than_plain_numbers_are_written(effect: Saturation | RoadGrade, tmp_path: Path) -> None:
    given = candidates(**{effect.name: 0.8, "none": 0.15, "unknown": 0.05})
    diagnosis(given, plant=plant([effect])).write(tmp_path)
    read = GapPlant.from_toml((tmp_path / "plant.toml").read_text(encoding="utf-8")).values()
    for name, value in plant([effect]).values().items():
        assert torch.equal(read[name], value), name


def test_an_answer_that_cannot_be_written_leaves_the_earlier_one(tmp_path: Path) -> None:
    given = candidates(dead_time=0.8, none=0.15, unknown=0.05)
    diagnosis(given, plant=plant([DeadTime(0.3)])).write(tmp_path)
    before = visible(tmp_path)
    bad = diagnosis(given, plant=plant([DeadTime()]), next_experiment={"before": math.nan})
    with pytest.raises(InputError, match=r"next_experiment\.before"):
        bad.write(tmp_path)
    assert set(before) == {"diagnosis.json", "plant.toml"}
    assert visible(tmp_path) == before


def test_the_page_of_an_earlier_diagnosis_goes_with_it(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("of an earlier diagnosis", encoding="utf-8")
    diagnosis(candidates(dead_time=0.8, none=0.15, unknown=0.05)).write(tmp_path)
    assert set(visible(tmp_path)) == {"diagnosis.json"}


def test_several_logs_are_counted_together() -> None:
    def log(rows: int, step: float, **signals: bool) -> Log:
        time = np.arange(rows) * step
        return Log.from_arrays(
            time=time,
            accel_cmd=np.sin(time),
            speed=20 - np.cos(time),
            accel=np.sin(time) if signals.get("accel") else None,
            name=f"{rows}",
        )

    facts = LogFacts.of([log(101, 0.1), log(201, 0.05, accel=True)])
    assert (facts.rows, facts.segments, facts.name) == (302, 2, "101, 201")
    # the log's folder is not in the answer
    named = [replace(log(101, 0.1), name=name) for name in ("somebody/at home/a.csv", "b.csv", "arrays")]
    assert LogFacts.of(named).name == "a.csv, b.csv, arrays"
    assert facts.seconds == pytest.approx(20.0)
    assert facts.rate_hz == pytest.approx(15.0)
    assert facts.signals == ("accel_cmd", "accel", "speed")
    assert LogFacts.of(log(101, 0.1)).segments == 1


def test_draws_for_arviz() -> None:
    pytest.importorskip("arviz")
    given = candidates(dead_time=0.8, none=0.15, unknown=0.05)
    draws = {"delay_s": np.arange(12.0).reshape(3, 4), "T_L": np.ones((3, 4))}
    data = diagnosis(given, draws=draws).to_arviz().posterior
    assert dict(data.sizes) == {"chain": 3, "draw": 4}
    assert data.delay_s.attrs["units"] == "s"
    assert np.array_equal(data.delay_s.values, draws["delay_s"])
    assert data.attrs["candidate"] == "dead_time"
    with pytest.raises(InputError, match="draws: the diagnosis has none"):
        diagnosis(given).to_arviz()
