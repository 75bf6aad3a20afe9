"""Every effect: nothing at its neutral value, the same over a whole drive as step by step, right derivatives."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from avtorch import gap
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, Effect, GapPlant, SimulatorInput, plant
from avtorch.gap.simulator.effect import effect_class
from avtorch.vehicle import Block, GLVDPlant
from tests.bars import BAR
from tests.gap.drives import drive_of, driven, filled, smooth_drive

D = torch.float64
TABLE = {
    "dead_time": ("command", "delay_s"),
    "command_hold": ("command", "hold_fraction"),
    "dead_band": ("command", "half_width_mps2"),
    "backlash": ("command", "half_width_mps2"),
    "hand_over": ("command", "pause_s"),
    "saturation": ("command", "accel_max_mps2", "accel_min_mps2"),
    "brake_throttle_asymmetry": ("actuator", "brake_gain_ratio", "brake_lag_ratio"),
    "second_order_actuator": ("actuator", "natural_frequency_radps", "damping_ratio"),
    "rate_limit": ("actuator", "jerk_max_mps3", "fall_ratio"),
    "speed_dependent_lag": ("actuator", "lag_slope"),
    "speed_dependent_gain": ("actuator", "gain_slope"),
    "gain_change": ("actuator", "gain_ratio", "change_s"),
    "gear_shift": ("actuator", "depth", "duration_s"),
    "driveline_oscillation": ("body", "frequency_hz", "amplitude"),
    "aerodynamic_drag": ("body", "drag_per_m"),
    "viscous_drag": ("body", "drag_per_s"),
    "road_grade": ("body", "grade_rms"),
    "constant_resistance": ("body", "resistance_mps2"),
    "low_speed_creep": ("body", "creep_mps2"),
    "gust": ("body", "sd_mps2", "time_constant_s"),
    "sensor_lag": ("sensor", "lag_s"),
    "sensor_bias": ("sensor", "bias_mps2"),
    "sensor_scale": ("sensor", "scale"),
    "speed_lag": ("sensor", "lag_s"),
    "outliers": ("sensor", "fraction", "scale"),
}
EVERY = [EFFECTS[name] for name in TABLE]
FIXED = [cls for cls in EVERY if not cls.random]
BY_NAME = {"ids": lambda cls: cls.name}

# settings under which an effect does something in the drive of the tests
ACTIVE = {"gain_change": {"change_s": 5.003, "ramp_s": 2.0}}


def active(cls: type[Effect]) -> Effect:
    return cls(**ACTIVE.get(cls.name, {}))


@cache
def without_effect(T_L: float, K_L: float, *, seconds: float = 4.0, speed0: float = 12.0, **noise: float) -> Block:
    return driven(GLVDPlant(T_L, K_L, **noise), seconds=seconds, speed0=speed0)


def test_all_effects_of_the_contract_with_their_keys() -> None:
    assert {name for name in EFFECTS if name in TABLE} == set(TABLE)
    for name, (place, *keys) in TABLE.items():
        cls = EFFECTS[name]
        assert cls.place == place
        assert list(cls().report(torch.tensor(0.3, dtype=D))) == keys
        assert cls.meaning
        assert cls.equation
        for p in cls.parameters:
            assert p.low < float(p.typical().reshape(-1)[0]) < p.high


@pytest.mark.parametrize("cls", EVERY, **BY_NAME)
def test_neutral_is_glvd(cls: type[Effect]) -> None:
    glvd, car = without_effect(0.4, 0.8), driven(plant([cls.neutral()], T_L=0.4, K_L=0.8), seconds=4.0)
    for name, size in (("accel", 1e-14), ("speed", 1e-12), ("spacing", 1e-7)):  # spacing is 1e6 m with its rounding
        torch.testing.assert_close(getattr(car, name), getattr(glvd, name), rtol=0, atol=size)


@pytest.mark.parametrize(
    "cls", [pytest.param(cls, marks=pytest.mark.slow if cls.name == "road_grade" else []) for cls in FIXED], **BY_NAME
)
def test_whole_drive_is_step_by_step(cls: type[Effect]) -> None:
    car = filled(plant([active(cls)], sigma=0.0))
    first = 2.0 if cls.name == "low_speed_creep" else 12.0
    block = driven(car, seconds=7.5, speed0=first)
    assert float(block.speed.min()) > 1.0
    without = without_effect(0.3, 1.0, seconds=7.5, speed0=first, sigma=0.0)
    shown = block.speed if cls.reading == "speed" else block.accel
    bare = without.speed if cls.reading == "speed" else without.accel
    assert float((shown - bare).abs().max()) > 1e-3, "the effect does something here"
    response = car.response(drive_of(block))
    # the first row is the loop's own, not the sensor's
    torch.testing.assert_close(response.accel_measured[1:], block.accel[0, 1:], rtol=0, atol=1e-9)
    torch.testing.assert_close(response.speed_measured, block.speed[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "names",
    [
        ("dead_time", "rate_limit", "brake_throttle_asymmetry"),
        ("dead_time", "second_order_actuator", "brake_throttle_asymmetry", "speed_dependent_lag"),
        ("second_order_actuator", "rate_limit", "dead_time"),
        pytest.param(
            ("aerodynamic_drag", "driveline_oscillation", "sensor_lag", "sensor_scale"), marks=pytest.mark.slow
        ),
        pytest.param(
            ("backlash", "dead_band", "saturation", "dead_time", "gear_shift", "road_grade"), marks=pytest.mark.slow
        ),
    ],
    ids="+".join,
)
def test_together_whole_drive_is_step_by_step(names: tuple[str, ...]) -> None:
    car = filled(plant([active(EFFECTS[n]) for n in names], sigma=0.0, T_L=0.25))
    block = driven(car)
    assert float(block.speed.min()) > 0
    response = car.response(drive_of(block))
    torch.testing.assert_close(response.accel_measured[1:], block.accel[0, 1:], rtol=0, atol=1e-9)
    torch.testing.assert_close(response.speed, block.speed[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "effect",
    [
        gap.DeadTime(0.137),
        gap.RateLimit(0.9),
        gap.SecondOrderActuator(0.12),
        gap.SecondOrderActuator(0.31),
        gap.BrakeThrottleAsymmetry(0.6, 2.2),
        gap.Backlash(0.1),
    ],
    ids=lambda e: e.name,
)
@pytest.mark.parametrize("late", [False, True], ids=["", "late"])
def test_the_step_does_not_matter(effect: Effect, late: bool) -> None:
    """Commands held for 0.1 s, integrated in steps of 0.1 s and of 2 ms: the same, exactly."""
    if late and effect.name == "dead_time":
        effect = gap.DeadTime(0.1)
    car = plant([effect, gap.DeadTime(0.073)] if late and effect.name != "dead_time" else [effect])
    coarse = torch.arange(120, dtype=D) * 0.1
    command = torch.sin(0.8 * coarse) + (coarse > 4).double() - 1.5 * (coarse > 8)
    fine = torch.arange(120 * 50, dtype=D) * 0.002
    one = car.response(SimulatorInput(coarse, command))
    two = car.response(SimulatorInput(fine, command.repeat_interleave(50)))
    # where brakes have another lag, a late command and its sign switch together: still the same
    torch.testing.assert_close(one.accel, two.accel[::50], rtol=0, atol=1e-9)
    torch.testing.assert_close(one.speed, two.speed[::50], rtol=0, atol=1e-9)


@pytest.mark.parametrize("damping", [0.05, 0.999, 1.0, 1.001, 1.5, 4.0])
def test_driveline_at_any_damping_against_an_ode_solver(damping: float) -> None:
    from scipy.integrate import solve_ivp

    omega, T = 2 * math.pi * 2.2, 0.3
    effect = gap.DrivelineOscillation(2.2, 1.0, 0.5, torch.tensor(damping, dtype=D, requires_grad=True))
    time = torch.arange(200, dtype=D) * 0.01
    lagged = 1 - torch.exp(-time / T)
    got = effect.over(
        lagged, gap.EffectContext(time, torch.tensor(0.01, dtype=D), None, None, torch.tensor(T), torch.tensor(1.0))
    )
    assert bool(torch.autograd.grad(got.square().sum(), effect.mode_damping)[0].isfinite())  # type: ignore[arg-type]
    # the effect holds the mean jerk of a step, and so does the reference
    jerk = (lagged.diff() / 0.01).tolist()
    state, exact = [0.0, 0.0], [0.0]
    for j in jerk:
        state = solve_ivp(
            lambda _, y, j=j: [y[1], omega * (j - omega * y[0]) - 2 * damping * omega * y[1]],
            (0, 0.01), state, rtol=1e-10, atol=1e-12,
        ).y[:, -1].tolist()  # fmt: skip
        exact.append(state[0] + 0.5 * state[1] / omega)
    # 200 steps of the reference at 1e-10 of a size of about 1 each
    torch.testing.assert_close(got.detach(), torch.tensor(exact, dtype=D), rtol=0, atol=1e-7)


def test_second_order_against_an_ode_solver() -> None:
    from scipy.integrate import solve_ivp

    for omega, zeta in ((6.0, 0.4), (4.0, 1.0), (9.0, 1.6)):
        car = plant([gap.SecondOrderActuator.of({"natural_frequency_radps": omega, "damping_ratio": zeta})])
        time = torch.arange(60, dtype=D) * 0.05
        got = car.response(SimulatorInput(time, torch.ones_like(time), None, 0.0)).accel
        exact = solve_ivp(
            lambda _, y, w=omega, z=zeta: [y[1], w * w * (1 - y[0]) - 2 * z * w * y[1]],
            (0, 3), [0.0, 0.0], t_eval=time.numpy(), rtol=1e-11, atol=1e-12,
        )  # fmt: skip
        torch.testing.assert_close(got, torch.from_numpy(exact.y[0]), rtol=0, atol=1e-8)
        told = car.report()["second_order_actuator"]
        assert float(told["natural_frequency_radps"]) == pytest.approx(omega)
        assert float(told["damping_ratio"]) == pytest.approx(zeta)


@pytest.mark.parametrize("cls", FIXED, **BY_NAME)
@pytest.mark.parametrize("start", ["settled", "given"])
def test_gradients(cls: type[Effect], start: str) -> None:
    drive = smooth_drive(rows=40, dt=0.1)
    if start == "settled":
        drive = SimulatorInput(drive.time, drive.command, drive.speed)
    car = plant([cls]).prepared(drive)
    known = car.parameters()
    gen = torch.Generator().manual_seed(11)
    values = {}
    for name, p in known.items():
        z = 0.5 * torch.randn(2, generator=gen, dtype=D)
        values[name] = p.constrain(z).requires_grad_()
    names = list(values)

    def outputs(*given: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        r = car.response(drive, dict(zip(names, given, strict=True)))
        return r.accel_measured[..., ::7], r.speed_measured[..., ::7]

    assert torch.autograd.gradcheck(outputs, tuple(values.values()), eps=1e-7, atol=2e-6, rtol=1e-4)


@pytest.mark.parametrize(
    "name", ["second_order_actuator", "sensor_lag", "dead_time", "driveline_oscillation", "backlash"]
)
def test_gradients_are_finite_at_neutral(name: str) -> None:
    car = plant([EFFECTS[name].neutral()])
    values = {k: v.clone().requires_grad_() for k, v in car.values().items()}
    r = car.response(smooth_drive(), values)
    (r.accel_measured.sum() + r.speed.sum()).backward()
    for key, v in values.items():
        assert v.grad is not None, key
        assert torch.isfinite(v.grad).all(), key


@pytest.mark.parametrize("cls", EVERY, **BY_NAME)
def test_batches_are_the_single_ones(cls: type[Effect]) -> None:
    drive = smooth_drive()
    car = plant([cls]).prepared(drive)
    gen = torch.Generator().manual_seed(3)
    values = {name: p.sample(3, 2, generator=gen) for name, p in car.parameters().items()}
    values["T_L"] = values["T_L"][:, :1]
    batch = car.response(drive, values)
    assert batch.accel.shape == batch.speed.shape == batch.accel_measured.shape == (3, 2, len(drive.time))
    for i, j in ((0, 0), (2, 1)):
        own = {k: v[i, 0 if k == "T_L" else j] for k, v in values.items()}
        single = car.response(drive, own)
        torch.testing.assert_close(single.accel_measured, batch.accel_measured[i, j], rtol=0, atol=1e-12)
        torch.testing.assert_close(single.speed, batch.speed[i, j], rtol=0, atol=1e-12)


def test_drives_are_batched_too() -> None:
    drive = smooth_drive()
    command, speed = torch.stack([drive.command, -drive.command]), torch.stack([drive.speed, drive.speed + 1])  # type: ignore[list-item,operator]
    both = SimulatorInput(drive.time, command, speed)
    car = plant([gap.DeadTime(0.13), gap.Backlash(0.1), gap.GearShift(), gap.AerodynamicDrag()])
    delays = torch.tensor([[0.1], [0.2], [0.33]], dtype=D)
    out = car.response(both, {"dead_time.delay_s": delays})
    assert out.speed.shape == (3, 2, len(drive.time))
    one = car.response(SimulatorInput(drive.time, command[1], speed[1]), {"dead_time.delay_s": delays[2, 0]})
    torch.testing.assert_close(one.accel, out.accel[2, 1], rtol=0, atol=1e-12)


def test_dead_time_shifts() -> None:
    time = torch.arange(200, dtype=D) * 0.05
    late = plant([gap.DeadTime(0.237)]).response(SimulatorInput(time, torch.ones_like(time), None, 0.0)).accel
    assert float(late[0]) == 0.0  # before the first row its command acted, so a start at 0 m/s² heads for it
    step = torch.where(time < 1.0, 0.0, 1.0).to(D)
    late = plant([gap.DeadTime(0.237)]).response(SimulatorInput(time, step)).accel
    exact = torch.where(time < 1.237, 0.0, 1 - torch.exp(-(time - 1.237) / 0.3)).to(D)
    torch.testing.assert_close(late, exact, rtol=0, atol=1e-12)


def test_uneven_steps() -> None:
    """Thinning an even log to uneven rows where the command stands still changes nothing."""
    time = torch.arange(600, dtype=D) * 0.02
    command = torch.sin(torch.floor(time / 0.4))
    keep = torch.ones(600, dtype=torch.bool)
    keep[torch.arange(3, 597, 20)] = False  # commands change in rows 0, 20, 40, …
    speed = 12 + 0.5 * torch.sin(time)
    fast = [gap.DeadTime(0.0333), gap.SecondOrderActuator(0.2), gap.Backlash(0.05)]
    for effects in (fast, [gap.RateLimit(1.1), gap.DeadTime(0.011)], [gap.GainChange(0.7, 5.003, 1.0)]):
        car = plant(effects)
        even = car.response(SimulatorInput(time, command, speed))
        uneven = car.response(SimulatorInput(time[keep], command[keep], speed[keep]))
        size = 2e-3 if effects[0].name == "gain_change" else 1e-9  # a row takes the ramp's mean
        torch.testing.assert_close(uneven.accel, even.accel[keep], rtol=0, atol=size)
        torch.testing.assert_close(uneven.speed, even.speed[keep], rtol=0, atol=size)
    for effect in (gap.SensorLag(0.2), gap.DrivelineOscillation(), gap.Gust()):
        whole = plant([effect]).response(SimulatorInput(time[keep], command[keep], speed[keep]))
        assert torch.isfinite(whole.accel_measured).all()


def test_a_late_sensor_shows_the_standstill_after_it() -> None:
    """The car's brakes still hold while it stands; dv/dt, and what a sensor makes of it, is nought by then."""
    time = 0.05 * torch.arange(400, dtype=D)
    command = torch.where(time < 10, -1.5, 1.0).to(D)
    speed = torch.where(time < 4, 6 - 1.5 * time, torch.where(time < 10, 0.0, time - 10)).to(D)
    drive = SimulatorInput(time, command, speed)
    seen = plant([gap.SensorLag(1.0)], T_L=0.2, K_L=1.0).response(drive).accel_measured
    assert float(seen[199]) == pytest.approx(-1.5 * math.exp(-6.0), abs=0.01)
    without = replace(drive, speed=None)
    assert float(plant([gap.SensorLag(1.0)], T_L=0.2, K_L=1.0).response(without).accel_measured[199]) < -1.4


def test_sensor_faults_leave_the_car_alone() -> None:
    drive = smooth_drive()
    plain = plant().response(drive)
    for effect in (gap.SensorBias(0.1), gap.SensorScale(1.2), gap.SensorLag(0.2)):
        out = plant([effect]).response(drive)
        assert torch.equal(out.speed, plain.speed)
        assert torch.equal(out.accel, plain.accel)
        assert not torch.equal(out.accel_measured, plain.accel_measured)
    torch.testing.assert_close(plant([gap.SensorBias(0.1)]).response(drive).accel_measured, plain.accel + 0.1)
    late = plant([gap.SpeedSensorLag(0.2)]).response(drive)
    assert torch.equal(late.accel_measured, plain.accel)
    assert torch.equal(late.speed, plain.speed)
    assert not torch.equal(late.speed_measured, plain.speed)


def test_speed_is_needed_where_it_counts() -> None:
    time = torch.arange(30, dtype=D) * 0.1
    drive = SimulatorInput(time, torch.ones_like(time))
    for cls in EVERY:
        if cls.needs_speed and cls.reading == "accel":
            with pytest.raises(InputError, match="speed"):
                filled(plant([cls])).response(drive)
        else:
            assert plant([cls]).response(drive).accel.shape == time.shape


# random effects ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", [c for c in EVERY if c.random], **BY_NAME)
def test_random_effects_have_no_deterministic_response(cls: type[Effect]) -> None:
    drive = smooth_drive()
    assert torch.equal(plant([cls]).response(drive).accel_measured, plant().response(drive).accel_measured)
    drawn = plant([cls]).response(drive, generator=torch.Generator().manual_seed(1))
    again = plant([cls]).response(drive, generator=torch.Generator().manual_seed(1))
    assert torch.equal(drawn.accel_measured, again.accel_measured)


@pytest.mark.statistical
def test_gust_is_the_process_it_names(rotating_seed: int, draws_factor: int) -> None:
    sd, tau, dt, rows, count = 0.3, 2.0, 0.1, 400, 400 * draws_factor
    time = torch.arange(rows, dtype=D) * dt
    drive = SimulatorInput(time, torch.zeros(count, rows, dtype=D))
    force = plant([gap.Gust(sd, tau)]).response(drive, generator=torch.Generator().manual_seed(rotating_seed)).accel
    effective = count * rows * dt / (2 * tau)  # independent pieces of an OU process
    assert float(force.square().mean()) == pytest.approx(sd**2, abs=BAR * sd**2 * math.sqrt(2 / effective))
    lag = round(tau / dt)
    together = (force[:, lag:] * force[:, :-lag]).mean() / sd**2
    assert float(together) == pytest.approx(math.exp(-1), abs=BAR * math.sqrt(2 / effective))
    car = plant([gap.Gust(sd, tau)], sigma=0.0, seed=rotating_seed % 10**6)
    stepped = (
        driven(car, seconds=4.0, scenarios=600 * draws_factor).accel - driven(GLVDPlant(sigma=0.0), seconds=4.0).accel
    )
    spread = stepped[:, -1].square().mean()
    assert float(spread) == pytest.approx(sd**2, abs=BAR * sd**2 * math.sqrt(2 / len(stepped)))


@pytest.mark.statistical
def test_outliers_have_the_stated_rate_and_size(rotating_seed: int, draws_factor: int) -> None:
    rows, fraction, scale = 200_000 * draws_factor, 0.03, 8.0
    time = torch.arange(rows, dtype=D) * 0.1
    car = plant([gap.Outliers(fraction, scale, 0.05)])
    r = car.response(
        SimulatorInput(time, torch.zeros_like(time)), generator=torch.Generator().manual_seed(rotating_seed)
    )
    error = r.accel_measured[r.accel_measured != 0]
    assert len(error) / rows == pytest.approx(fraction, abs=BAR * math.sqrt(fraction / rows))
    size = scale * 0.05
    assert float(error.square().mean()) == pytest.approx(size**2, abs=BAR * size**2 * math.sqrt(2 / len(error)))


def test_over_a_drive_the_same_messages_are_lost_as_step_by_step(fresh_seed: int) -> None:
    rows, count = 60, 50
    u = torch.sin(torch.arange(rows, dtype=D) * 0.3)
    effect = gap.CommandHold(0.2)
    row = gap.EffectContext(
        torch.arange(rows, dtype=D), torch.tensor(0.1, dtype=D), None, None, torch.ones(1), torch.ones(1)
    )
    normal = torch.randn(count, rows, generator=torch.Generator().manual_seed(fresh_seed), dtype=D)
    held = effect.over(u, gap.EffectContext(**{**vars(row), "normal": normal}))
    state, out = effect.start(u[0], row), []
    for k in range(rows):
        y, state = effect.advance(u[k], gap.EffectContext(**{**vars(row), "normal": normal[:, k]}), state)
        out.append(y.expand(count))
    assert torch.equal(torch.stack(out, -1), held)


@pytest.mark.statistical
def test_slope_has_the_size_it_names(rotating_seed: int) -> None:
    effect = gap.RoadGrade(0.03, knots=40)
    position = torch.linspace(0, 36 * effect.knot_m, 300, dtype=D)
    drawn = torch.randn(4000, 40, generator=torch.Generator().manual_seed(rotating_seed), dtype=D)
    slope = (effect.columns(position) @ drawn.T) * 0.03 / 9.80665
    spread = slope.square().mean(-1).sqrt()
    assert float((spread / 0.03 - 1).abs().max()) < 0.12  # splines swell a little between knots; 4000 draws: 1.1 %


def test_slope_columns_are_the_response() -> None:
    drive = smooth_drive(rows=400, dt=0.5)
    car = plant([gap.RoadGrade(0.02)]).prepared(drive)
    effect = car.effects[0]
    assert isinstance(effect, gap.RoadGrade)
    profile = torch.randn(effect.knots, generator=torch.Generator().manual_seed(2), dtype=D)
    flat = car.response(drive).accel
    hilly = car.response(drive, {"road_grade.profile": profile}).accel
    assert drive.position is not None
    linear = 0.02 * effect.columns(drive.position) @ profile
    # drive.accel0 pins the car's first acceleration, so the actuator starts higher: compare once that is forgotten
    torch.testing.assert_close((hilly - flat)[50:], linear[50:], rtol=0, atol=9.81 * 0.08**3)


def test_effects_report_wrong_values() -> None:
    with pytest.raises(InputError, match="delay"):
        gap.DeadTime.of({"delay": 0.2})
    with pytest.raises(InputError, match="natural_frequency"):
        gap.SecondOrderActuator.of({"natural_frequency_radps": 0.0})
    with pytest.raises(InputError, match="no_such"):
        effect_class("no_such")
    assert isinstance(plant([gap.DeadTime]), GapPlant)


def test_a_clock_in_a_column_of_a_table_warns_of_nothing(recwarn: pytest.WarningsRecorder) -> None:
    """Uneven times that lie apart in memory, as those of a row-wise table do."""
    table = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).add(0.5).cumsum(0) * 0.01
    time, command = table[:, 0], table[:, 1]
    torch.set_warn_always(True)  # torch says it once in a process
    try:
        late = plant([gap.DeadTime(0.05)]).response(SimulatorInput(time, command)).accel
    finally:
        torch.set_warn_always(False)
    assert not recwarn.list
    same = plant([gap.DeadTime(0.05)]).response(SimulatorInput(time.contiguous(), command)).accel
    assert torch.equal(late, same)
