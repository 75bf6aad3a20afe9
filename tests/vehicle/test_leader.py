"""Leaders: consistency of position, speed and acceleration, smoothing, sections, recordings, bad input."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import Leader


def test_speed_and_position_are_the_integrals_of_acceleration():
    leader = Leader.default()
    dt, a, v, x = leader.dt, leader.accel, leader.speed, leader.position
    # trapezoids err by dt²/12 times the change of slope: jerk below 10 m/s³ and dt 0.01 give 1e-4 in all
    assert (v - v[0] - torch.cumulative_trapezoid(a, dx=dt).new_zeros(1)).shape == v.shape
    by_parts = torch.cat([v[:1], v[0] + torch.cumulative_trapezoid(a, dx=dt)])
    assert (by_parts - v).abs().max() < 1e-4
    moved = torch.cat([x[:1], torch.cumulative_trapezoid(v, dx=dt)])
    assert (moved - x).abs().max() < 1e-4
    assert x[0] == 0
    assert leader.time[0] == 0
    assert leader.time[1].item() == pytest.approx(dt)


def test_default_is_us06_on_the_cycles_own_clock():
    leader = Leader.default()
    assert leader.name == "US06"
    assert leader.speed.min() >= 0
    assert leader.speed[:400].max() < 0.01
    assert leader.speed[1000:4000].min() > 0.3
    first = Leader.default(duration=80.0)
    assert first.duration == pytest.approx(80.0)
    assert (first.speed > 0.3).double().mean() > 0.75
    torch.testing.assert_close(first.speed, leader.speed[:8001])
    # public figures of the cycle: 12.8 km, 129.2 km/h at most; 0.5 s of smoothing takes little off the peak
    assert leader.position[-1].item() == pytest.approx(12.88e3, rel=0.01)
    assert leader.speed.max().item() == pytest.approx(129.2 / 3.6, rel=0.01)


def test_smoothing_keeps_ends_sign_and_slow_motion_and_damps_fast():
    t = np.arange(0, 60, 0.1)
    raw = 10 + 2 * np.sin(2 * np.pi * 0.05 * t) + 0.2 * np.sin(2 * np.pi * 2.0 * t)
    leader = Leader.from_speed(t, raw)
    assert leader.speed[0].item() == pytest.approx(raw[0], abs=1e-9)
    assert leader.speed[-1].item() == pytest.approx(raw[-1], abs=1e-9)
    inside = slice(500, 5400)
    slow = 10 + 2 * torch.sin(2 * torch.pi * 0.05 * leader.time) * np.exp(-((2 * np.pi * 0.05 * 0.5) ** 2) / 2)
    # gain at 2 Hz is exp(-20): what remains is PCHIP's distortion of the 2 Hz part, folded to low frequencies
    assert (leader.speed - slow)[inside].abs().max() < 0.05


def test_unsmoothed_leader_interpolates_its_samples():
    t, v = [0.0, 1.0, 2.5, 4.0], [0.0, 3.0, 3.0, 0.0]
    leader = Leader.from_speed(t, v, smooth_s=0.0)
    assert [leader.speed[round(s / 0.01)].item() for s in t] == pytest.approx(v, abs=1e-9)


def test_stop_and_go_never_goes_negative(fresh_seed):
    rng = np.random.default_rng(fresh_seed)
    v = np.maximum(rng.normal(0, 5, 300), 0.0)
    leader = Leader.from_speed(np.arange(300), v)
    assert leader.speed.min() >= 0
    assert (leader.position.diff() > -1e-4).all()


def test_section_starts_at_zero():
    leader = Leader.default()
    part = leader.section(100.0, 20.0)
    assert part.duration == pytest.approx(20.0)
    assert part.position[0] == 0
    assert part.time[0] == 0
    assert torch.equal(part.speed, leader.speed[10_000:12_001])
    torch.testing.assert_close(part.position, leader.position[10_000:12_001] - leader.position[10_000])


@pytest.mark.parametrize(("start", "duration"), [(-1.0, 5.0), (0.0, 1e4), (1e4, None), (5.0, 0.0)])
def test_sections_outside_are_refused(start, duration):
    with pytest.raises(InputError, match="section"):
        Leader.default(duration=100.0).section(start, duration)


@pytest.mark.parametrize(
    ("time", "speed", "message"),
    [
        ([0.0], [1.0], "two or more"),
        ([0.0, 1.0], [1.0], "two or more"),
        ([0.0, 0.0], [1.0, 1.0], "increasing"),
        ([0.0, 2.0, 1.0], [1.0, 1.0, 1.0], "sample 2"),
        ([0.0, float("nan")], [1.0, 1.0], "increasing"),
        ([0.0, 1.0], [1.0, -0.5], "negative speed"),
        ([0.0, 1.0], [float("inf"), 1.0], "not finite"),
        ([0.0, 0.001], [1.0, 1.0], "at least one step"),
    ],
)
def test_bad_recordings_are_refused(time, speed, message):
    with pytest.raises(InputError, match=message):
        Leader.from_speed(time, speed)


@pytest.mark.parametrize("setting", [{"dt": 0.0}, {"dt": float("nan")}, {"smooth_s": -1.0}])
def test_bad_settings_are_refused(setting):
    with pytest.raises(InputError, match="dt"):
        Leader.from_speed([0.0, 1.0], [1.0, 1.0], **setting)


@pytest.mark.parametrize(
    "pattern", ["openacc_astazero/*7*", "openacc_zalazone/*", "ngsim/*", "i24/*", "drive_cycles/us06.csv"]
)
def test_recordings_become_leaders(data_dir, pattern):
    path = next(p for p in sorted(data_dir.glob(pattern)) if p.suffix == ".csv" and p.name != "Slope.csv")
    leader = Leader.read(path)
    assert leader.speed.min() >= 0
    assert leader.duration > 10
    assert torch.isfinite(leader.position).all()
    assert leader.speed.max() < 70
