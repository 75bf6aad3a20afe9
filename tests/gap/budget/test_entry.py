"""What a search begins from: effects that hide the actuator's own gain and lag are found from the fit without them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from avtorch.gap import plant
from avtorch.gap.budget import entry
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.entry import candidates_for, fitted
from avtorch.gap.budget.forward_selection import baseline_noise
from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.selection_step import Step
from avtorch.gap.effects import Backlash, ConstantResistance, DeadBand, RateLimit, Saturation
from avtorch.gap.simulator.effect import Effect

from .cars import log_of


@pytest.mark.parametrize(
    "effect", [Saturation(0.25, -0.35), DeadBand(0.8), Backlash(0.5), RateLimit(0.25)], ids=lambda e: e.name
)
def test_what_hides_gain_and_lag_is_found_from_the_fit_without_it(effect: Effect, fresh_seed: int) -> None:
    record = AnalysisRecord.for_budget([log_of([effect], seconds=120.0, seed=fresh_seed, T_L=0.2)])
    fitting, bare = baseline_noise(record, plant([]))
    now = Step(bare, fitting.hold_out(bare))
    first, *_ = candidates_for(fitting, now, [type(effect), ConstantResistance], None, "")
    assert first.model.names[-1] == effect.name
    screened = fitted(fitting, now, first)
    found = fitting.fit(screened.model, screened.z[None])
    own = found.model.plant.parameters()
    values = {f"{effect.name}.{key}": value for key, value in effect.values().items()} | {
        "T_L": torch.tensor(0.2).double(),
        "K_L": torch.tensor(0.95).double(),
    }
    known = {key: own[key].unconstrain(x).reshape(1).numpy() for key, x in values.items() if key in found.model.index}
    exact = fitting.fit(found.model, found.model.coordinates({**bare.known, **known})[None])
    # of the last of it a fit may stop short
    assert bare.nats - found.nats > 0.8 * (bare.nats - exact.nats) > 0


@pytest.mark.parametrize(
    ("nats", "freedom", "chosen"), [(10.0, 2.0, "dead_band"), (210.0, 2.0, "gain_change"), (27.0, 9.0, "dead_band")]
)
def test_the_simplest_does_not_lose_much_to_the_best(
    nats: float, freedom: float, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a drive of a minute no blocks agree on anything, and a dead band of 570 nats stood in for a change of the gain
    of 780, with four wrong effects more to mend it. On the lap of a race car many blocks did not agree on 27."""

    def step(name: str, cost: float, parameters: int) -> Any:
        return Step(cast(Any, parameters), cast(Any, SimpleNamespace(nats=np.array([cost]))), name)

    def preference(one: Any, other: Any) -> Evidence:  # of blocks that do not agree
        return Evidence(float((one.nats - other.nats)[0]), 1.0, freedom)

    fitting: Any = SimpleNamespace(preference=preference)
    monkeypatch.setattr(entry, "complexity", lambda fit: fit)
    monkeypatch.setattr(entry, "_possible_lag", lambda fit: True)
    steps = [step("gain_change", 100.0, 6), step("dead_band", 100.0 + nats, 5)]
    found, alike = entry._simplest_alike(fitting, steps)
    assert found.entered == chosen
    assert found in alike
    assert len(alike) == (2 if chosen == "dead_band" else 1)
