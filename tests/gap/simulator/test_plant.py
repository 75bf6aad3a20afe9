"""Plants of effects as simulators: in the loop, as copies, as text."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import avtorch
from avtorch import gap
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, GapPlant, SimulatorInput, plant
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.parameter import Parameter
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader
from tests.gap.drives import DT, driven, smooth_drive

D = torch.float64


def leader(seconds: float = 6.0) -> Leader:
    time = torch.arange(round(seconds / DT) + 1, dtype=D) * DT
    speed = 15 + 2 * torch.sin(0.8 * time)
    position = torch.cat([torch.zeros(1, dtype=D), (0.5 * DT * (speed[1:] + speed[:-1])).cumsum(0)])
    return Leader(time, position, speed, 1.6 * torch.cos(0.8 * time), DT)


def test_adding_an_effect_is_one_line() -> None:
    plain = avtorch.simulate(leader(), plant=plant())
    late = avtorch.simulate(leader(), plant=plant([gap.DeadTime(0.2)]))
    glvd = avtorch.simulate(leader(), plant=GLVDPlant())
    torch.testing.assert_close(plain.accel, glvd.accel, rtol=0, atol=1e-12)
    assert float((late.accel - glvd.accel).abs().max()) > 0.05
    assert late.log().jerk is None  # this plant does not report its jerk


def test_the_chain_has_one_order() -> None:
    effects = [gap.SensorBias(), gap.DeadTime(), gap.Gust(), gap.DeadBand(), gap.SensorLag(), gap.RateLimit()]
    names = [e.name for e in plant(effects).effects]
    assert names == ["dead_band", "dead_time", "rate_limit", "gust", "sensor_lag", "sensor_bias"]
    assert names == [e.name for e in plant(effects[::-1]).effects]


def test_a_drive_is_remembered_and_a_new_one_starts_anew() -> None:
    car = plant([gap.DeadTime(0.3), gap.GainChange(0.5, 2.0)], sigma=0.0)
    once = driven(car, seconds=4.0)
    assert torch.equal(driven(car, seconds=4.0).accel, once.accel)
    car.reset()
    assert torch.equal(driven(car, seconds=4.0).accel, once.accel)
    loop = ClosedLoop(leader(), plant=car)
    whole = loop.copy().advance(200)
    parts = torch.cat([loop.advance(70).accel, loop.advance(130).accel], -1)
    assert torch.equal(parts, whole.accel)


def test_copies_go_on_by_themselves() -> None:
    car = plant([gap.DeadTime(0.3), gap.SensorLag(0.2), gap.Gust(), gap.CommandHold(0.2)])
    loop = ClosedLoop(leader(), plant=car, scenarios=3)
    loop.advance(100)
    twin, many = loop.copy(), loop.copy(candidates=4)
    own = loop.advance(100)
    assert torch.equal(twin.advance(100).accel, own.accel)
    side = many.advance(100)
    assert side.accel.shape == (4, 3, 100)
    torch.testing.assert_close(side.accel, own.accel.expand(4, 3, 100), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_platoons_and_scenarios() -> None:
    delays = torch.tensor([0.0, 0.1, 0.25], dtype=D)
    car = plant([gap.DeadTime(delays), gap.Outliers(0.1), gap.RoadGrade()], sigma=0.0)
    run = avtorch.simulate(leader(), plant=car, vehicles=2, scenarios=3)
    assert run.accel.shape[:2] == (3, 2)
    assert not torch.equal(run.accel[0], run.accel[2])
    own = driven(plant([gap.DeadTime(delays)], sigma=0.0), seconds=3.0, scenarios=3)
    for i, delay in enumerate(delays):
        single = driven(plant([gap.DeadTime(delay)], sigma=0.0), seconds=3.0)
        torch.testing.assert_close(own.accel[i], single.accel[0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_random_effects_follow_their_seed() -> None:
    for effect in (gap.Gust(), gap.Outliers(0.2), gap.CommandHold(0.2), gap.RoadGrade(0.05)):
        one, two, three = (driven(plant([effect], sigma=0.0, seed=s), seconds=2.0).accel for s in (1, 1, 2))
        assert torch.equal(one, two)
        assert not torch.equal(one, three)


def test_a_plant_can_be_changed_in_mid_run() -> None:
    run = avtorch.simulate(
        leader(), plant=GLVDPlant(sigma=0.0), schedule=[(3.0, {"plant": plant([gap.SensorBias(0.5)], sigma=0.0)})]
    )
    jump = run.accel[0, 0].diff()
    assert int(jump.argmax()) == 150  # the first row that the new plant shows


def test_drag_slows_and_sensor_faults_reach_the_log() -> None:
    assert float(driven(plant([gap.AerodynamicDrag()])).speed[0, -1]) < float(driven(plant()).speed[0, -1])
    shown = driven(plant([gap.SensorBias(0.3)], sigma=0.0)).accel - driven(plant(sigma=0.0)).accel
    torch.testing.assert_close(shown[:, 1:], torch.full_like(shown[:, 1:], 0.3))


# baselines and text ------------------------------------------------------------------------------------------


# values that neither the typical nor the neutral effect has, as a fit, a drive or a user may give them
VARIANTS = {
    "gear_shift": [{"speeds": (4.0, 7.5)}, {"speeds": torch.tensor([4.0, 7.5], dtype=D)}],
    "road_grade": [{"profile": torch.linspace(-1, 1, 5, dtype=D), "knots": 5}],
    "saturation": [{"accel_min_mps2": -float("inf")}],
    "second_order_actuator": [{"damping_ratio": 0.4}, {"inverse_frequency_s": 0.0, "damping_ratio": None}],
    "driveline_oscillation": [{"mode_damping": 1.4, "quadrature": -0.2}],
    "gain_change": [{"ramp_s": 3.0}],
}


@pytest.mark.parametrize(
    "cls", [c for n, c in EFFECTS.items() if c.__module__.startswith("avtorch")], ids=lambda c: c.name
)
def test_text_round_trip_of_every_way_to_make_an_effect(cls: type[Effect]) -> None:
    made = [cls(), cls.neutral(), *(cls(**given) for given in VARIANTS.get(cls.name, []))]
    made.append(cls(**{name: torch.tensor(float(x), dtype=D) for name, x in cls().values().items()}))
    # by the answer's own names, as a baseline in a file has them
    made.append(cls.of({name: float(x) for name, x in cls().report(torch.tensor(0.3, dtype=D)).items()}))
    drive = smooth_drive()
    made.append(plant([cls]).prepared(drive).effects[0])
    for effect in made:
        car = plant([effect, gap.Gust()] if cls is not gap.Gust else [effect], K_L=0.93, sigma=0.2)
        again = GapPlant.from_toml(car.to_toml())
        assert again.to_toml() == car.to_toml()
        assert (again.T_L, again.K_L, again.sigma) == (car.T_L, 0.93, 0.2)
        for name, value in car.values().items():
            assert torch.equal(again.values()[name], value), name
        if not effect.random:
            assert torch.equal(again.response(drive).accel_measured, car.response(drive).accel_measured)


@pytest.mark.parametrize("effects", ["dead_time=0.2", ["dead_time"], [0.2], [int]])
def test_effects_that_are_none_are_refused(effects: object) -> None:
    with pytest.raises(InputError, match=r"effects: found .*; needs effects|effects: found .*, needs effects"):
        plant(effects)  # pyright: ignore[reportArgumentType]


def test_a_damping_ratio_sets_the_lag_once() -> None:
    given = gap.SecondOrderActuator(1 / 6, damping_ratio=0.4)
    car = plant([given])
    assert float(car.T_L) == pytest.approx(2 * 0.4 / 6)
    # with another lag the damping is another: nothing stale is left in the effect
    slower = plant(baseline=car, T_L=0.5)
    told = GapPlant.from_toml(slower.to_toml()).report()["second_order_actuator"]
    assert float(told["damping_ratio"]) == pytest.approx(0.5 * 6 / 2)
    # made past `plant`, its text still reads back to the same lag
    direct = GapPlant([given], T_L=0.7, K_L=1.0, sigma=0.1)
    assert GapPlant.from_toml(direct.to_toml()).T_L == 0.7
    with pytest.raises(InputError, match="T_L: given beside"):
        plant([given], T_L=0.3)


def test_short_strings() -> None:
    car = GapPlant.from_toml("dead_time=0.2, T_L = 0.4, saturation.accel_min_mps2=-2, gust")
    assert car.T_L == 0.4
    assert car.effects == (gap.Saturation(accel_min_mps2=-2.0), gap.DeadTime(0.2), gap.Gust())
    assert GapPlant.from_toml("glvd").effects == ()
    second = GapPlant.from_toml("second_order_actuator=8, second_order_actuator.damping_ratio=0.5")
    assert float(second.T_L) == pytest.approx(2 * 0.5 / 8)


def test_baselines(tmp_path: Path) -> None:
    mine = plant([gap.DeadTime(0.2), gap.SensorBias(0.1)], T_L=0.5)
    path = tmp_path / "car.toml"
    path.write_text(mine.to_toml(), encoding="utf-8")
    for baseline in (mine, path, str(path)):
        car = plant([gap.AerodynamicDrag(), gap.SensorBias(0.3)], baseline=baseline)
        assert car.T_L == 0.5
        assert [e.name for e in car.effects] == ["dead_time", "aerodynamic_drag", "sensor_bias"]
        assert car.effects[-1] == gap.SensorBias(0.3)
    assert plant([gap.Gust()], baseline="dead_time=0.2").effects[0] == gap.DeadTime(0.2)


def test_a_string_that_names_a_file_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("my car", "car.toml", "dead_time=0.1", "glvd"):
        Path(name).write_text("[dead_time]\ndelay_s = 0.2\n", encoding="utf-8")
    for name in ("my car", "car.toml", "dead_time=0.1"):
        assert plant(baseline=name).effects == (gap.DeadTime(0.2),)
    assert plant(baseline="glvd").effects == ()
    assert plant(baseline="dead_time=0.3," + 5000 * " ").effects == (gap.DeadTime(0.3),)  # too long for a name
    for missing in ("other.toml", "no/Such.TOML"):
        with pytest.raises(InputError, match=f"{missing}: no such file"):
            plant(baseline=missing)
    with pytest.raises(InputError, match=r"other\.toml: no such file"):
        plant(baseline=Path("other.toml"))


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(InputError, match="at most once"):
        plant([gap.DeadTime(0.1), gap.DeadTime(0.2)])
    car = plant([gap.DeadTime()])
    for name in ("delay_s", "dead_time.lag", "gust.sd_mps2"):
        with pytest.raises(InputError, match=name.rpartition(".")[2]):
            car.with_values({name: 0.1})
    time = torch.arange(5, dtype=D)
    for bad in ({"time": -time}, {"command": time[:3]}, {"speed": time[:2]}, {"command": time / 0}):
        with pytest.raises(InputError, match=next(iter(bad))):
            SimulatorInput(**{"time": time, "command": time, **bad})  # type: ignore[arg-type]


# parameters ------------------------------------------------------------------------------------------


@pytest.mark.statistical
def test_parameters_are_standard_normals_in_z(rotating_seed: int) -> None:
    for p in plant([cls for n, cls in EFFECTS.items() if n != "road_grade"]).parameters().values():
        z = torch.tensor([-1.2815515655, 0.0, 1.2815515655], dtype=D)
        value = p.constrain(z)
        torch.testing.assert_close(p.unconstrain(value), z, rtol=0, atol=1e-7)
        assert sorted(value[[0, 2]].tolist()) == pytest.approx([p.low, p.high], rel=1e-6, abs=1e-6)
        drawn = p.sample(2000, generator=torch.Generator().manual_seed(rotating_seed))
        inside = float(((drawn > p.low) & (drawn < p.high)).double().mean())
        assert inside == pytest.approx(0.8, abs=0.06)
    car = plant()
    assert float(car.parameters()["T_L"].typical()) == pytest.approx(0.3, rel=1e-3)
    assert car.parameters()["K_L"].spread == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize(
    ("low", "high", "constraint"),
    [(2.0, 1.0, "real"), (-1.0, 1.0, "positive"), (0.1, 1.5, "unit"), (-1.0, 2.0, "negative")],
)
def test_wrong_ranges_are_refused(low: float, high: float, constraint: str) -> None:
    with pytest.raises(InputError, match="gain"):
        Parameter("gain", "-", 0.0, low, high, constraint)  # type: ignore[arg-type]


def test_settings_come_from_the_drive() -> None:
    time = torch.arange(200, dtype=D) * 0.5 + 40
    drive = SimulatorInput(time, torch.zeros_like(time), torch.full_like(time, 8.0))
    car = plant([gap.SpeedDependentLag, gap.RoadGrade]).prepared(drive)
    assert car.effects[0] == gap.SpeedDependentLag(mean_speed=8.0)
    assert car.effects[1] == gap.RoadGrade(knots=int(8 * 99.5 / gap.RoadGrade().knot_m) + 4)
