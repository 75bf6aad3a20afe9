"""A platoon of ten: what is measured at its tail, and who is said to collide."""

from __future__ import annotations

import pytest
import torch

from avtorch.paper import Leaders, Platoon, platoon
from avtorch.paper.drive import rows_from
from avtorch.paper.platoon import ACT_S, PASSED_S, VEHICLES
from avtorch.vehicle.performance import rms_about_mean

pytestmark = pytest.mark.slow  # all tests need the experiment itself


@pytest.fixture(scope="module")
def found() -> Platoon:
    return platoon(Leaders.read(), seeds=2, seed=7)


def test_rows_and_measures(found: Platoon) -> None:
    assert found.run.speed.shape[1:3] == (2, VEHICLES)
    ratio = found.against_leader("speed", PASSED_S)
    rows = rows_from(found.run, PASSED_S)
    own, first = rms_about_mean(rows.speed[0, 1, 4]), rms_about_mean(rows.lead_speed[0, 1, 0])
    assert float(ratio[0, 1, 4]) == pytest.approx(float(own / first))
    assert len(found.rows) == 1 + 3 * (len(found.names) - 1)
    tail = found.against_leader("accel", ACT_S)[..., -1]
    ours = next(r for r in found.rows if r.setting.startswith("our strategist") and "acceleration" in r.quantity)
    assert ours.ours == pytest.approx(float((tail[-1] / tail[0]).mean()))  # of two runs
    assert float(found.peak[0]) == pytest.approx(2.2445, abs=5e-5)


def test_collisions_are_reported(found: Platoon) -> None:
    hit = (found.run.spacing <= 0).flatten(1).any(-1)
    for i, name in enumerate(found.names):
        told = [r.why for r in found.rows if r.setting.startswith(name)]
        assert all(("hold a collision" in why) == bool(hit[i]) for why in told)
    assert torch.isfinite(found.run.speed).all()
