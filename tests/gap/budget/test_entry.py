"""What a search begins from: effects that hide the actuator's own gain and lag are found from the fit without them."""

from __future__ import annotations

import pytest
import torch

from avtorch.gap import plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.entry import candidates_for, fitted
from avtorch.gap.budget.forward_selection import baseline_noise
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
    screened = fitted(fitting, first)
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
