"""Causes against their closed forms, where they have one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from benchmarks.blindtest.car import Car
from benchmarks.blindtest.command import losses
from benchmarks.blindtest.drives import Recorded
from benchmarks.blindtest.vehicle import Run, simulate
from tests.bars import BAR

CAR = Car(T_L=0.37, K_L=0.93).silent()
RATE, DT = 50, 0.02
TIME = np.arange(1000) * DT
COMMAND = 0.8 * np.sin(1.3 * TIME) + np.where((TIME % 4) < 2, 0.7, -0.7)


def glvd(command: np.ndarray, dt: float = DT, T_L: float = CAR.T_L) -> np.ndarray:
    alpha = np.exp(-dt / T_L)
    return np.asarray(lfilter([0.0, CAR.K_L * (1 - alpha)], [1.0, -alpha], command))


def drive(name: str, *, u: np.ndarray = COMMAND, start_speed: float = 20.0, **parameters: float) -> Run:
    return simulate(
        CAR, Recorded(u, start_speed=start_speed), seconds=len(u) * DT, rate_hz=RATE, effects={name: parameters}
    )


def close(run: Run, expected: np.ndarray, atol: float = 1e-6) -> None:
    np.testing.assert_allclose(run.accel, expected, atol=atol, rtol=0)


def test_dead_time_of_whole_rows_shifts() -> None:
    close(drive("dead_time", delay_s=0.2), glvd(np.concatenate([np.zeros(10), COMMAND[:-10]])))


def test_dead_time_of_a_fraction_of_a_millisecond() -> None:
    # a step that arrives 0.2 + 0.0137 s after it was sent
    run = drive("dead_time", u=np.ones(200), delay_s=0.2137)
    since = np.maximum(run.time - 0.2137, 0.0)
    close(run, CAR.K_L * -np.expm1(-since / CAR.T_L), atol=1e-5)


def test_dead_band_is_a_soft_threshold() -> None:
    close(
        drive("dead_band", half_width_mps2=0.2),
        glvd(np.sign(COMMAND) * np.maximum(np.abs(COMMAND) - 0.2, 0)),
    )


def test_backlash_is_the_play_operator() -> None:
    played, state = [], 0.0
    for u in COMMAND:
        state = min(max(state, u - 0.2), u + 0.2)
        played.append(state)
    close(drive("backlash", half_width_mps2=0.2), glvd(np.array(played)))


def test_saturation_holds_the_target_back() -> None:
    run = drive("saturation", accel_max_mps2=0.8, accel_min_mps2=-0.9)
    assert run.accel.max() <= 0.8
    assert run.accel.min() >= -0.9
    limited = glvd(np.clip(COMMAND, -0.9 / CAR.K_L, 0.8 / CAR.K_L))
    close(run, limited, atol=0.04 * 0.9)  # the knee


def test_second_order_actuator_is_its_transfer_function() -> None:
    omega, zeta = 6.0, 0.35
    num, den = [CAR.K_L * omega**2], [1.0, 2 * zeta * omega, omega**2]
    b, a, _ = cont2discrete((num, den), DT, method="zoh")
    run = drive("second_order_actuator", natural_frequency_radps=omega, damping_ratio=zeta)
    close(run, np.asarray(lfilter(np.ravel(b), a, COMMAND)))


def test_rate_limit_bounds_the_jerk_and_nothing_else() -> None:
    run = drive("rate_limit", jerk_max_mps3=1.0)
    assert np.abs(np.diff(run.accel)).max() <= 1.0 * DT + 1e-9
    close(drive("rate_limit", jerk_max_mps3=100.0), glvd(COMMAND))


def test_a_falling_acceleration_has_a_limit_of_its_own() -> None:
    run = drive("rate_limit", jerk_max_mps3=1.0, fall_ratio=0.5)
    change = np.diff(run.accel) / DT
    assert change.max() == pytest.approx(1.0, rel=1e-6)
    assert change.min() == pytest.approx(-0.5, rel=1e-6)


def test_nothing_acts_while_engine_and_brake_change_over() -> None:
    u = np.repeat([1.0, 0.0, -1.0], 100)
    run = drive("hand_over", u=u, pause_s=0.3)
    waited = np.where((np.arange(300) >= 200) & (np.arange(300) * DT < 200 * DT + 0.299), 0.0, u)
    close(run, glvd(waited))


def test_brake_has_its_own_gain_and_lag() -> None:
    p = {"brake_gain_ratio": 0.7, "brake_lag_ratio": 2.0}
    u = np.full(300, -0.5)
    close(drive("brake_throttle_asymmetry", u=u, **p), 0.7 * glvd(u, T_L=2 * CAR.T_L))
    close(drive("brake_throttle_asymmetry", u=-u, **p), glvd(-u))


def test_gear_shift_interrupts_drive_once_a_gear() -> None:
    run = drive(
        "gear_shift",
        u=np.ones(1000),
        start_speed=3.0,
        depth=1.0,
        duration_s=0.4,
        first_shift_mps=5.0,
        shift_ratio=1.5,
    )
    dips = np.flatnonzero(np.diff(np.sign(np.diff(run.accel))) > 0)
    speeds = run.true_speed[dips]
    shifts = 5.0 * 1.5 ** np.arange(4)
    assert len(dips) == 4
    assert np.all(np.abs(speeds - shifts) < 0.5)


def test_driveline_rings_at_its_frequency_and_settles() -> None:
    run = drive("driveline_oscillation", u=np.ones(500), frequency_hz=2.5, amplitude=0.5, damping_ratio=0.05)
    ring = run.accel - glvd(np.ones(500))
    spectrum = np.abs(np.fft.rfft(ring[:200] - ring[:200].mean()))
    assert np.fft.rfftfreq(200, DT)[np.argmax(spectrum)] == pytest.approx(2.5, abs=0.3)
    assert np.abs(ring[-50:]).max() < 0.01 * np.abs(ring).max()


def test_body_forces_at_rest_of_the_command() -> None:
    still = np.zeros(500)
    drag = drive("aerodynamic_drag", u=still, drag_per_m=4e-4, wind_mps=2.0, wind_swing_mps=0.0, wind_period_s=60.0)
    np.testing.assert_allclose(drag.true_accel[1:], -4e-4 * (drag.true_speed[1:] + 2.0) ** 2, atol=1e-6)
    # dv/dt = -c (v + w)^2 has the solution (v0 + w) / (1 + c (v0 + w) t)
    np.testing.assert_allclose(drag.true_speed, 22.0 / (1 + 4e-4 * 22.0 * drag.time) - 2.0, atol=1e-4)
    viscous = drive("viscous_drag", u=still, drag_per_s=0.01)
    np.testing.assert_allclose(viscous.true_speed, 20.0 * np.exp(-0.01 * viscous.time), atol=1e-4)
    resistance = drive("constant_resistance", u=still, resistance_mps2=0.2)
    np.testing.assert_allclose(resistance.true_accel[1:], -0.2, atol=1e-12)


def test_grade_belongs_to_the_place() -> None:
    still = np.zeros(1500)
    slow, fast = (drive("road_grade", u=still, start_speed=v, grade_rms=0.02, length_m=100.0) for v in (12.0, 24.0))
    where = np.linspace(20, 150, 200)
    np.testing.assert_allclose(
        np.interp(where, slow.position, slow.true_accel), np.interp(where, fast.position, fast.true_accel), atol=2e-3
    )
    assert slow.true_accel.std() > 0.02


def test_sensor_faults_leave_the_motion_alone() -> None:
    plain = glvd(COMMAND)
    for name, p, expected in (
        ("sensor_bias", {"bias_mps2": 0.2}, plain + 0.2),
        ("sensor_scale", {"scale": 1.1}, 1.1 * plain),
        ("tyre_radius", {"growth": 0.05}, plain),
    ):
        run = drive(name, **p)
        close(run, expected)
        np.testing.assert_allclose(run.true_accel, plain, atol=1e-6)
    fine = np.repeat(COMMAND, 20)
    lagged = lfilter([0.0, -np.expm1(-0.001 / 0.3)], [1.0, -np.exp(-0.001 / 0.3)], glvd(fine, dt=0.001))[::20]
    close(drive("sensor_lag", lag_s=0.3), np.asarray(lagged), atol=5e-3)
    late = drive("speed_lag", u=np.ones(300), lag_s=0.4)
    close(late, glvd(np.ones(300)))
    np.testing.assert_allclose((late.true_speed - late.speed)[-50:], 0.4 * CAR.K_L, atol=1e-3)  # all has settled


@pytest.mark.statistical
def test_share_of_lost_messages(rotating_seed: int, draws_factor: int) -> None:
    messages = 40_000 * draws_factor
    lost = np.array(losses(np.random.default_rng(rotating_seed), messages, 0.1))
    # bursts of 1.3 widen the spread of the share by at most 1.5
    assert lost.mean() == pytest.approx(0.1, abs=BAR * 1.5 * np.sqrt(0.09 / messages))
    assert not any(losses(np.random.default_rng(0), 100, 0.0))


@pytest.mark.statistical
def test_outliers_have_their_share_and_are_chance(rotating_seed: int, draws_factor: int) -> None:
    car = Car(accel_sd=0.05)
    u = np.zeros(6000 * draws_factor)
    run = simulate(
        car,
        Recorded(u, start_speed=20.0),
        seconds=120.0 * draws_factor,
        rate_hz=RATE,
        effects={"outliers": {"fraction": 0.03, "scale": 8.0}},
        seed=rotating_seed,
    )
    hit = run.chance_accel != 0
    assert hit.mean() == pytest.approx(0.03, abs=BAR * np.sqrt(0.03 / len(u)))
    assert np.abs(run.chance_accel[hit]).min() >= 0.6 * 8.0 * 0.05 - 1e-12
