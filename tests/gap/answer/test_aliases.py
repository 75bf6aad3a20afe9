"""Aliases under one channel: exact in the response, equal in probability, and a set in the verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from avtorch.gap import (
    EFFECTS,
    ConstantResistance,
    DeadTime,
    Effect,
    Saturation,
    SecondOrderActuator,
    SensorBias,
    SensorLag,
    SimulatorInput,
    plant,
)
from avtorch.gap.answer.verdict import Candidate, verdict_of
from avtorch.gap.search.fitted_model import SearchResult
from avtorch.gap.search.search import Search
from avtorch.gap.selection.aliases import Identifiability, exact_aliases, lookalikes, note
from avtorch.gap.simulator.effect import effect_class
from avtorch.gap.simulator.observability import is_observable
from tests.bars import log_odds
from tests.gap.records import command_over, log_of

ACCEL, SPEED, BOTH = ("accel",), ("speed",), ("accel", "speed")
OFFSETS = ("sensor_bias", "constant_resistance", "dead_time")
LAGS = ("sensor_lag", "second_order_actuator", "sensor_bias")
BELOW, ABOVE = {"sensor_bias.bias_mps2": -0.1}, {"sensor_bias.bias_mps2": 0.1}


# names ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("sensor_bias", {"constant_resistance"}),
        ("constant_resistance", {"sensor_bias"}),
        ("sensor_lag", {"second_order_actuator"}),
        ("dead_time+sensor_bias", {"constant_resistance+dead_time"}),
        ("gust+sensor_bias", {"constant_resistance+gust"}),
        ("saturation+sensor_lag", {"saturation+second_order_actuator"}),
        ("second_order_actuator+sensor_bias", {"sensor_bias+sensor_lag", "constant_resistance+second_order_actuator"}),
        ("rate_limit+sensor_lag", set()),  # a limit before the lag is not one after it
        ("constant_resistance+sensor_bias", set()),
        *((name, set()) for name in ("none", "unknown", "dead_time", "gust", "sensor_scale")),
    ],
)
def test_aliases_by_acceleration_only(name: str, same: set[str]) -> None:
    assert exact_aliases(name, ACCEL) == {name} | same
    for channels in (SPEED, BOTH):
        assert exact_aliases(name, channels) == {name}


def test_values_bound_the_aliases() -> None:
    assert exact_aliases("sensor_bias", ACCEL, BELOW) == {"sensor_bias", "constant_resistance"}
    assert exact_aliases("sensor_bias", ACCEL, ABOVE) == {"sensor_bias"}
    for damping, same in ((1.2, {"sensor_lag"}), (0.6, set())):
        values = {"T_L": 0.4 * damping, "second_order_actuator.inverse_frequency_s": 0.2}
        assert exact_aliases("second_order_actuator", ACCEL, values) == {"second_order_actuator"} | same


def test_untested_forces_alias_offsets_and_gusts() -> None:
    assert lookalikes("sensor_bias", ACCEL, BELOW) == {"aerodynamic_drag", "road_grade"}
    assert lookalikes("sensor_bias", ACCEL, ABOVE) == {"low_speed_creep", "road_grade"}
    assert lookalikes("sensor_bias", ACCEL, ABOVE, specific_force=True) == {"low_speed_creep"}
    assert lookalikes("gust", ACCEL) == {"aerodynamic_drag", "low_speed_creep", "road_grade"}
    # one force may be all that is slow
    assert lookalikes("gust+sensor_bias", ACCEL, BELOW) == {"aerodynamic_drag", "road_grade"}
    assert lookalikes("constant_resistance+dead_time", ACCEL) == {"aerodynamic_drag+dead_time", "dead_time+road_grade"}
    for name, channels in (("dead_time", ACCEL), ("sensor_bias", BOTH), ("gust", SPEED), ("none", ACCEL)):
        assert lookalikes(name, channels) == set()


def test_untested_effects_are_reported() -> None:
    assert all(is_observable(e, BOTH) for e in EFFECTS.values())
    assert note(BOTH, EFFECTS.values()) is None
    unseen = {e.name for e in EFFECTS.values() if not is_observable(e, SPEED)}
    assert unseen == {"outliers", "sensor_bias", "sensor_lag", "sensor_scale"}
    said = note(SPEED, EFFECTS.values())
    assert said is not None
    assert said.endswith("outliers, sensor_bias, sensor_lag, sensor_scale.")
    said = note(ACCEL, EFFECTS.values())
    assert said is not None
    for name in ("aerodynamic_drag", "gear_shift", "low_speed_creep", "road_grade", "speed_dependent_lag"):
        assert name in said
    assert "sensor_scale is equivalent to another K_L" in said
    assert "constant_resistance" not in said
    assert note(ACCEL, [DeadTime]) is None


# responses -----------------------------------------------------------------------------------------------


def _shown(effects: Sequence[Effect], T_L: float = 0.35, K_L: float = 1.0, rate_hz: int = 100) -> torch.Tensor:
    time = np.arange(20 * rate_hz) / rate_hz
    drive = SimulatorInput(torch.as_tensor(time), torch.as_tensor(command_over(time)))
    return plant(effects, T_L=T_L, K_L=K_L).response(drive).accel_measured


def test_aliases_respond_alike() -> None:
    for more in ([], [DeadTime(0.2)], [Saturation(0.6, -0.5)]):
        torch.testing.assert_close(_shown([*more, ConstantResistance(0.1)]), _shown([*more, SensorBias(-0.1)]))
        # two real poles, in either order; the sensor's takes the acceleration as linear between rows
        filtered = _shown([*more, SensorLag(0.2)], T_L=0.35)
        poles = _shown([*more, SecondOrderActuator((0.35 * 0.2) ** 0.5)], T_L=0.55)
        assert float((filtered - poles).abs().max()) < 2e-3 * float(filtered.abs().max())
    scaled = EFFECTS["sensor_scale"](scale=1.2)  # type: ignore[call-arg]
    torch.testing.assert_close(_shown([scaled]), _shown([], K_L=1.2))


# logs ----------------------------------------------------------------------------------------------------


def _raced(
    car: Sequence[Effect], effects: Sequence[str], channels: Sequence[str], seed: int
) -> tuple[SearchResult, Identifiability]:
    log = log_of(plant(car, T_L=0.35), seconds=60.0, channels=channels, rng=np.random.default_rng(seed))
    kinds = [effect_class(name) for name in effects]
    race = Search([log], plant(), effects=kinds, pairs=False).run()
    return race, Identifiability.of(race, kinds)


def _candidates(race: SearchResult, told: Identifiability) -> list[Candidate]:
    """By evidence alone, 5 % for what is not known."""
    gains = np.array([f.log_evidence for f in race.found])
    shares = 0.95 * np.exp(gains - np.logaddexp.reduce(gains))
    chances = told.shared({f.name: float(p) for f, p in zip(race.found, shares, strict=True)} | {"unknown": 0.05})
    assert sum(chances.values()) == pytest.approx(1.0)
    return [Candidate(name, p) for name, p in chances.items()]


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("car", "effects", "aliases"),
    [
        (SensorBias(-0.15), OFFSETS, {"sensor_bias", "constant_resistance"}),
        (ConstantResistance(0.15), OFFSETS, {"sensor_bias", "constant_resistance"}),
        (SensorLag(0.15), LAGS, {"sensor_lag", "second_order_actuator"}),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_by_acceleration_only_the_aliases_share(
    car: Effect, effects: tuple[str, ...], aliases: set[str], rotating_seed: int
) -> None:
    race, told = _raced([car], effects, ACCEL, rotating_seed)
    evidence = {f.name: f.log_evidence - race.none.log_evidence for f in race.found}
    first, second = (evidence[name] for name in sorted(aliases))
    # the same response: what is left between them are the priors of their parameters and, with a lag in the sensor, the
    # colour of the noise (1.8 nats of standard deviation over 30 drives, where the lesser was 71 ahead of none, sd 9)
    assert first == pytest.approx(second, abs=10)
    assert min(first, second) > 15
    candidates = _candidates(race, told)
    chances = {c.name: c.probability for c in candidates}
    assert len({chances[name] for name in aliases}) == 1
    verdict = verdict_of(candidates, aliases=told.alias_set)
    assert set(verdict.names) < aliases
    assert aliases <= set(verdict.alias_set)


@pytest.mark.statistical
def test_an_offset_above_zero_is_no_resistance(rotating_seed: int) -> None:
    race, told = _raced([SensorBias(0.15)], OFFSETS, ACCEL, rotating_seed)
    verdict = verdict_of(_candidates(race, told), aliases=told.alias_set)
    assert verdict.names == ("sensor_bias",)
    assert "constant_resistance" not in verdict.alias_set


@pytest.mark.statistical
@pytest.mark.parametrize("channels", [SPEED, BOTH])
def test_with_the_speed_a_resistance_is_one(channels: tuple[str, ...], rotating_seed: int) -> None:
    race, told = _raced([ConstantResistance(0.15)], OFFSETS, channels, rotating_seed)
    assert ("sensor_bias" in {f.name for f in race.found}) == (channels == BOTH)
    verdict = verdict_of(_candidates(race, told), aliases=told.alias_set)
    assert verdict.name == "constant_resistance"
    assert "sensor_bias" not in verdict.alias_set


@pytest.mark.statistical
def test_by_speed_only_a_sensor_leaves_no_gap(rotating_seed: int) -> None:
    race, told = _raced([SensorBias(-0.15), SensorLag(0.2)], (*OFFSETS, *LAGS[:2]), SPEED, rotating_seed)
    assert {f.name for f in race.found} <= {"none", "constant_resistance", "dead_time", "second_order_actuator"}
    assert told.note is not None
    # nothing is there, and where nothing is, odds have a mean of 1 or less: there are three
    assert max(f.log_evidence for f in race.found) - race.none.log_evidence < log_odds(3)


# shares --------------------------------------------------------------------------------------------------


def _told(values: dict[str, dict[str, float]], prior: dict[str, float] | None = None) -> Identifiability:
    return Identifiability(ACCEL, values, tuple(EFFECTS.values()), prior or {})


def test_an_alias_not_tried_gets_its_share() -> None:
    told = _told({"none": {}, "dead_time+sensor_bias": BELOW})
    chances = told.shared({"dead_time+sensor_bias": 0.9, "none": 0.06, "unknown": 0.04})
    assert chances == {
        "constant_resistance+dead_time": 0.45, "dead_time+sensor_bias": 0.45, "none": 0.06, "unknown": 0.04,
    }  # fmt: skip
    tried = [Candidate("dead_time+sensor_bias", 0.45, 31.0, onset_s=4.0), Candidate("none", 0.06, 0.0)]
    tried.append(Candidate("unknown", 0.04))
    (more,) = told.mirrored(tried, chances)
    assert (more.name, more.probability, more.log_evidence) == ("constant_resistance+dead_time", 0.45, 31.0)
    assert more.onset_s == 4.0
    verdict = verdict_of([*tried, more], aliases=told.alias_set)
    assert verdict.alias_set[:2] == ("dead_time+sensor_bias", "constant_resistance+dead_time")
    assert set(verdict.alias_set[2:]) == {"none", "aerodynamic_drag+dead_time", "dead_time+road_grade"}


def test_the_prior_bounds_what_is_shared() -> None:
    chances = {"sensor_bias": 0.8, "constant_resistance": 0.1, "none": 0.1, "unknown": 0.0}
    values = {"sensor_bias": BELOW, "constant_resistance": {"constant_resistance.resistance_mps2": 0.1}}
    assert _told(values).shared(chances)["sensor_bias"] == pytest.approx(0.45)
    assert _told(values, {"sensor_bias": 2.0}).shared(chances)["sensor_bias"] == pytest.approx(0.6)
    barred = _told(values, {"constant_resistance": 0.0})
    assert barred.shared(chances) == chances
    assert "constant_resistance" not in barred.alias_set([Candidate("sensor_bias", 1.0)])
    few = Identifiability(ACCEL, values, (SensorBias,))
    assert few.shared({"sensor_bias": 0.9, "none": 0.1}) == {"sensor_bias": 0.9, "none": 0.1}
    assert few.alias_set([Candidate("sensor_bias", 1.0)]) == ("sensor_bias",)


def test_with_both_witnesses_nothing_changes() -> None:
    told = Identifiability(BOTH, {"sensor_bias": BELOW}, tuple(EFFECTS.values()))
    chances = {"sensor_bias": 0.9, "none": 0.07, "unknown": 0.03}
    candidates = [Candidate(name, p) for name, p in chances.items()]
    assert told.shared(chances) == chances
    assert told.mirrored(candidates, chances) == []
    assert verdict_of(candidates, aliases=told.alias_set) == verdict_of(candidates)
    assert told.note is None
