"""Performance measures on series whose values are known."""

from __future__ import annotations

import math

import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import Block, GLVDPlant, Leader, equilibrium_throughput, performance, simulate

F64 = torch.float64


def block(**changes: torch.Tensor) -> Block:
    t = torch.arange(0, 40, 0.01, dtype=F64)
    wave = torch.sin(math.pi * t / 2)[None]  # whole periods
    columns = {
        "accel_cmd": wave * 0,
        "accel": 0.5 * wave,
        "speed": 20 + 3 * wave,
        "jerk": 2 * wave,
        "spacing": torch.full_like(wave, 10.0),
        "lead_speed": 20 + 2 * wave,
        "lead_accel": 0.4 * wave,
        "demanded": wave * 0,
        "clipped": t[None] < 4.0,
    }
    return Block(time=t, **{**columns, **changes})


def test_values_on_known_series():
    p = performance(block(), time_gap=1.0)
    assert p.speed_rms_ratio.item() == pytest.approx(1.5)
    assert p.accel_rms_ratio.item() == pytest.approx(1.25)
    assert p.jerk_rms_mps3.item() == pytest.approx(math.sqrt(2))
    assert p.clipped_share.item() == pytest.approx(0.1)
    assert p.min_spacing_m.item() == 10.0
    assert p.min_ttc_s.item() == pytest.approx(10.0)
    assert p.comfort_share.item() == 1.0
    assert p.throughput_vph.item() == pytest.approx(3600 * 20 / (20 + 5 + 4.5))


def test_safe_spacing_is_what_it_takes_to_stop():
    still = torch.zeros(1, 4000, dtype=F64)
    # 20 m/s behind 16 m/s: half a second, then 20² / 12 m against 16² / 12 m
    needed = 0.5 * 20 + (400 - 256) / 12
    for spacing, share in ((needed + 0.01, 1.0), (needed - 0.01, 0.0)):
        seen = performance(block(speed=still + 20, lead_speed=still + 16, spacing=still + spacing))
        assert seen.safe_share.item() == share
    # a leader who is faster stops later: only the reaction counts
    assert performance(block(speed=still + 20, lead_speed=still + 30, spacing=still + 10.01)).safe_share.item() == 1.0
    assert performance(block(speed=still + 20, lead_speed=still + 30, spacing=still + 9.99)).safe_share.item() == 0.0


def test_comfort_counts_rows_beyond_either_bound():
    assert performance(
        block(jerk=5 * torch.sin(torch.arange(4000, dtype=F64) * math.pi / 200)[None])
    ).comfort_share.item() == (
        pytest.approx(1 / 3, abs=0.01)  # |sin| <= 1/2 a third of the time
    )


def test_energy_at_constant_speed_is_the_road_load():
    still = torch.zeros(1, 4000, dtype=F64)
    p = performance(block(accel=still, speed=still + 20))
    assert p.energy_jpkgm.item() == pytest.approx(0.0981 + 2.6e-4 * 400)


def test_collision_and_never_closing():
    falling = torch.linspace(5, -1, 4000, dtype=F64)[None]
    hit = performance(block(spacing=falling))
    assert hit.min_spacing_m.item() == -1
    assert hit.min_ttc_s.item() == 0
    away = performance(block(lead_speed=torch.full((1, 4000), 30.0, dtype=F64)))
    assert away.min_ttc_s.item() == math.inf
    assert math.isnan(away.speed_rms_ratio.item())
    assert away.row(0)["min_ttc_s"] is None
    assert away.row(0)["speed_rms_ratio"] is None


def test_platoon_ratios_multiply_to_tail_against_head():
    leader = Leader.from_speed([0, 5, 10, 15, 20, 30], [20, 22, 18, 21, 20, 20])
    run = simulate(leader, vehicles=3, scenarios=2, plant=GLVDPlant(1.0, 0.8, 0.1), duration=28.0)
    p = performance(run)
    assert p.speed_rms_ratio.shape == (2, 3)
    head, tail = run.lead_speed[:, 0].std(-1), run.speed[:, 2].std(-1)
    torch.testing.assert_close(p.speed_rms_ratio.prod(-1), tail / head)
    assert set(p.row(1, 2)) >= {
        "speed_rms_ratio",
        "accel_rms_ratio",
        "min_spacing_m",
        "min_ttc_s",
        "jerk_rms_mps3",
        "clipped_share",
    }


def test_throughput_broadcasts_and_refuses():
    flow = equilibrium_throughput(25.0, torch.tensor([1.0, 1.6, 2.5], dtype=F64))
    assert (flow.diff() < 0).all()
    assert equilibrium_throughput(0.0, 1.0) == 0
    with pytest.raises(InputError, match="speed"):
        equilibrium_throughput(-1.0, 1.0)
