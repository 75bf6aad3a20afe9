"""The reference vehicle: GLVD exactly without a cause, every cause by its strength and onset, and plausible drives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch.errors import InputError
from benchmarks.blindtest.car import Car, draw_car
from benchmarks.blindtest.catalogue import CALIBRATION, EFFECTS, SEALED, family
from benchmarks.blindtest.drives import (
    ACCEL_MAX_MPS2,
    ACCEL_MIN_MPS2,
    MANOEUVRES,
    DrivePlan,
    Recorded,
    draw_drive,
    with_stops,
)
from benchmarks.blindtest.vehicle import Run, simulate
from tests.bars import BAR

CAR = Car(T_L=0.37, K_L=0.93).silent()
RATE = 50


def glvd(command: np.ndarray, dt: float = 1 / RATE, T_L: float = CAR.T_L, K_L: float = CAR.K_L) -> np.ndarray:
    """Closed form: a[k+1] = alpha a[k] + K (1 - alpha) u[k], from rest."""
    alpha = np.exp(-dt / T_L)
    return np.asarray(lfilter([0.0, K_L * (1 - alpha)], [1.0, -alpha], command))


def command(seconds: float = 20.0, rate: int = RATE) -> np.ndarray:
    """Steps and a wave, small enough that the car never stops."""
    t = np.arange(round(seconds * rate)) / rate
    return 0.8 * np.sin(1.3 * t) + np.where((t % 4) < 2, 0.7, -0.7)


def drive(effects: dict[str, dict[str, float]] | None = None, *, car: Car = CAR, onset: float = 0.0, **more) -> Run:
    u = more.pop("u", command())
    pilot = Recorded(u, start_speed=more.pop("start_speed", 20.0))
    return simulate(car, pilot, seconds=len(u) / RATE, rate_hz=RATE, effects=effects, onset=onset, **more)


@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
@pytest.mark.parametrize("rate", [20, 100])
def test_without_effects_and_noise_it_is_the_closed_form(manoeuvre: str, rate: int) -> None:
    made = DrivePlan(manoeuvre, 60.0, rate, 4)  # type: ignore[arg-type]
    run = simulate(CAR, made.pilot(), seconds=60.0, rate_hz=rate)
    moving = run.true_speed > 0.3
    assert moving.mean() > 0.5
    np.testing.assert_allclose(run.accel[moving], glvd(run.command, 1 / rate)[moving], atol=1e-6, rtol=0)


def test_speed_and_position_are_the_integrals() -> None:
    u = command()
    run = drive(u=u)
    a, dt = glvd(u), 1 / RATE
    # the integral of T da/dt = K u - a over the drive
    speed = 20.0 + CAR.K_L * np.concatenate([[0.0], np.cumsum(u)[:-1]]) * dt - CAR.T_L * a
    np.testing.assert_allclose(run.speed, speed, atol=1e-5, rtol=0)
    simpson = np.concatenate([[0.0], np.cumsum(0.5 * dt * (speed[1:] + speed[:-1]) - dt**2 / 12 * np.diff(a))])
    np.testing.assert_allclose(run.position, simpson, atol=1e-4, rtol=0)


def test_noise_of_the_car_is_superposed_and_reported() -> None:
    effects = {"speed_lag": {"lag_s": 0.4}}
    noisy = Car(T_L=CAR.T_L, K_L=CAR.K_L, process_sd=0.1, accel_sd=0.1, speed_sd=0.05, speed_quantum=0.02)
    run = drive(car=noisy, effects=effects)
    np.testing.assert_allclose(run.accel - run.noise_accel, glvd(run.command), atol=1e-6, rtol=0)
    clean = drive(effects=effects).speed
    np.testing.assert_allclose(run.speed - run.noise_speed - run.drift_speed, clean, atol=1e-5, rtol=0)
    np.testing.assert_allclose(run.speed / 0.02, np.round(run.speed / 0.02), atol=1e-6)


@pytest.mark.statistical
def test_noise_has_the_size_and_memory_stated(rotating_seed: int) -> None:
    car = Car(T_L=0.3, process_sd=0.08, accel_sd=0.0, speed_sd=0.04)
    run = drive(car=car, u=np.zeros(60 * RATE), seed=rotating_seed)
    n = run.noise_accel
    # an OU process over 60 s with a memory of 0.3 s: about 100 samples' worth, the SD within 5 times 7 %
    assert n.std() == pytest.approx(0.08, rel=0.35)
    lag = np.mean(n[:-15] * n[15:]) / np.mean(n**2)
    assert lag == pytest.approx(np.exp(-1), abs=0.45)
    assert run.noise_speed.std() == pytest.approx(0.04, rel=BAR / np.sqrt(2 * len(n)))


def test_same_seed_same_log_and_another_seed_another() -> None:
    car, effects = Car(), {"gust": {"sd_mps2": 0.2, "time_constant_s": 2.0}, "command_hold": {"hold_fraction": 0.2}}
    one, two, other = (drive(effects, car=car, seed=s) for s in (5, 5, 6))
    for name in vars(one):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert np.abs(one.accel - other.accel).max() > 0.01
    np.testing.assert_array_equal(drive(car=car, seed=5).noise_accel, one.noise_accel)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*EFFECTS, *CALIBRATION, *SEALED])
def test_every_cause_vanishes_with_its_strength_and_shows_at_full(name: str) -> None:
    made = DrivePlan("stop_and_go" if name == "low_speed_creep" else "steps", 30.0, RATE, 8)
    draw = family(name).draw(np.random.default_rng(1), CAR, made)
    far: list[float] = []
    for strength in (1e-4, family(name).strongest):
        run = simulate(
            Car(CAR.T_L, CAR.K_L, 0.0, 0.05, 0.0),
            made.pilot(),
            seconds=30.0,
            rate_hz=RATE,
            effects={name: draw(strength)},
        )
        moving = run.true_speed > 0.3
        error = (run.accel - run.noise_accel - glvd(run.command))[moving]
        slip = (run.speed - run.noise_speed - run.true_speed)[moving]
        far.append(float(np.sqrt(np.mean(error**2) + np.mean(slip**2))))
    assert far[0] < 2e-3
    assert far[1] > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", [*EFFECTS, *CALIBRATION, *SEALED])
def test_before_its_onset_no_cause_leaves_a_trace(name: str) -> None:
    draw = family(name).draw(np.random.default_rng(1), CAR, DrivePlan("steps", 20.0, RATE, 1))
    parameters = draw(min(2.0, family(name).strongest))
    if name == "gain_change":
        parameters["change_s"] = 10.0
    late = drive({name: parameters}, car=Car(), onset=10.0)
    plain = drive(car=Car())
    early = late.time < 10.0 - 1e-9
    np.testing.assert_allclose(late.accel[early], plain.accel[early], atol=1e-9, rtol=0)
    np.testing.assert_allclose(late.speed[early], plain.speed[early], atol=1e-9, rtol=0)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(InputError, match="rate_hz"):
        simulate(CAR, Recorded(np.zeros(9), start_speed=9.0), seconds=1.0, rate_hz=30)
    with pytest.raises(InputError, match="onset"):
        drive(onset=99.0)
    with pytest.raises(InputError, match="T_L"):
        Car(T_L=0.0)
    with pytest.raises(InputError, match="effect"):
        family("ghost")


# Drives are plausible: no collision, no runaway, commands within limits, the stated manoeuvre.
@pytest.mark.slow
@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
def test_ordinary_drives(manoeuvre: str) -> None:
    rng = np.random.default_rng(3)
    for seed in range(4):
        made = DrivePlan(manoeuvre, 60.0, 25, seed)  # type: ignore[arg-type]
        pilot = made.pilot()
        run = simulate(draw_car(rng), pilot, seconds=60.0, rate_hz=25, seed=seed)
        assert run.command.min() >= ACCEL_MIN_MPS2 - 0.2
        assert run.command.max() <= ACCEL_MAX_MPS2
        assert run.true_speed.max() < 42
        assert run.command.std() > 0.05
        assert getattr(pilot, "nearest", 1.0) > 0
        assert np.mean(run.true_speed > 0.3) > 0.5


def test_manoeuvres_differ_as_their_names_say() -> None:
    def mean_speed(manoeuvre: str) -> float:
        made = DrivePlan(manoeuvre, 60.0, 20, 2)  # type: ignore[arg-type]
        return float(simulate(Car(), made.pilot(), seconds=60.0, rate_hz=20).true_speed.mean())

    assert mean_speed("stop_and_go") < 10 < mean_speed("cruise")


def test_drive_is_repeatable_and_checked() -> None:
    made = DrivePlan("following", 60.0, 20, 7)
    one, two = (simulate(Car(), made.pilot(), seconds=60.0, rate_hz=20).command for _ in range(2))
    np.testing.assert_array_equal(one, two)
    with pytest.raises(InputError, match="manoeuvre"):
        DrivePlan("drift", 60.0, 20, 7)  # type: ignore[arg-type]
    drawn = draw_drive(np.random.default_rng(0), seconds=60.0, manoeuvre="steps")
    assert (drawn.seconds, drawn.manoeuvre) == (60.0, "steps")


@pytest.mark.parametrize("manoeuvre", ["cruise", "steps"])
def test_a_drive_with_stops_stands_and_goes_on(manoeuvre: str, fresh_seed: int) -> None:
    plan = DrivePlan(manoeuvre, 120.0, 20, fresh_seed % 2**31, stops=True)  # type: ignore[arg-type]
    run = simulate(Car(), plan.pilot(), seconds=120.0, rate_hz=20, seed=1)
    still = run.true_speed < 0.1
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    assert len(edges) == 2  # one stop
    assert 2.0 <= (edges[1] - edges[0]) / 20 < 9.0  # drawn up to 6 s, and what the car needs to stop and start
    assert run.true_speed[-1] > 1.0
    assert run.true_speed.max() < 42
    assert run.command.min() >= ACCEL_MIN_MPS2 - 0.2
    assert np.mean(~still) > 0.5


def test_every_other_drive_without_a_standstill_gets_one() -> None:
    plans = [with_stops(DrivePlan(m, 60.0, 20, seed)) for m in MANOEUVRES for seed in (4, 5)]  # type: ignore[arg-type]
    assert {p.manoeuvre for p in plans if p.stops} == {"cruise", "steps"}
    assert all(p.seed == 4 for p in plans if p.stops)
    assert not with_stops(DrivePlan("cruise", 20.0, 20, 4)).stops  # too short
