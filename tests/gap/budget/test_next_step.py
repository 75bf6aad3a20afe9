"""A selection that was interrupted goes on from its finished steps, to the same selection bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from avtorch.errors import InputError
from avtorch.gap import EFFECTS, DeadTime, RoadGrade, plant
from avtorch.gap.budget import entry, next_step
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.forward_selection import select
from avtorch.gap.budget.selection_step import Selection
from avtorch.gap.search.checkpoint import SCHEMA, Checkpoint
from avtorch.gap.search.fitted_work import fitted_work
from avtorch.io import read_sealed, write_sealed
from tests.gap.budget.cars import log_of

KINDS = [EFFECTS[name] for name in ("dead_time", "sensor_bias", "constant_resistance", "road_grade")]


ROAD = torch.randn(64, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
LOG = log_of([DeadTime(0.3), RoadGrade(grade_rms=0.015, profile=ROAD)], seed=11)
WORK = fitted_work([LOG], plant([]), KINDS, pairs=True)


def selected(checkpoint: Checkpoint | None) -> Selection:
    return select(AnalysisRecord.for_budget([LOG]), plant([]), KINDS, checkpoint=checkpoint)


def content(selection: Selection) -> list[Any]:
    """All that follows from the steps."""
    return [
        (s.entered, s.aliases, s.evidence, s.fit.z.tolist(), s.fit.nats, s.held.nats.tolist(), s.held.white.tolist())
        for s in selection.steps
    ]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Selection, Path]:
    path = tmp_path_factory.mktemp("steps") / "fits.json"
    return selected(Checkpoint(path, WORK)), path


@pytest.mark.slow
def test_a_file_of_steps_changes_nothing(whole: tuple[Selection, Path]) -> None:
    assert set(whole[0].last.fit.model.names) >= {"dead_time", "road_grade"}
    assert content(selected(None)) == content(whole[0])


@pytest.mark.slow
@pytest.mark.parametrize("finished", [1, 3, 1000])
def test_it_goes_on_from_the_steps_that_are_finished(
    whole: tuple[Selection, Path], finished: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = read_sealed(whole[1], schema=SCHEMA)
    steps, path, made = found.content["steps"], tmp_path / "fits.json", []
    assert len(steps) > 3
    write_sealed(path, {"fits": [], "steps": steps[:finished]}, schema=SCHEMA, of=found.of)

    def counted(*arguments: Any) -> Any:
        made.append(arguments)
        return entry.enter(*arguments)

    monkeypatch.setattr(next_step, "enter", counted)
    assert content(selected(Checkpoint(path, WORK))) == content(whole[0])
    assert len(made) == max(len(steps) - finished, 0)
    assert read_sealed(path, schema=SCHEMA).content["steps"] == steps


@pytest.mark.slow
def test_a_step_of_another_model_is_refused(whole: tuple[Selection, Path], tmp_path: Path) -> None:
    found, path = read_sealed(whole[1], schema=SCHEMA), tmp_path / "fits.json"
    first, *rest = found.content["steps"]
    for change in ({"effects": ["gust"], "onsets": {}}, {"z": [0.0]}, {"block_nats": [1.0]}):
        write_sealed(path, {"fits": [], "steps": [first | change, *rest]}, schema=SCHEMA, of=found.of)
        with pytest.raises(InputError, match=r"fits\.json: a step of the budget does not match its recorded start"):
            selected(Checkpoint(path, WORK))


def test_steps_are_checked_in_shape_and_type(whole: tuple[Selection, Path], tmp_path: Path) -> None:
    found, path = read_sealed(whole[1], schema=SCHEMA), tmp_path / "fits.json"
    first = found.content["steps"][0]
    for change in (
        {"more": 1},
        {"inputs": 3},
        {"effects": "dead_time"},
        {"aliases": [1]},
        {"onsets": {"gust": 1.0}},
        {"onsets": {first["effects"][0]: "1"}},
        {"z": [True]},
        {"block_nats": [None]},
        {"nats": "1"},
        {"z": [0.0] * 5000},
    ):
        write_sealed(path, {"fits": [], "steps": [first | change]}, schema=SCHEMA, of=found.of)
        with pytest.raises(InputError, match=r"fits\.json: step 0: .*--no-resume"):
            Checkpoint(path, WORK)
