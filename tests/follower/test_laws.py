"""Headway laws: at rest in equilibrium."""

from __future__ import annotations

import pytest
import torch

from avtorch.errors import InputError
from avtorch.follower import LAWS, FollowerMeasurements, HeadwayLaw
from avtorch.follower.laws import law_named


def drawn(law: HeadwayLaw, seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {p.name: p.sample(generator=generator) for p in law.parameters}


@pytest.mark.parametrize("law", LAWS.values(), ids=lambda law: law.name)
def test_equilibrium_demands_nothing(law: HeadwayLaw, fresh_seed: int) -> None:
    values = drawn(law, fresh_seed)
    for v in (3.0, 12.0, 18.0):
        speed = torch.tensor([v], dtype=torch.float64)
        seen = FollowerMeasurements(law.spacing(values, v).reshape(1), speed, speed)
        if float(seen.spacing) > 0.5 and v < 0.98 * float(values.get("desired_speed_mps", torch.tensor(1e9))):
            assert float(law.command(values, seen)) == pytest.approx(0.0, abs=1e-9)


def test_unknown_law_is_named() -> None:
    with pytest.raises(InputError, match="law: found 'magic', needs one of constant_time_gap"):
        law_named("magic")
