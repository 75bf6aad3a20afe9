"""Closed loop: against SciPy, by scenario, standstill, collision, platoon, switching, copying, speed."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from avtorch.errors import InputError
from avtorch.vehicle import (
    Block,
    ClosedLoop,
    GLVDPlant,
    Leader,
    LinearController,
    LowerLevel,
    simulate,
)
from tests.bars import BAR

F64 = torch.float64
QUIET = GLVDPlant(sigma=0.0)
WAVE = Leader.from_speed([0, 3, 6, 10, 14, 18, 22], [20, 22, 19, 16, 21, 20, 20])


def same(one: Block, other: Block, tolerance: float = 0.0) -> None:
    for name, value in vars(one).items():
        torch.testing.assert_close(value, getattr(other, name), rtol=0, atol=tolerance, msg=name, equal_nan=True)


@pytest.mark.parametrize(("T", "K", "lower"), [(0.3, 1.0, LowerLevel()), (1.5, 0.5, LowerLevel(1.33, 0.64))])
def test_motion_against_scipy(T, K, lower):
    """Command held between ticks, noise off: a, v and spacing to 1e-6 of an adaptive ODE solution."""
    controller = LinearController()
    run = ClosedLoop(WAVE, controller, plant=GLVDPlant(T, K, 0.0), lower_level=lower).advance(1500)
    gap0 = 5 + WAVE.speed[0].item()
    a, v, x = 0.0, WAVE.speed[0].item(), -gap0
    k_s, k_v, k_a = 1.5, 1.5, -0.8
    for i in range(1500):
        spacing, lead_v = WAVE.position[i].item() - x, WAVE.speed[i].item()
        seen = [run.accel[0, i].item() - a, run.speed[0, i].item() - v, run.spacing[0, i].item() - spacing]
        assert max(map(abs, seen)) < 1e-6, f"row {i}: {seen}"
        u = k_s * (spacing - v - 5) + k_v * (lead_v - v) + k_a * a
        T_hat, K_hat = float(lower.T_hat), float(lower.K_hat)
        u = min(max(T_hat / K_hat * ((1 / T_hat - 1 / 0.3) * a + u / 0.3), -6.0), 4.0)
        assert run.accel_cmd[0, i].item() == pytest.approx(u, abs=1e-5)
        assert run.jerk[0, i].item() == pytest.approx((K * u - a) / T, abs=1e-4)
        motion = solve_ivp(
            lambda _, y, u=u: [(K * u - y[0]) / T, y[0], y[1]], (0, 0.01), [a, v, x], "DOP853", rtol=1e-11, atol=1e-12
        )
        a, v, x = motion.y[:, -1]


def test_held_noise_against_scipy():
    start, speed, command, noise = (torch.tensor(q, dtype=F64) for q in (0.5, 10.0, -1.0, 0.3))
    a, v, x = GLVDPlant(0.4, 0.8, 0.1).step(start, speed, command, 0.01, noise)
    motion = solve_ivp(
        lambda _, y: [(0.8 * -1.0 - y[0]) / 0.4 + 0.3, y[0], y[1]], (0, 0.01), [0.5, 10.0, 0.0], rtol=1e-11, atol=1e-13
    )
    np.testing.assert_allclose([a.item(), v.item(), x.item()], motion.y[:, -1], rtol=0, atol=1e-11)


def test_euler_loop_converges_with_order_one():
    errors = []
    one, none = torch.ones(1, dtype=F64), torch.zeros(1, dtype=F64)
    exact = GLVDPlant(0.5, 0.8, 0.0).step(0.5 * one, 20 * one, one, 2.0, none)
    for dt in (0.02, 0.01, 0.005):
        # commands at ticks depend on dt as well, so drive the plant open loop
        n = round(2.0 / dt)
        plant = GLVDPlant(0.5, 0.8, 0.0, method="euler")
        a, v, moved = 0.5 * one, 20 * one, none
        for _ in range(n):
            a, v, d = plant.step(a, v, one, dt, none)
            moved = moved + d
        errors.append([abs(moved - exact[2]).item(), abs(v - exact[1]).item()])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.abs(orders[-1] - 1).max() < 0.03, orders


def test_a_scenario_is_the_same_alone_in_a_batch_and_in_blocks():
    plants = [(0.3, 1.0, 0.1), (1.5, 0.5, 0.3), (0.8, 0.7, 0.1)]
    lags, gains, sigmas = torch.tensor(plants, dtype=F64).unbind(-1)
    together = ClosedLoop(
        WAVE,
        plant=GLVDPlant(T_L=lags, K_L=gains, sigma=sigmas),
        scenarios=3,
        seeds=[7, 1, 900],
    )
    batch = Block.concatenate([together.advance(n) for n in (1, 10, 1013, 300, 76)])
    for i, (plant, seed) in enumerate(zip(plants, (7, 1, 900), strict=True)):
        alone = ClosedLoop(WAVE, plant=GLVDPlant(*plant), seeds=seed).advance(1400)
        # elementwise arithmetic throughout: the very same bits, unless vector and scalar kernels round apart
        torch.testing.assert_close(batch.accel[i], alone.accel[0], rtol=0, atol=1e-11)
        torch.testing.assert_close(batch.jerk[i], alone.jerk[0], rtol=0, atol=1e-9)


@pytest.mark.statistical
def test_jerk_noise_has_the_stated_law(rotating_seed, draws_factor):
    seeds = [rotating_seed + i for i in range(20 * draws_factor)]
    run = ClosedLoop(WAVE, plant=GLVDPlant(0.4, 0.9, 0.25), scenarios=len(seeds), seeds=seeds).advance(2000)
    noise = run.jerk - (0.9 * run.accel_cmd - run.accel) / 0.4
    n = noise.numel()
    assert abs(noise.mean().item()) < BAR * 0.25 / n**0.5
    assert abs(noise.std().item() / 0.25 - 1) < BAR / (2 * n) ** 0.5
    for lag in (noise[:, 1:] * noise[:, :-1], noise[1:] * noise[:-1]):
        assert abs(lag.mean().item()) < BAR * 0.25**2 / lag.numel() ** 0.5
    # and it is what moved the car: the row's draw acts over that row's step
    step = GLVDPlant(0.4, 0.9, 0.25).step(
        run.accel[:, :-1], run.speed[:, :-1], run.accel_cmd[:, :-1], 0.01, noise[:, :-1]
    )
    torch.testing.assert_close(step[0], run.accel[:, 1:], rtol=0, atol=1e-11)


def test_standstill_holds_and_starts_again():
    leader = Leader.from_speed([0, 5, 12, 30, 36, 60], [8, 8, 0, 0, 6, 6])
    run = ClosedLoop(leader, plant=GLVDPlant(sigma=0.2), scenarios=5).advance(5800)
    assert run.speed.min() == 0
    assert not run.collided.any()
    still = (run.speed == 0) & (run.accel == 0)
    # noise may lift the actuator over zero for a moment: creeping by millimetres, never back
    assert still[:, 2200:2600].double().mean() > 0.2
    assert run.speed[:, 2200:2600].max() < 0.02
    assert (run.jerk[still] == 0).all()
    assert (run.speed[:, -1] - 6).abs().max() < 0.2
    assert run.spacing[:, 2600].min() > 4.0
    rest = run.spacing[:, 2210:2600].diff()
    assert rest.max() < 1e-9
    assert (rest[still[:, 2210:2599] & still[:, 2211:2600]].abs() < 1e-9).all(), "moves while it stands"


def test_a_stop_takes_the_way_of_its_deceleration():
    """Full braking from 10 m/s: v²/2a and the lag's share, to the accuracy of one step's end."""
    leader = Leader.constant(0.0, 20.0)
    run = ClosedLoop(
        leader, lambda s: torch.full_like(s.speed, -4.0), plant=GLVDPlant(0.3, 1.0, 0.0), speed0=10.0, spacing0=60.0
    ).advance(1000)
    # v(t) = 10 - 4 (t - T(1 - e^{-t/T})): rest at t = 2.8 (e^{-9} neglected), way = ∫ v
    t = 10 / 4 + 0.3
    way = 10 * t - 2 * t * t + 4 * 0.3 * t - 4 * 0.09
    assert 60 - run.spacing[0, -1].item() == pytest.approx(way, abs=2e-3)


def test_collision_is_flagged_and_visible():
    leader = Leader.from_speed([0, 2, 4, 20], [25, 25, 0, 0])
    loop = ClosedLoop(
        leader,
        plant=GLVDPlant(torch.tensor([0.3, 1.5], dtype=F64), torch.tensor([1.0, 0.3], dtype=F64)),
        scenarios=2,
        spacing0=20.0,
    )
    assert not loop.collided.any()
    run = loop.advance(1500)
    assert run.spacing[1].min() < 0
    assert run.collided.tolist()[1]
    assert loop.collided.tolist() == run.collided.tolist()
    later = loop.advance(10)
    assert loop.collided[1], "stays set"
    assert torch.isfinite(later.spacing).all()
    log = run.log(scenario=1)
    assert len(log.time) == int((run.spacing[1] <= 0).nonzero()[0])


def test_platoon_follows_the_vehicle_in_front():
    platoon = simulate(WAVE, vehicles=4, scenarios=2, plant=GLVDPlant(0.4, 0.9, 0.1), duration=18.0, seeds=3)
    assert platoon.spacing.shape == (2, 4, 1800)
    assert torch.equal(platoon.lead_speed[:, 1:], platoon.speed[:, :-1])
    # vehicle 2 alone, behind a leader that drives like vehicle 1, noise off
    quiet = simulate(WAVE, vehicles=2, plant=QUIET, duration=18.0)
    v, a = quiet.speed[0, 0], quiet.accel[0, 0]
    position = torch.cat([v[:1] * 0, torch.cumulative_trapezoid(v, dx=0.01)]) - 0.01**2 / 12 * (a - a[0])
    front = Leader(quiet.time, position, v, a, 0.01)
    alone = simulate(front, plant=QUIET, duration=17.99)
    torch.testing.assert_close(alone.speed[0, 0], quiet.speed[0, 1, :1799], rtol=0, atol=1e-6)
    torch.testing.assert_close(alone.spacing[0, 0], quiet.spacing[0, 1, :1799], rtol=0, atol=1e-6)


def test_platoon_noise_differs_by_vehicle_and_first_vehicle_is_the_single_one():
    one = simulate(WAVE, vehicles=1, duration=5.0)
    three = simulate(WAVE, vehicles=3, duration=5.0)
    torch.testing.assert_close(one.jerk[0, 0], three.jerk[0, 0], rtol=0, atol=1e-9)
    noise = three.jerk - (three.accel_cmd - three.accel) / 0.3
    correlation = torch.corrcoef(noise[0])
    assert (correlation - torch.eye(3, dtype=F64)).abs().max() < 5 / 500**0.5


@pytest.mark.slow
def test_unstable_string_amplifies_along_the_platoon_and_stable_does_not():
    leader = Leader.from_speed(np.arange(0, 60, 0.5), 20 + 0.3 * np.sin(0.8 * np.arange(0, 60, 0.5)), smooth_s=0.0)
    for plant, grows in ((QUIET, False), (GLVDPlant(1.5, 0.5, 0.0), True)):
        run = simulate(leader, plant=plant, vehicles=4, duration=58.0)
        swing = run.speed[0, :, 3000:].std(-1)
        assert ((swing[1:] > swing[:-1]) == grows).all()


def test_switching_plant_controller_and_lower_level_in_a_schedule():
    changed = GLVDPlant(1.5, 0.5, 0.1)
    run = simulate(
        WAVE, schedule=[(5.0, {"plant": changed}), (8.0, {"lower_level": LowerLevel(1.5, 0.5)})], duration=12.0
    )
    loop = ClosedLoop(WAVE)
    parts = [loop.advance(500)]
    loop.plant = changed
    parts.append(loop.advance(300))
    loop.lower_level = LowerLevel(1.5, 0.5)
    parts.append(loop.advance(400))
    torch.testing.assert_close(run.speed[:, 0], Block.concatenate(parts).speed, rtol=0, atol=1e-11)
    with pytest.raises(InputError, match="schedule"):
        simulate(WAVE, schedule=[(5.0, {"leader": WAVE})], duration=12.0)


def test_copy_is_independent_and_replays():
    loop = ClosedLoop(WAVE, scenarios=3)
    loop.advance(700)
    twin = loop.copy()
    ahead = twin.advance(600)
    assert loop.steps_done == 700
    same(ahead, loop.advance(600))


def test_candidates_are_tried_side_by_side():
    loop = ClosedLoop(WAVE, scenarios=3)
    loop.advance(300)
    gaps = torch.tensor([[1.0], [1.6], [2.5]], dtype=F64)
    trial = loop.copy(candidates=3)
    trial.controller = LinearController(time_gap=gaps)
    trial.plant = GLVDPlant(sigma=torch.tensor([[0.1], [0.2], [0.0]], dtype=F64))
    block = trial.advance(500)
    assert block.speed.shape == (3, 3, 500)
    for i, sigma in enumerate((0.1, 0.2, 0.0)):
        single = loop.copy()
        single.controller, single.plant = LinearController(time_gap=gaps[i, 0]), GLVDPlant(sigma=sigma)
        torch.testing.assert_close(block.accel[i], single.advance(500).accel, rtol=0, atol=1e-11)


def test_link_delay_shows_an_older_acceleration():
    seen = []

    def watch(state):
        seen.append(state.lead_accel.clone())
        return torch.zeros_like(state.speed)

    loop = ClosedLoop(WAVE, watch, link_delay=0.2)
    loop.advance(150)
    run = loop.advance(150)
    delayed = torch.stack(seen).reshape(-1)
    assert torch.equal(delayed[20:300], WAVE.accel[:280])
    assert torch.equal(run.lead_accel[0], WAVE.accel[150:300])


def test_feedforward_reduces_the_spacing_error():
    errors = []
    # a steady acceleration A asks Δs = A (1 - k_a - k_v - k_f) / k_s at K = 1 and tau = 1: none at k_f = 0.3
    for k_f in (0.0, 0.3):
        run = simulate(WAVE, LinearController(feedforward=k_f), plant=QUIET, duration=20.0)
        errors.append((run.spacing - run.speed - 5).square().mean().item())
    assert errors[1] < 0.5 * errors[0]


def test_any_callables_do():
    def kinematic(a, v, u, dt, eps):
        return u, v + dt * u, dt * v

    run = ClosedLoop(WAVE, lambda s: 0.4 * (s.lead_speed - s.speed), plant=kinematic).advance(400)
    assert torch.isnan(run.jerk).all()
    assert torch.isfinite(run.speed).all()
    assert run.log().jerk is None


def test_physical_limits_bound_the_acceleration_but_not_the_command():
    leader = Leader.from_speed([0, 2, 6, 30], [5, 5, 20, 20])
    run = simulate(leader, plant=GLVDPlant(sigma=0.0, accel_max=1.5), duration=25.0)
    assert run.accel.max() <= 1.5
    assert run.accel_cmd.max() > 2.0
    target = run.accel_cmd.clamp(max=1.5)
    torch.testing.assert_close(run.jerk, (target - run.accel) / 0.3, rtol=0, atol=1e-9)


def test_log_round_trip():
    run = simulate(WAVE, vehicles=2, duration=5.0)
    log = run.log(vehicle=1)
    np.testing.assert_array_equal(log.accel_cmd, run.accel_cmd[0, 1].numpy())
    np.testing.assert_array_equal(log.jerk, run.jerk[0, 1].numpy())


def test_clipped_is_where_the_command_differs_from_the_wish():
    leader = Leader.from_speed([0, 1, 2, 20], [20, 20, 5, 5])
    run = ClosedLoop(leader, spacing0=15.0).advance(1000)
    assert run.clipped.any()
    assert run.accel_cmd[run.clipped].unique().tolist() == [-6.0]
    assert torch.equal(run.clipped, run.demanded != run.accel_cmd)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenarios": 0}, "scenarios"),
        ({"vehicles": 0}, "vehicles"),
        ({"dt": 0.02}, "dt"),
        ({"seeds": [1, 2]}, "seeds"),
        ({"seeds": -1}, "seeds"),
        ({"spacing0": -3.0}, "spacing0"),
        ({"speed0": float("nan")}, "speed0"),
        ({"link_delay": -0.1}, "link_delay"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        ClosedLoop(WAVE, **arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"T_L": 0.0},
        {"T_L": -1.0},
        {"K_L": -0.1},
        {"sigma": -0.1},
        {"method": "rk4"},
        {"accel_min": 1.0, "accel_max": 0.0},
    ],
)
def test_bad_plants_are_refused(arguments):
    with pytest.raises(InputError, match=next(iter(arguments))):
        GLVDPlant(**arguments)


def test_running_off_the_leader_or_a_broken_controller_is_an_error():
    loop = ClosedLoop(WAVE)
    with pytest.raises(InputError, match="ends at"):
        loop.advance(5000)
    with pytest.raises(InputError, match="steps"):
        loop.advance(0)
    broken = ClosedLoop(WAVE, lambda s: s.speed * (float("nan") if s.time > 1 else 0.0))
    with pytest.raises(InputError, match=r"not finite at 1\.01 s"):
        broken.advance(300)
    assert broken.steps_done == 0


@pytest.mark.slow
@pytest.mark.parametrize(("scenarios", "seconds"), [(1, 2.5), (200, 10.0)])
def test_8000_steps_are_quick(scenarios, seconds):
    leader = Leader.default(duration=80.0)
    best = []
    for _ in range(2):  # processor time, the better of two: the machine may be shared
        start = time.process_time()
        ClosedLoop(leader, scenarios=scenarios).advance(8000)
        best.append(time.process_time() - start)
    assert min(best) < seconds
