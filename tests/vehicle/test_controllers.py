"""Linear law and the ramp of its time gap."""

from __future__ import annotations

import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import RAMP_RATE, ClosedLoop, FollowerState, GLVDPlant, Leader, LinearController, TimeGap

F64 = torch.float64


def state(time=0.0, spacing=40.0, speed=24.0, accel=-0.5, lead_speed=25.0, lead_accel=0.6):
    return FollowerState(time, *(torch.tensor([x], dtype=F64) for x in (spacing, speed, accel, lead_speed, lead_accel)))


def test_the_law_is_the_formula():
    u = LinearController((1.1, 1.3, -0.4), time_gap=1.2, standstill=4.0, feedforward=0.5)(state())
    expected = 1.1 * (40 - (1.2 * 24 + 4)) + 1.3 * (25 - 24) - 0.4 * -0.5 + 0.5 * 0.6
    assert u.item() == pytest.approx(expected, rel=1e-13)


def test_gains_and_gap_broadcast_over_scenarios():
    gains = torch.tensor([[1.5, 1.5, -0.8], [3.0, 3.0, -1.8]], dtype=F64)
    gap = torch.tensor([1.0, 2.0], dtype=F64)
    both = LinearController(gains, gap)(state())
    for i in range(2):
        assert both[i] == LinearController(gains[i], gap[i])(state())[0]


def test_equilibrium_demands_nothing():
    assert LinearController()(state(spacing=30.0, speed=25.0, accel=0.0)).abs() < 1e-12


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gains", (1.0, 2.0)),
        ("gains", 1.0),
        ("gains", (1.0, float("nan"), 0.0)),
        ("time_gap", -1.0),
        ("standstill", -1.0),
        ("feedforward", float("inf")),
    ],
)
def test_bad_settings_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        LinearController(**{name: value})


def test_ramp_is_piecewise_linear_and_ends_at_the_target():
    gap = TimeGap(target=torch.tensor([2.5, 0.8], dtype=F64), start=1.0, since=10.0, rate=0.1)
    assert gap.at(3.0).tolist() == [1.0, 1.0]
    assert gap.at(11.0).tolist() == pytest.approx([1.1, 0.9])
    assert gap.at(13.0).tolist() == pytest.approx([1.3, 0.8])
    assert gap.done_at == pytest.approx(25.0)
    assert gap.at(25.0)[0] == pytest.approx(2.5)


def test_bad_ramps_are_refused():
    for arguments in ({"rate": 0.0}, {"since": float("nan")}, {"target": -1.0}):
        with pytest.raises(InputError, match="time"):
            TimeGap(**{"target": 2.0, "start": 1.0} | arguments)


def test_retargeting_starts_from_the_gap_in_force():
    first = LinearController().retargeted(at=10.0, time_gap=2.5, rate=0.1)
    second = first.retargeted(at=15.0, time_gap=1.0, gains=(3.0, 3.0, -1.8), rate=0.1)
    assert second.time_gap_at(15.0).item() == pytest.approx(1.5)
    assert second.time_gap_at(20.0).item() == pytest.approx(1.0)
    assert second.gains == (3.0, 3.0, -1.8)
    assert second.time_gap == 1.0
    # on the way and at the end the law is that of the gap in force
    assert first(state(time=15.0))[0] == pytest.approx(LinearController(time_gap=1.5)(state())[0].item(), rel=1e-12)
    assert first(state(time=25.1))[0] == LinearController(time_gap=2.5)(state())[0]


@pytest.mark.parametrize(("rate", "ceiling"), [(RAMP_RATE, 2.0), (1e6, 6.0)])
def test_ramp_keeps_a_new_gap_comfortable(rate, ceiling):
    """The stated reason of the default rate: below 2 m/s² at 30 m/s, where a jump brakes at the limit."""
    loop = ClosedLoop(Leader.constant(30.0, 60.0), plant=GLVDPlant(sigma=0.0))
    loop.advance(100)
    loop.controller = loop.controller.retargeted(at=loop.time, time_gap=2.5, rate=rate)  # type: ignore[attr-defined]
    run = loop.advance(4500)
    worst = run.accel.abs().max().item()
    assert worst < ceiling
    assert rate == RAMP_RATE or worst > 5.0
    assert run.spacing[0, -1].item() == pytest.approx(80.0, abs=1e-3)
