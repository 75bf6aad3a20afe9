"""A controller of unknown structure: its slopes are the law's, and measured gains agree with theory."""

from __future__ import annotations

import math

import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import MPC, GLVDPlant, LinearController, linearise, measured_gain, stability

GAINS = (1.5, 1.5, -0.8)
OMEGA = (0.5, 1.0, 2.0)


def network(state):
    """Saturating units around the linear law, as a small trained policy has them."""
    linear = LinearController(GAINS, 1.2)(state)
    return 3.0 * torch.tanh(linear / 3.0) + 0.2 * torch.tanh(0.1 * (state.speed - 25.0))


def test_slopes_of_a_linear_law_are_its_gains() -> None:
    law = linearise(LinearController(GAINS, 1.3, standstill=4.0, feedforward=0.4), 20.0)
    assert law.spacing == pytest.approx(30.0, abs=1e-6)
    assert law.gains == pytest.approx(GAINS, abs=1e-8)
    assert law.time_gap == pytest.approx(1.3, abs=1e-8)
    assert law.feedforward == pytest.approx(0.4, abs=1e-8)
    assert law.bend < 1e-8
    mpc = MPC(time_gap=1.4)
    assert linearise(mpc, 22.0).gains == pytest.approx(mpc.gains, rel=1e-6)
    assert linearise(mpc, 22.0).time_gap == pytest.approx(1.4, rel=1e-6)


def test_slopes_of_a_network_and_a_bend_where_there_is_none() -> None:
    law = linearise(network, 25.0)
    # at the equilibrium both tanh have slope one: k_s tau + k_v is less by the second one's 0.02
    assert law.gains == pytest.approx(GAINS, rel=1e-3)
    assert law.time_gap == pytest.approx(1.2 - 0.02 / 1.5, abs=2e-3)
    assert law.bend < 0.05
    kinked = linearise(lambda s: torch.where(s.lead_speed > s.speed + 0.1, 4.0, 1.0) * LinearController()(s), 25.0)
    assert kinked.bend > 0.2


@pytest.mark.parametrize(
    ("k_f", "delay"),
    [pytest.param(0.0, 0.0, marks=pytest.mark.slow), pytest.param(0.8, 0.0, marks=pytest.mark.slow), (0.8, 0.3)],
)
def test_what_is_measured_is_the_transfer_function(k_f: float, delay: float) -> None:
    """Simulation against theory, feed-forward and its delay among them; a held command acts half a step late."""
    controller = LinearController(GAINS, 1.0, feedforward=k_f)
    plant = GLVDPlant(0.8, 0.8, sigma=0.0)
    seen = measured_gain(controller, OMEGA, plant=plant, link_delay=delay, settle=25.0)
    said = stability.gain(
        torch.tensor(OMEGA, dtype=torch.float64),
        0.8,
        0.8,
        1.0,
        GAINS,
        dead_time=0.005,
        feedforward=k_f,
        feedforward_delay=delay,
    )
    # the slowest mode fades at 0.5 1/s or faster; what is left of a held command is of second order in the step
    assert torch.allclose(seen, said, rtol=5e-4)


@pytest.mark.slow
def test_a_black_box_gets_its_slopes_verdict_for_small_motions_only() -> None:
    law = linearise(network, 25.0)
    omega = torch.tensor([0.8], dtype=torch.float64)
    said = float(stability.gain(omega, 1.2, 0.6, law.time_gap, law.gains, dead_time=0.005)[0])
    how = {"plant": GLVDPlant(1.2, 0.6, sigma=0.0), "settle": 40.0}
    small, large = (float(measured_gain(network, omega, amplitude=a, **how)[0]) for a in (0.05, 4.0))
    assert said > 1.0
    assert small == pytest.approx(said, rel=5e-3)
    # saturated units behave differently, which the slopes do not show
    assert abs(large / said - 1.0) > 0.05


@pytest.mark.slow
def test_who_collides_amplifies_without_bound() -> None:
    blind = LinearController((0.02, 0.0, 0.0), 0.1)
    seen = measured_gain(blind, [0.3], plant=GLVDPlant(1.5, 0.5, 0.0), amplitude=5.0, settle=30.0)
    assert seen.tolist() == [math.inf]


def test_a_table_has_no_slopes_but_may_be_measured() -> None:
    def rounded(state):
        return torch.round(LinearController()(state) / 0.5) * 0.5

    with pytest.raises(InputError, match="spacing"):
        linearise(rounded, 20.0)
    # by steps far wider than its own it follows the law it was made of
    assert linearise(rounded, 20.0, step=20.0).gains == pytest.approx(GAINS, rel=0.05)
    seen = measured_gain(rounded, [1.0], speed=20.0, amplitude=3.0, settle=10.0, cycles=1)
    said = stability.gain(1.0, 0.3, 1.0, 1.0, GAINS)
    assert float(seen[0]) == pytest.approx(float(said), rel=0.1)


@pytest.mark.parametrize(
    ("controller", "speed", "says"),
    [
        (lambda s: torch.zeros_like(s.speed), 25.0, "equilibrium"),
        (lambda s: s.lead_speed - s.speed + 1.0, 25.0, "equilibrium"),
        (lambda s: s.spacing / 0.0, 25.0, "demanded"),
        (LinearController(), -1.0, "speed"),
    ],
)
def test_what_does_not_follow_is_refused(controller, speed: float, says: str) -> None:
    with pytest.raises(InputError, match=says):
        linearise(controller, speed)


@pytest.mark.parametrize("bad", [{"omega": [0.0]}, {"omega": []}, {"amplitude": 30.0}, {"cycles": 0}])
def test_bad_numbers_are_refused(bad: dict) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        measured_gain(LinearController(), **{"omega": [1.0], **bad})
