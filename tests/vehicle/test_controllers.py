"""Controllers: the linear law and the ramp of its time gap, the lower level, and the MPC."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear

from avtorch.errors import InputError
from avtorch.vehicle import (
    MPC,
    RAMP_RATE,
    ClosedLoop,
    FollowerState,
    GLVDPlant,
    Leader,
    LinearController,
    LowerLevel,
    TimeGap,
    glvd_jerk,
    glvd_step,
    simulate,
)

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


def test_ramp_is_piecewise_linear_and_ends_at_the_target():
    gap = TimeGap(target=torch.tensor([2.5, 0.8], dtype=F64), start=1.0, since=10.0, rate=0.1)
    assert gap.at(3.0).tolist() == [1.0, 1.0]
    assert gap.at(11.0).tolist() == pytest.approx([1.1, 0.9])
    assert gap.at(13.0).tolist() == pytest.approx([1.3, 0.8])
    assert gap.done_at == pytest.approx(25.0)
    assert gap.at(25.0)[0] == pytest.approx(2.5)


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


# Lower level: pass-through, inversion, clipping, and the effective parameters it claims.
def test_default_passes_the_demand_through_to_the_bit():
    u = torch.linspace(-5.9, 3.9, 50, dtype=F64)
    assert torch.equal(LowerLevel().command(torch.full_like(u, 1.7), u), u)
    assert torch.equal(LowerLevel(1.3, 0.7, 1.3, 0.7).raw_command(u, u), u)


def test_clipping_to_floats_and_tensors():
    u = torch.tensor([-9.0, 0.5, 9.0], dtype=F64)
    assert LowerLevel().command(u, u).tolist() == [-6.0, 0.5, 4.0]
    low, high = torch.tensor([-1.0, -2.0, -3.0], dtype=F64), torch.tensor([1.0, 0.25, 3.0], dtype=F64)
    assert LowerLevel(accel_min=low, accel_max=high).command(u, u).tolist() == [-1.0, 0.25, 3.0]


@pytest.mark.parametrize("plant", [(1.5, 0.5), (0.2, 0.9), (0.7, 1.2)])
@pytest.mark.parametrize("model", [(1.5, 0.5), (1.33, 0.64), (0.3, 1.0)])
def test_effective_parameters_describe_the_jerk(plant, model):
    """Plant driven by the raw command = GLVD with (T_e, K_e), as an identity in a and u."""
    a = torch.tensor([0.3, -1.0, 2.0, 0.0], dtype=F64)
    u = torch.tensor([1.0, 0.5, -2.0, 3.0], dtype=F64)
    lower = LowerLevel(*model)
    T_e, K_e = lower.effective(*plant)
    torch.testing.assert_close(
        glvd_jerk(a, lower.raw_command(a, u), *plant), glvd_jerk(a, u, T_e, K_e), rtol=1e-12, atol=1e-12
    )
    if model == plant:
        assert T_e.item() == pytest.approx(0.3)
        assert K_e.item() == pytest.approx(1.0)


def test_amplification_is_the_high_frequency_gain():
    lower = LowerLevel(1.5, 0.5)
    assert lower.amplification().item() == pytest.approx(1.5 * 1.0 / (0.5 * 0.3))
    a = torch.tensor(0.2, dtype=F64)
    rise = lower.raw_command(a, a + 1) - lower.raw_command(a, a)
    assert rise.item() == pytest.approx(lower.amplification().item())


def test_effective_of_an_unstable_inner_loop_is_negative():
    T_e, _ = LowerLevel(0.1, 0.2).effective(0.3, 1.0)
    assert T_e < 0


def test_scenarios_have_their_own_models():
    lower = LowerLevel(torch.tensor([0.3, 1.5], dtype=F64), torch.tensor([1.0, 0.5], dtype=F64))
    a, u = torch.tensor([0.1, 0.1], dtype=F64), torch.tensor([0.2, 0.2], dtype=F64)
    assert lower.command(a, u)[0] == u[0]
    assert lower.command(a, u)[1] == LowerLevel(1.5, 0.5).command(a, u)[1]


# MPC: its box problem against SciPy's solver, its gains against differences of the law itself, and in the loop.
def independent(mpc: MPC, x: np.ndarray) -> np.ndarray:
    """The same problem posed anew: states stepped by fine substeps, cost as stacked least squares."""
    moves, fine = mpc.moves, 400
    h = mpc.step / fine

    def residuals(u: np.ndarray) -> np.ndarray:
        ds, dv, a = x
        out = []
        for move in u:
            for _ in range(fine):
                # midpoint rule over exact actuator steps
                after = a * np.exp(-h / mpc.T_hat) + mpc.K_hat * move * (1 - np.exp(-h / mpc.T_hat))
                mid = 0.5 * (a + after)
                ds, dv, a = ds + h * (dv - 0.5 * h * mid - mpc.time_gap * mid), dv - h * mid, after
            out += [np.sqrt(mpc.weights[0]) * ds, np.sqrt(mpc.weights[1]) * dv, np.sqrt(mpc.weights[2]) * a]
        return np.array([*out, *(np.sqrt(mpc.weights[3]) * u)])

    base = residuals(np.zeros(moves))
    matrix = np.stack([residuals(e) - base for e in np.eye(moves)], -1)
    found = lsq_linear(matrix, -base, (mpc.accel_min, mpc.accel_max), method="bvls", tol=1e-14, max_iter=500)
    assert found.success
    return found.x


STATES = [
    [0.5, 0.2, -0.1],
    [-20.0, -5.0, 1.0],
    [30.0, 4.0, 0.0],
    [-8.0, 6.0, -3.0],
    [3.0, -9.0, 2.0],
    [-40.0, 2.0, 0.0],
]


@pytest.mark.slow
def test_plan_against_an_independent_solver():
    mpc = MPC(weights=(1.0, 0.5, 0.2, 1.0), T_hat=0.5, K_hat=0.8)
    plans = mpc.plan(torch.tensor(STATES, dtype=F64))
    assert ((plans == mpc.accel_min) | (plans == mpc.accel_max)).any(-1).sum() >= 3, "no state meets the box"
    for x, plan in zip(STATES, plans, strict=True):
        # midpoint substeps of 0.5 ms: error about h² = 2.5e-7 relative, on moves up to 6 m/s²
        np.testing.assert_allclose(plan.numpy(), independent(mpc, np.array(x)), atol=2e-5)


def test_both_solvers_and_the_optimality_conditions_agree(fresh_seed):
    mpc = MPC()
    x = torch.randn(400, 3, dtype=F64, generator=torch.Generator().manual_seed(fresh_seed)) * torch.tensor([20.0, 5, 2])
    linear = x @ mpc._F.T
    plan = mpc.plan(x)
    scale = linear.abs().amax(-1, keepdim=True)
    torch.testing.assert_close(plan, mpc._one_by_one(linear), rtol=0, atol=1e-6)
    slope = (plan @ mpc._H + linear) / scale
    assert (slope[(plan > -6) & (plan < 4)].abs() < 1e-9).all()
    assert (slope[plan == -6] > -1e-9).all()
    assert (slope[plan == 4] < 1e-9).all()
    assert ((plan == -6) | (plan == 4)).any()


def test_equivalent_gains_are_the_differences_of_the_law():
    mpc = MPC(time_gap=1.4, T_hat=0.4, K_hat=0.9)
    at = {"spacing": 1.4 * 20 + 5, "speed": 20.0, "accel": 0.0, "lead_speed": 20.0}

    def law(**change: float) -> float:
        values = {**at, **{k: at[k] + v for k, v in change.items()}}
        tensors = {k: torch.tensor([v], dtype=F64) for k, v in values.items()}
        return mpc(FollowerState(time=0.0, lead_accel=torch.zeros(1, dtype=F64), **tensors)).item()

    h = 1e-3
    k_s, k_v, k_a = mpc.gains
    assert (law(spacing=h) - law(spacing=-h)) / (2 * h) == pytest.approx(k_s, rel=1e-8)
    assert (law(lead_speed=h) - law(lead_speed=-h)) / (2 * h) == pytest.approx(k_v, rel=1e-8)
    assert (law(accel=h) - law(accel=-h)) / (2 * h) == pytest.approx(k_a, rel=1e-8)
    assert (law(speed=h) - law(speed=-h)) / (2 * h) == pytest.approx(-(k_s * 1.4 + k_v), rel=1e-8)


def test_inside_the_box_the_mpc_drives_like_its_linear_law():
    leader = Leader.from_speed([0, 5, 10, 15, 20, 30], [20, 20.5, 21, 20.2, 20, 20])
    settings = {"plant": GLVDPlant(sigma=0.05), "duration": 25.0}
    mpc = MPC()
    run, linear = (
        simulate(leader, mpc, **settings),
        simulate(leader, LinearController(mpc.gains), **settings),
    )
    assert run.accel_cmd.abs().max() < 4
    torch.testing.assert_close(run.accel, linear.accel, rtol=0, atol=1e-10)


def test_internal_model_predicts_the_plant():
    """One held move of the prediction equals the GLVD step over it."""
    mpc = MPC(horizon=0.2, step=0.2, weights=(0.0, 0.0, 1.0, 1e-9))
    # weight on a alone: the best move brings the next acceleration to (almost) zero
    u = mpc.plan(torch.tensor([0.0, 0.0, 1.0], dtype=F64))[0]
    assert glvd_step(1.0, u, 0.3, 1.0, 0.2).abs() < 1e-6


def test_retargeted_gap_ramps():
    loop = ClosedLoop(Leader.constant(25.0, 50.0), MPC(), plant=GLVDPlant(sigma=0.0))
    loop.advance(100)
    loop.controller = loop.controller.retargeted(at=loop.time, time_gap=2.0)  # type: ignore[attr-defined]
    run = loop.advance(3500)
    assert run.accel.min() > -2.0
    assert run.spacing[0, -1].item() == pytest.approx(55.0, abs=0.02)


def test_cost_of_a_step_is_far_below_the_tick():
    """A constrained plan must fit a tick of 10 ms (processor time: the machine may be shared)."""
    mpc, x = MPC(), torch.tensor([[-20.0, -5.0, 1.0]], dtype=F64)
    times = []
    for _ in range(30):
        start = time.process_time()
        mpc.plan(x)
        times.append(time.process_time() - start)
    assert sorted(times)[15] < 0.01


NAN = float("nan")


@pytest.mark.parametrize(
    ("made", "bad"),
    [
        (LinearController, {"gains": ((1.0, 2.0), 1.0, (1.0, NAN, 0.0)), "time_gap": (-1.0,), "standstill": (-1.0,)}),
        (LinearController, {"feedforward": (float("inf"),)}),
        (LowerLevel, dict.fromkeys(("T_hat", "K_hat", "T_d", "K_d"), (0.0, -1.0, NAN)) | {"accel_min": (5.0,)}),
        (MPC, {"time_gap": (-1.0,), "horizon": (0.0, 1.03), "step": (-0.2,), "T_hat": (0.0,), "K_hat": (0.0,)}),
        (MPC, {"accel_min": (5.0,), "weights": ((1.0, 1.0, 0.0), (1.0, 1.0, 0.0, 0.0))}),
    ],
)
def test_bad_settings_are_refused(made, bad):
    for name, values in bad.items():
        for value in values:
            with pytest.raises(InputError, match=name):
                made(**{name: value})


@pytest.mark.parametrize("bad", [{"rate": 0.0}, {"since": NAN}, {"target": -1.0}])
def test_bad_ramps_are_refused(bad):
    with pytest.raises(InputError, match="time"):
        TimeGap(**{"target": 2.0, "start": 1.0} | bad)
