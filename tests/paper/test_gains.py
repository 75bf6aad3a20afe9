"""What the gains do: the lag that is measured is the lag there is, and the table's claims come out by figures."""

from __future__ import annotations

import pytest
import torch

from avtorch.paper import Gains, Leaders, gains
from avtorch.paper.gains import _lag
from avtorch.vehicle import Leader, simulate
from avtorch.vehicle.block import Block
from avtorch.vehicle.stability import peak_gain


@pytest.fixture(scope="module")
def found() -> Gains:
    return gains(Leaders.read(), seeds=2, seed=5)


def test_lag_of_a_leader_held_back() -> None:
    run = simulate(Leader.default(duration=60.0), duration=50.0)
    lead = run.lead_speed[:, 0]
    late = torch.cat([lead[:, :1].expand(-1, 135), lead[:, :-135]], -1)
    flat = {name: x[:, 0] for name, x in vars(run).items() if name not in ("time", "speed")}
    assert float(_lag(Block(run.time, speed=late, **flat))[0]) == pytest.approx(1.35)


def test_claims(found: Gains) -> None:
    rows = {(r.setting[:3], r.quantity.split(",")[0], r.paper): r for r in found.rows}
    assert len(rows) == 10
    spacing = next(r for r in found.rows if r.quantity.startswith("spacing error"))
    # the spacing error is nearly the demanded acceleration over k_s: a third, three times as large
    assert spacing.ours == pytest.approx(1 / 3, rel=0.1)
    assert spacing.verdict == "same"
    damps = next(
        r for r in found.rows if r.quantity.startswith("exact peak gain, over") and r.setting.startswith("k_s")
    )
    known = peak_gain(1.5, 0.5, 1.0, (4.5, 1.5, -0.8)) / peak_gain(1.5, 0.5, 1.0, (1.5, 1.5, -0.8))
    assert (damps.ours, damps.verdict) == (pytest.approx(float(known)), "not reproduced")


def test_noise_is_what_noise_adds(found: Gains) -> None:
    noise = found.measured["noise in the acceleration"]
    assert noise.shape == (3, 4, 2)
    # 0.1 m/s³ over steps of 0.01 s through a lag of 0.3 s: sqrt(dt T / 2) 0.1 = 0.0039 without the loop, less with it
    assert 0.001 < float(noise.min()) <= float(noise.max()) < 0.0045
