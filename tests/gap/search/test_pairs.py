"""A second effect: which one would help, where two come to rest, and which half of a pair is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap import (
    AerodynamicDrag,
    ConstantResistance,
    DeadTime,
    Effect,
    GapPlant,
    LowSpeedCreep,
    RoadGrade,
    Saturation,
    SensorBias,
    SensorScale,
    SpeedDependentLag,
    plant,
)
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search import pairs
from avtorch.gap.search.initial_values import effect_starts, start_points
from avtorch.gap.search.pairs import PairBase, exchanged, joint_fit
from avtorch.gap.search.screening import Screened
from avtorch.gap.simulator.effect_context import EffectContext
from avtorch.gap.simulator.parameter import Parameter
from avtorch.vehicle.arguments import Number, tensor
from tests.gap.records import QUIET, log_of

KINDS = (AerodynamicDrag, ConstantResistance, DeadTime, LowSpeedCreep, SensorBias, SensorScale, SpeedDependentLag)


def _alone(
    record: Record, white: WhiteningFilter, kind: type[Effect]
) -> tuple[Hypothesis, FloatArray, dict[str, float]]:
    """One effect fitted alone, as a search does it."""
    base = Hypothesis(record, (kind,), plant())
    found, values = modes(base, white, start_points(base, {"T_L": 0.3, "K_L": 1.0}), iterations=10, coarse=True)
    z = found[values.argmax()]
    return base, z, _values(base, z)


def _values(hypothesis: Hypothesis, z: FloatArray) -> dict[str, float]:
    return {k: float(v) for k, v in hypothesis.values(z[None]).items()}


def _drive(
    car: GapPlant, rng: np.random.Generator | None = None, seconds: float = 40.0
) -> tuple[Record, WhiteningFilter]:
    """Without `rng`, without noise."""
    record = Record.of(log_of(car, seconds=seconds, speed0=25.0, rng=rng, noise=None if rng is None else QUIET))
    return record, WhiteningFilter(record, QUIET)


PAIRS: dict[str, tuple[Effect, Effect]] = {
    "a force and a delay": (ConstantResistance(0.2), DeadTime(0.25)),
    "a delay and a sensor": (DeadTime(0.25), SensorScale(1.15)),
    "a force and a sensor": (AerodynamicDrag(5e-4), SensorBias(0.15)),
}


@pytest.mark.statistical
@pytest.mark.parametrize("name", PAIRS)
def test_the_true_second_effect_is_ranked_first(name: str, rotating_seed: int) -> None:
    first, second = PAIRS[name]
    record, white = _drive(plant([first, second], T_L=0.35, K_L=0.95), np.random.default_rng(rotating_seed))
    base, z, values = _alone(record, white, type(first))
    gains = {}
    for kind in KINDS:
        if kind is not type(first):
            hypothesis = Hypothesis(record, (type(first), kind), plant())
            gains[kind.name], begin = PairBase(base, z, values, None, white).score(hypothesis, {})
            # what it starts from is one of its own starts, with the base where it is
            assert any((begin == row).all() for row in start_points(hypothesis, values))
    order = sorted(gains, key=lambda k: -gains[k])
    assert order[0] == second.name
    assert gains[order[0]] > 20


@pytest.mark.statistical
def test_a_gain_is_predicted_before_it_is_fitted(rotating_seed: int) -> None:
    """One linear step predicts the fit of a faint second effect."""
    record, white = _drive(plant([SensorBias(0.1), ConstantResistance(0.1)]), np.random.default_rng(rotating_seed))
    base, z, values = _alone(record, white, SensorBias)
    hypothesis = Hypothesis(record, (SensorBias, ConstantResistance), plant())
    told, begin = PairBase(base, z, values, None, white).score(hypothesis, {})
    fitted = modes(hypothesis, white, begin[None], coarse=True, iterations=10)[0]
    before, after = (
        float(white.log_likelihood(c.errors(at[None], coarse=True))[0])
        for c, at in ((base, z), (hypothesis, fitted[0]))
    )
    assert after - before > 15
    # priors hold the fit back a little, and the base's mode is not quite where its own likelihood is flat
    assert told == pytest.approx(after - before, rel=0.1)


@dataclass(frozen=True)
class _Gain(Effect):
    """The car's own gain by another name."""

    more: Number = 0.05

    name = "its_own_gain"
    place = "command"
    meaning = "the gain of the command"
    equation = "(1 + m) u"
    parameters = (Parameter("more", "-", 0.0, 0.02, 0.2),)

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return (1 + tensor(self.more)) * x


@pytest.mark.parametrize("kind", [*(k for k in KINDS if k is not SensorBias), _Gain])
@pytest.mark.parametrize("sign", [1, -1])
def test_what_the_base_itself_can_do_is_no_gain(sign: int, kind: type[Effect]) -> None:
    """A base off its mode has large errors, and no second effect is needed for them. No noise: nothing by chance."""
    record, white = _drive(plant(T_L=0.4))
    base = Hypothesis(record, (SensorBias,), plant())
    off = base.z_of({"T_L": 0.4 + 0.004 * sign, "K_L": 1 + 0.01 * sign, "sensor_bias.bias_mps2": 0.02 * sign})
    worth = 0.5 * float((white(base.errors(off[None], coarse=True)) ** 2).sum())
    assert worth > 40
    gain, _ = PairBase(base, off, _values(base, off), None, white).score(
        Hypothesis(record, (SensorBias, kind), plant()), {}
    )
    assert 0 <= gain < 0.001 * worth


@pytest.mark.statistical
def test_a_second_gain_is_no_second_effect(rotating_seed: int) -> None:
    record, white = _drive(plant(T_L=0.4, K_L=1.25), np.random.default_rng(rotating_seed))
    base = Hypothesis(record, (), plant())
    off = base.z_of({"T_L": 0.4, "K_L": 1.0})
    hypothesis = Hypothesis(record, (_Gain,), plant())
    gain, _ = PairBase(base, off, {"T_L": 0.4, "K_L": 1.0}, None, white).score(hypothesis, {})
    best = modes(hypothesis, white, hypothesis.z_of({"T_L": 0.4, "K_L": 1.0})[None], coarse=True)[1][0]
    flat = float(white.log_likelihood(base.errors(off[None], coarse=True))[0])
    assert best > flat + 100
    assert 0 <= gain < 12.5  # half of a chi-squared with one degree of freedom, at five standard deviations


@pytest.mark.statistical
def test_a_slope_of_the_base_is_taken_out_too(rotating_seed: int) -> None:
    """Uphill a resistance does what the hill does."""
    climb = 0.5 + np.abs(np.random.default_rng(rotating_seed).standard_normal(20))
    record, white = _drive(plant([RoadGrade(0.006, profile=torch.as_tensor(climb))]))
    base = Hypothesis(record, (RoadGrade,), plant())
    bare = Hypothesis(record, (), plant())
    z = bare.z_of({"T_L": 0.3, "K_L": 1.0})
    kinds = (AerodynamicDrag, ConstantResistance)
    flat, sloped = (
        [
            PairBase(b, z, _values(b, z), None, white).score(Hypothesis(record, (*b.effects, k), plant()), {})[0]
            for k in kinds
        ]
        for b in (bare, base)
    )
    worth = 0.5 * float((white(bare.errors(z[None], coarse=True)) ** 2).sum())
    assert worth > 100
    assert min(flat) > 0.2 * worth
    assert max(sloped) < 0.02 * worth


@pytest.mark.statistical
def test_a_slope_as_the_second_effect_is_fitted(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    climb = 0.5 + np.abs(rng.standard_normal(20))
    for hills, sign in (([RoadGrade(0.008, profile=torch.as_tensor(climb))], 1), ([], -1)):
        record, white = _drive(plant([*hills, DeadTime(0.25)]), rng)
        base, z, values = _alone(record, white, DeadTime)
        hypothesis = Hypothesis(record, (DeadTime, RoadGrade), plant())
        gain, begin = PairBase(base, z, values, None, white).score(hypothesis, {})
        assert sign * gain > (50 if sign > 0 else -12)
        assert begin.shape == (hypothesis.size,)


def test_an_effect_of_many_starts_begins_where_it_came_to_rest_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "_MUCH", 50 * 1000)  # as for a drive of several minutes
    record, white = _drive(plant([DeadTime(0.2), Saturation(0.6, -8.0)]))
    base, z, values = _alone(record, white, DeadTime)
    shift = {"gear_shift.first_mps": 4.1, "gear_shift.gear_ratio": 1.5}
    hypothesis = Hypothesis.named(record, "dead_time+gear_shift", plant())
    assert len(effect_starts(hypothesis, "gear_shift")) > 50
    _, begin = PairBase(base, z, values, None, white).score(hypothesis, {"gear_shift": {**values, "T_L": 0.9, **shift}})
    np.testing.assert_array_equal(begin, hypothesis.z_of({**values, **shift}))
    # one of few starts has its own besides, so that coming to rest at no effect takes nothing from it
    hypothesis = Hypothesis(record, (DeadTime, Saturation), plant())
    own, _ = PairBase(base, z, values, None, white).score(hypothesis, {})
    nothing = {"saturation": {"T_L": 0.9, "saturation.accel_max_mps2": 5.0, "saturation.accel_min_mps2": -8.0}}
    more, _ = PairBase(base, z, values, None, white).score(hypothesis, nothing)
    assert more == own > 100


STUCK = {
    "r 0.34": (0.34, 0.36, -0.68, 1.27),
    "r 0.21": (0.21, 0.57, -0.54, 0.96),
    "r 0.31": (0.31, 0.39, -0.58, 1.38),
}


@pytest.mark.parametrize("case", STUCK)
def test_a_pair_comes_to_rest_at_the_truth_from_a_new_start_only(case: str) -> None:
    """Fitted alone, a resistance has taken the gain for what two limits do to it. No noise: the truth is the top."""
    resistance, high, low, gain = STUCK[case]
    car = plant([ConstantResistance(resistance), Saturation(high, low)], T_L=0.35, K_L=gain)
    record = Record.of(log_of(car, seconds=40.0, speed0=35.0, noise=None))
    white = WhiteningFilter(record, QUIET)
    base, z, values = _alone(record, white, ConstantResistance)
    assert values["K_L"] < 0.65 * gain
    hypothesis = Hypothesis(record, (ConstantResistance, Saturation), plant())
    _, begin = PairBase(base, z, values, None, white).score(hypothesis, {})
    truth = hypothesis.z_of({k: float(v) for k, v in car.values().items()})
    top = float(modes(hypothesis, white, truth[None], coarse=True)[1][0])
    # on from the first effect, however long, it stays behind a hill
    assert modes(hypothesis, white, begin[None], coarse=True, iterations=30)[1][0] < top - 40
    found = joint_fit(hypothesis, ConstantResistance, begin, None, white, onsets=False)
    assert found.value > top - 2
    assert _values(hypothesis, found.z)["K_L"] == pytest.approx(gain, rel=0.1)
    assert found.onset is None


@pytest.mark.statistical
def test_a_pair_that_sets_in_late_keeps_its_onset(rotating_seed: int) -> None:
    pair = (ConstantResistance, DeadTime)
    truth = {"T_L": 0.3, "K_L": 1.0, "constant_resistance.resistance_mps2": 0.2, "dead_time.delay_s": 0.25}
    quiet, _ = _drive(plant(), np.random.default_rng(rotating_seed))
    hypothesis = Hypothesis(quiet, pair, plant())
    z = hypothesis.z_of(truth)[None]
    onset = 400
    late = _with(quiet, quiet.measured + hypothesis.rollouts(z, onset)[0] - hypothesis.baseline_rollouts(z)[0])
    white = WhiteningFilter(late, QUIET)
    hypothesis = Hypothesis(late, pair, plant())
    begin = hypothesis.z_of({**truth, "constant_resistance.resistance_mps2": 0.15, "dead_time.delay_s": 0.2})
    found = joint_fit(hypothesis, ConstantResistance, begin, onset, white, onsets=True)
    assert found.onset == onset
    whole = joint_fit(hypothesis, ConstantResistance, begin, None, white, onsets=False)
    assert whole.onset is None
    assert found.value > whole.value + 50
    # an onset that is not given is found
    free = joint_fit(hypothesis, ConstantResistance, begin, None, white, onsets=True)
    assert free.onset is not None
    assert abs(free.onset - onset) * late.dt < 3.6
    # and where both act from the start, a given onset is dropped
    record, white = _drive(plant([ConstantResistance(0.2), DeadTime(0.25)]), np.random.default_rng(rotating_seed))
    assert (
        joint_fit(Hypothesis(record, pair, plant()), ConstantResistance, begin, onset, white, onsets=True).onset is None
    )


def _with(record: Record, measured: FloatArray) -> Record:
    """The record with other measurements at the rows that count."""
    columns = {}
    for name, old, new in zip(record.channels, (record.accel, record.speed), measured, strict=True):
        assert old is not None
        columns[name] = old.copy()
        columns[name][record.source] = new
    return replace(record, **columns)


@pytest.mark.statistical
@pytest.mark.parametrize("wrong", [SpeedDependentLag, SensorScale])
def test_the_wrong_half_of_a_pair_is_exchanged(wrong: type[Effect], rotating_seed: int) -> None:
    car = plant([ConstantResistance(0.2), DeadTime(0.25)], T_L=0.35, K_L=0.95)
    record, white = _drive(car, np.random.default_rng(rotating_seed))
    pair = Hypothesis(record, (ConstantResistance, wrong), plant())
    _, _, values = _alone(record, white, ConstantResistance)
    found, reached = modes(pair, white, start_points(pair, values), coarse=True)
    here = Screened(pair, found[reached.argmax()], float(reached.max()))
    tries = 2
    others = exchanged(here, KINDS, white, {}, tries=tries)
    assert others[0].hypothesis.name == "constant_resistance+dead_time"
    assert others[0].value > here.value + 50
    assert [look.value for look in others] == sorted((look.value for look in others), reverse=True)
    _no_pair_again(others, here, tries)
    truth = others[0].hypothesis.z_of({k: float(v) for k, v in car.values().items()})
    # along a delay the likelihood has bumps, as noise falls into rows: 1.5 nats in 1 of some 30 drives
    assert others[0].value > modes(others[0].hypothesis, white, truth[None], coarse=True)[1][0] - 5


def _no_pair_again(others: Sequence[Screened], here: Screened, tries: int) -> None:
    """Each keeps one half of `here`, at most `tries` for each half, and none is `here` itself."""
    kept = {e: [k for k in others if e in k.hypothesis.effects] for e in here.hypothesis.effects}
    assert sum(len(k) for k in kept.values()) == len(others)
    assert all(len(k) <= tries for k in kept.values())
    assert len({k.hypothesis.name for k in others}) == len(others)


@pytest.mark.statistical
def test_of_a_right_pair_nothing_is_exchanged_for_better(rotating_seed: int) -> None:
    car = plant([ConstantResistance(0.2), DeadTime(0.25)], T_L=0.35, K_L=0.95)
    record, white = _drive(car, np.random.default_rng(rotating_seed))
    pair = Hypothesis(record, (ConstantResistance, DeadTime), plant())
    truth = pair.z_of({k: float(v) for k, v in car.values().items()})
    z, value = modes(pair, white, truth[None], coarse=True)
    # at an even speed a drag or an idling drive is a constant force as well
    kinds = [k for k in KINDS if k not in (AerodynamicDrag, LowSpeedCreep)]
    others = exchanged(Screened(pair, z[0], float(value[0])), kinds, white, {}, tries=2)
    assert all(look.value < value[0] - 20 for look in others)
