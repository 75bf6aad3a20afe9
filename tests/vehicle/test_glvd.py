"""Actuators: GLVD and second-order lags against closed forms and solvers, gradients, orders of convergence."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch.autograd import gradcheck, gradgradcheck

from avtorch.errors import InputError
from avtorch.vehicle import GLVD, GLVDPlant, glvd_jerk, glvd_rollout, glvd_step
from avtorch.vehicle.second_order import PositionLag, SpeedLag

F64 = torch.float64
EDGES = [(T, K, dt) for T in (0.05, 3.0) for K in (0.1, 1.5) for dt in (0.005, 0.1)]


def stepped(a0, u, T, K, dt, method):
    out, a = [], a0
    for k in range(u.shape[-1]):
        a = glvd_step(a, u[..., k], T, K, dt, method=method)
        out.append(a)
    return torch.stack(out, -1)


def leaves(*values: float | torch.Tensor) -> list[torch.Tensor]:
    return [torch.as_tensor(v, dtype=F64).clone().requires_grad_() for v in values]


def test_step_is_the_closed_form():
    a = glvd_step(0.7, -1.2, 0.4, 0.8, 0.03)
    assert a.item() == pytest.approx(0.8 * -1.2 + (0.7 + 0.8 * 1.2) * math.exp(-0.03 / 0.4), rel=1e-14)
    assert glvd_step(0.7, -1.2, 0.4, 0.8, 0.03, method="euler").item() == pytest.approx(
        0.7 + 0.03 * (-0.8 * 1.2 - 0.7) / 0.4, rel=1e-14
    )


@pytest.mark.parametrize("method", ["zoh", "euler"])
@pytest.mark.parametrize(("T", "K", "dt"), [*EDGES, (0.3, 1.0, 0.01)])
@pytest.mark.parametrize("steps", [1, 2, 7, 64, 65, 1000])
def test_rollout_equals_stepping(method, T, K, dt, steps, fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    u, a0 = torch.randn(3, steps, dtype=F64, generator=g), torch.randn(3, dtype=F64, generator=g)
    T, K = torch.tensor(T, dtype=F64), torch.tensor(K, dtype=F64)
    # at most 1000 terms of size below 10 (|alpha| <= 1 everywhere here): rounding stays below 1e-11
    torch.testing.assert_close(
        glvd_rollout(a0, u, T, K, dt, method=method), stepped(a0, u, T, K, dt, method), rtol=0, atol=1e-11
    )


def test_rollout_broadcasts_all_arguments():
    u = torch.linspace(-1, 1, 5 * 20, dtype=F64).reshape(5, 1, 20)
    T, K, a0 = torch.tensor([0.2, 0.3, 1.0], dtype=F64), torch.tensor(0.9, dtype=F64), torch.zeros(2, 1, 1, dtype=F64)
    out = glvd_rollout(a0, u, T, K, 0.01)
    assert out.shape == (2, 5, 3, 20)
    alone = glvd_rollout(0.0, u[4, 0], 1.0, 0.9, 0.01)
    torch.testing.assert_close(out[1, 4, 2], alone, rtol=0, atol=1e-14)
    assert glvd_rollout(0.0, u[..., :0], T, K, 0.01).shape == (5, 3, 0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept_and_accurate(dtype):
    u = torch.sin(torch.arange(2000, dtype=dtype) * 0.01)
    model = GLVD(torch.tensor(3.0, dtype=dtype), torch.tensor(0.7, dtype=dtype))
    out = model.rollout(0.2, u, 0.005)
    assert out.dtype == dtype
    assert model.jerk(0.1, u).dtype == dtype
    assert model.step(0.1, u, 0.01).dtype == dtype
    exact = glvd_rollout(0.2, torch.sin(torch.arange(2000, dtype=F64) * 0.01), 3.0, 0.7, 0.005)
    # sine and sum of the float32 inputs round at 2^-24 of numbers up to 20 and 1
    assert (out.to(F64) - exact).abs().max() < (2e-5 if dtype == torch.float32 else 1e-13)
    assert GLVD(0.3, 1.0).T_L.dtype == torch.float64
    assert GLVD(0.3, 1.0).float().rollout(0.0, u.float(), 0.01).dtype == torch.float32


@pytest.mark.parametrize(("T", "K", "dt"), [(0.3, 1.0, 0.01), (1.5, 0.5, 0.02), *EDGES])
@pytest.mark.parametrize("method", ["zoh", "euler"])
def test_gradients_of_both_orders(T, K, dt, method):
    u = torch.tensor([[1.0, -0.5, 2.0, 0.3, -1.0], [0.2, 0.4, -2.0, 0.0, 1.0]], dtype=F64)
    arguments = leaves(torch.tensor([0.5, -1.0]), u, T, K)
    step = leaves(0.5, -1.2, T, K)
    for check in (gradcheck, gradgradcheck):
        assert check(lambda a, v, p, q: glvd_rollout(a, v, p, q, dt, method=method), arguments)
        assert check(lambda a, v, p, q: glvd_step(a, v, p, q, dt, method=method), step)
        assert check(glvd_jerk, step)


@pytest.mark.parametrize(("T", "K", "dt"), EDGES)
def test_gradient_at_the_edges_is_the_formula(T, K, dt):
    """da_N/dT for a constant command: a_N = K u + (a0 - K u) exp(-N dt/T), so (a0 - K u) exp(-N dt/T) N dt/T²."""
    a0, u, n = 0.4, 1.3, 400
    lag, gain = leaves(T, K)
    last = glvd_rollout(a0, torch.full((n,), u, dtype=F64), lag, gain, dt)[-1]
    on_T, on_K = torch.autograd.grad(last, (lag, gain), create_graph=True)
    decay = math.exp(-n * dt / T)
    assert on_T.item() == pytest.approx((a0 - K * u) * decay * n * dt / T**2, rel=1e-9, abs=1e-13)
    assert on_K.item() == pytest.approx(u * (1 - decay), rel=1e-11)
    (second,) = torch.autograd.grad(on_T, lag)
    x = n * dt / T
    assert second.item() == pytest.approx(
        (a0 - K * u) * decay * x * (x - 2) / T**2, rel=1e-8, abs=1e-11
    )  # rounding of terms K u/T²


def test_euler_where_alpha_is_zero_has_finite_gradients():
    lag, gain = leaves(0.05, 1.0)
    out = glvd_rollout(0.3, torch.ones(50, dtype=F64), lag, gain, 0.05, method="euler")
    (first,) = torch.autograd.grad(out.sum(), lag, create_graph=True)
    (second,) = torch.autograd.grad(first, lag)
    assert torch.isfinite(first)
    assert torch.isfinite(second)


def test_euler_converges_with_order_one_and_zoh_is_exact():
    horizon, T, K = 2.0, 0.3, 0.8
    exact = glvd_rollout(0.5, torch.ones(1, dtype=F64), T, K, horizon)[-1]
    errors = []
    for n in (100, 200, 400, 800):
        u = torch.ones(n, dtype=F64)
        # the whole path, not its end: there the exponential has died out
        path = glvd_rollout(0.5, u, T, K, horizon / n, method="euler")
        exact_path = glvd_rollout(0.5, u, T, K, horizon / n)
        assert abs(exact_path[-1] - exact) < 1e-13
        errors.append((path - exact_path).abs().max().item())
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    # the next term of the error is of relative size dt/T, halved each time: 0.07 at the first pair
    assert orders[-1] == pytest.approx(1.0, abs=0.01)
    assert abs(orders[0] - 1) < 0.1


def test_exact_motion_does_not_cancel_for_small_steps():
    """Displacement against its power series, for steps far below the lag, where `T (dt - m1)` loses digits."""
    for T, dt in ((3.0, 0.005), (0.3, 0.01), (0.05, 0.1), (3.0, 0.0599), (3.0, 0.0601)):
        one = torch.tensor(1.0, dtype=F64)
        _, _, moved = GLVDPlant(T, 1.0).step(one, 0 * one, 0 * one, dt, 0 * one)
        x = dt / T
        series = T * T * math.fsum((-x) ** k / math.factorial(k) for k in range(2, 30))
        assert moved.item() == pytest.approx(series, rel=1e-10)


@pytest.mark.parametrize("name", ["T_L", "K_L"])
@pytest.mark.parametrize("value", [-0.3, math.nan, math.inf, "one"])
def test_bad_lags_and_gains_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        GLVD(**{"T_L": 0.3, "K_L": 1.0, name: value})


def test_dead_actuator_is_allowed():
    assert GLVD(0.3, 0.0).rollout(1.0, torch.ones(1000, dtype=F64), 0.01)[-1].abs() < 1e-13


def test_other_bad_arguments():
    u = torch.ones(3, dtype=F64)
    with pytest.raises(InputError, match="method"):
        GLVD(0.3, 1.0).rollout(0.0, u, 0.01, method="rk4")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="T_L"):
        GLVD(0.0, 1.0)
    for dt in (0.0, -0.01, math.nan, math.inf):
        with pytest.raises(InputError, match="dt"):
            GLVD(0.3, 1.0).rollout(0.0, u, dt)
    with pytest.raises(InputError, match="u:"):
        glvd_rollout(0.0, torch.tensor(1.0), 0.3, 1.0, 0.01)
    with pytest.raises(InputError, match="broadcasts"):
        GLVD(torch.ones(2), torch.ones(3))


def test_module_is_trained_by_torch():
    model = GLVD(0.6, 0.7)
    u = torch.sin(torch.arange(300, dtype=F64) * 0.05)
    target = glvd_rollout(0.0, u, 0.3, 1.0, 0.01)
    optimizer = torch.optim.LBFGS(
        model.parameters(), max_iter=60, line_search_fn="strong_wolfe", tolerance_change=1e-16
    )

    def closure():
        optimizer.zero_grad()
        loss = ((model.rollout(0.0, u, 0.01) - target) ** 2).sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    assert model.T_L.item() == pytest.approx(0.3, abs=1e-4)
    assert model.K_L.item() == pytest.approx(1.0, abs=1e-4)


# Second-order lags: closed-form step responses, an independent solver, gradients, bad arguments.
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
