"""Second-order lags: closed-form step responses, an independent solver, gradients, bad arguments."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch.autograd import gradcheck

from avtorch.errors import InputError
from avtorch.vehicle.second_order import PositionLag, SpeedLag

F64 = torch.float64


def test_speed_steps_as_an_exponential():
    v = SpeedLag(0.8, 0.9).rollout(10.0, torch.full((50,), 20.0, dtype=F64), 0.1)
    t = 0.1 * torch.arange(1, 51, dtype=F64)
    torch.testing.assert_close(v, 18.0 + (10.0 - 18.0) * (-t / 0.8).exp(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("zeta", [0.3, 1.0, 2.0])
def test_position_is_an_independent_solver_s(zeta, fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    T, dt, x_cmd = 0.7, 0.1, torch.randn(30, generator=g, dtype=F64)
    x, v = PositionLag(T, zeta).rollout(torch.tensor(0.4, dtype=F64), torch.tensor(-0.2, dtype=F64), x_cmd, dt)
    state, found = np.array([0.4, -0.2]), []
    for target in x_cmd.tolist():

        def rates(_, y, target=target):
            return [y[1], (target - y[0]) / T**2 - 2 * zeta / T * y[1]]

        state = solve_ivp(rates, (0, dt), state, rtol=1e-11, atol=1e-12).y[:, -1]
        found.append(state)
    expected = torch.tensor(np.array(found), dtype=F64)
    torch.testing.assert_close(torch.stack([x, v], -1), expected, rtol=0, atol=1e-8)


def test_a_moving_target_is_followed_at_a_distance():
    T, zeta, speed = 0.5, 0.8, 20.0
    x_cmd = speed * 0.01 * torch.arange(1500, dtype=F64)
    x, _ = PositionLag(T, zeta).rollout(torch.zeros((), dtype=F64), torch.zeros((), dtype=F64), x_cmd, 0.01)
    # at a step's end the ramp is a step beyond the last command, and held commands lag half a step behind it
    behind = float(x_cmd[-1] + 0.5 * 0.01 * speed - x[-1].detach())
    # what is left is the ripple of the holding: half a step of way, 0.1 m, by (dt/T)^2
    assert behind == pytest.approx(2 * zeta * T * speed, abs=0.1 * (0.01 / T) ** 2)


def test_gradients_reach_parameters_and_commands():
    x_cmd = torch.randn(6, generator=torch.Generator().manual_seed(0), dtype=F64, requires_grad=True)

    def end(T, zeta, command):
        lag = PositionLag(1.0, 1.0)
        del lag.T_P, lag.zeta
        lag.T_P, lag.zeta = T, zeta
        zero = torch.zeros((), dtype=F64)
        return torch.stack(lag.rollout(zero, zero, command, 0.2))

    start = [torch.tensor(v, dtype=F64, requires_grad=True) for v in (0.6, 1.0)]  # critical damping included
    assert gradcheck(end, (*start, x_cmd))


@pytest.mark.parametrize(
    ("make", "name"), [(lambda: SpeedLag(0.0, 1.0), "T_V"), (lambda: PositionLag(1.0, -1.0), "zeta")]
)
def test_bad_arguments_are_refused_by_name(make, name):
    with pytest.raises(InputError, match=name):
        make()
    zero = torch.zeros(1, dtype=F64)
    with pytest.raises(InputError, match="dt"):
        PositionLag(1.0, 1.0).rollout(zero, zero, zero[None], math.nan)
