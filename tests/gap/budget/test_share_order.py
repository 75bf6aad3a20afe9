"""Shares fall from part to part, sum to what all parts take off, and are shared where parts act together."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from avtorch.gap import EFFECTS, gap_budget, plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.robust_fit import Fit, HeldOut
from avtorch.gap.budget.selection_step import Step
from avtorch.gap.budget.share_order import own_response, taken_off
from avtorch.io import Log
from tests.gap.budget.cars import log_of

energies = st.lists(st.floats(0.0, 100.0), min_size=2, max_size=6)


def one_draw(levels: list[float]) -> list[float]:
    return taken_off(np.array(levels)[:, None])[:, 0].tolist()


def test_effects_that_reduce_the_error_only_together_share_what_they_take() -> None:
    assert one_draw([10.0, 12.0, 2.0, 1.0]) == pytest.approx([4.0, 4.0, 1.0])


def test_where_each_takes_less_than_the_one_before_it_nothing_is_shared() -> None:
    assert one_draw([10.0, 4.0, 2.0, 1.0]) == pytest.approx([6.0, 2.0, 1.0])


def test_an_effect_that_takes_nothing_has_no_share() -> None:
    assert one_draw([10.0, 1.0, 1.5]) == pytest.approx([9.0, 0.0])


def test_an_effects_own_response_is_what_it_changes_all_else_equal() -> None:
    record = AnalysisRecord.of([log_of()])
    model = EffectModel(record, plant(), (EFFECTS["constant_resistance"], EFFECTS["sensor_scale"]))
    scale = model.plant.parameters()["sensor_scale.scale"].unconstrain(torch.tensor(1.2, dtype=torch.float64))
    z = model.coordinates({"sensor_scale.scale": np.array(float(scale))})
    step = Step(
        Fit(model, z, 0.0, np.zeros(record.blocks)), HeldOut(np.zeros(record.blocks), z[None], np.zeros((2, 1)))
    )
    # of the accelerometer's reading, the channel that it changes
    assert own_response(step, "sensor_scale") == pytest.approx(0.2 / 1.2, rel=1e-6)


@given(energies)
def test_what_is_taken_falls_and_holds_all_that_is_taken(levels: list[float]) -> None:
    taken = one_draw(levels)
    assert all(a >= b - 1e-9 for a, b in pairwise(taken))
    assert min(taken) >= 0.0
    assert sum(taken) >= levels[0] - levels[-1] - 1e-9


@given(energies)
def test_draws_are_grouped_as_all_blocks_are(levels: list[float]) -> None:
    """A draw of blocks that says twice as much says so of each effect."""
    both = taken_off(np.stack([levels, 2 * np.array(levels)], 1))
    assert both[:, 1] == pytest.approx(2 * both[:, 0])


@pytest.mark.slow
def test_shares_of_a_real_cars_effects_fall(data_dir: Path) -> None:
    """They were 0, 0, 0, 90 and 4 %: a resistance and what pushes at low speed reduce the error only together."""
    log = Log.read(data_dir / "roboracer" / "ftg_stanley_total_training.csv")
    parts = gap_budget(log).parts
    shares = [part.share.mean for part in parts]
    assert shares == sorted(shares, reverse=True)
    assert {"constant_resistance", "low_speed_creep"} == {part.name for part in parts[:2]}
    assert min(shares[:2]) > 0.25
