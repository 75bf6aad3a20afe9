"""Effects judged under the noise of what they leave: those that are there stay, those that are not go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter, savgol_filter

from avtorch.gap import plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.forward_selection import baseline_noise
from avtorch.gap.budget.own_noise import judged, own_noise, with_sizes
from avtorch.gap.budget.redundancy import without_one
from avtorch.gap.budget.repaired_model import parameters_of
from avtorch.gap.budget.robust_fit import RobustFit
from avtorch.gap.budget.selection_step import Selection, Step
from avtorch.gap.effects import Backlash, ConstantResistance, DeadBand, DeadTime, SensorBias
from avtorch.gap.simulator.effect import Effect
from avtorch.io import Log
from tests.bars import student

from .cars import DT, log_of


def with_effects(log: Log, *kinds: type[Effect]) -> tuple[RobustFit, Step, Step]:
    """The fit without effects, and that with `kinds`, from where each is small."""
    fitting, bare = baseline_noise(AnalysisRecord.for_budget([log]), plant([]))
    model = bare.model
    for kind in kinds:
        model = model.with_effect(kind)
    fit = fitting.fit(model, model.coordinates(bare.known)[None], iterations=15)
    return fitting, Step(bare, fitting.hold_out(bare)), Step(fit, fitting.hold_out(fit))


@pytest.mark.slow
def test_what_is_there_stays_and_what_is_not_goes(fresh_seed: int) -> None:
    log = log_of([DeadTime(0.3)], seed=fresh_seed)
    fitting, bare, now = with_effects(log, DeadTime, Backlash)
    kept, evidence = judged(fitting, own_noise(now.fit), now.fit)
    assert kept.fit.model.names == ("dead_time",)
    assert set(evidence) == {"dead_time"}
    assert evidence["dead_time"].of_entry > 0
    assert judged(fitting, own_noise(bare.fit), bare.fit)[1] == {}


def test_a_force_of_chance_counts_once(fresh_seed: int) -> None:
    # it is in both channels, which tell a bias of one of them by their difference
    fitting, bare, now = with_effects(log_of([SensorBias(0.15)], seed=fresh_seed), SensorBias)
    apart = fitting.evidence(bare.held, now.held)
    kept, evidence = judged(fitting, own_noise(now.fit), now.fit)
    assert np.array_equal(kept.fit.z, now.fit.z), "how large it is, is not asked again"
    assert evidence["sensor_bias"].nats > 2 * apart.nats


def test_a_slow_force_keeps_the_evidence_of_the_search(fresh_seed: int) -> None:
    # what wanders is noise, too, and hides it
    fitting, _, now = with_effects(log_of([ConstantResistance(0.25)], seed=fresh_seed), ConstantResistance)
    apart = without_one(fitting, now, "constant_resistance").evidence
    _, evidence = judged(fitting, own_noise(now.fit), now.fit)
    assert evidence["constant_resistance"].of_entry >= apart.of_entry


@pytest.mark.parametrize("channel", ["accel", "speed"])
def test_one_channel_has_a_noise_of_its_own(channel: str, fresh_seed: int) -> None:
    both = log_of([DeadTime(0.3)], seed=fresh_seed)
    columns = {channel: getattr(both, channel), "accel_cmd": both.accel_cmd}
    log = Log.from_arrays(name="car", time=both.time, **columns)
    fitting, _, now = with_effects(log, DeadTime)
    assert judged(fitting, own_noise(now.fit), now.fit)[1]["dead_time"].of_entry > 0


def test_sizes_are_by_that_noise_and_rollouts_by_the_search(fresh_seed: int) -> None:
    fitting, bare, now = with_effects(log_of([SensorBias(0.15)], seed=fresh_seed), SensorBias)
    steps = (bare, replace(now, entered="sensor_bias"))
    plain = Selection(fitting, steps, judging=own_noise(now.fit))
    found = with_sizes(plain)
    assert found.last is plain.last
    bias = parameters_of(found, "sensor_bias")["bias_mps2"]
    # a force of chance, half of what a channel by itself leaves in doubt, is in both
    assert bias.sd < parameters_of(plain, "sensor_bias")["bias_mps2"].sd
    assert abs(bias.mean - 0.15) < student(fitting.folds - 1) * bias.sd
    assert with_sizes(Selection(fitting, (bare,))).sized is bare


@pytest.mark.parametrize("computed", ["row to row", "over eleven rows", "behind a low-pass"])
def test_an_acceleration_that_was_computed_from_the_speed_is_no_second_channel(computed: str, fresh_seed: int) -> None:
    # the noise of both would be that of the computation: with it the lag of 0.35 s came out as 0.49, 0.94 and 0.92
    plain = log_of([DeadBand(0.25)], seed=fresh_seed)
    assert plain.speed is not None
    step = np.gradient(plain.speed, plain.time)
    if computed == "over eleven rows":
        step = savgol_filter(plain.speed, 11, 2, deriv=1, delta=DT)
    elif computed == "behind a low-pass":
        step = lfilter([DT / 0.3], [1.0, DT / 0.3 - 1.0], step)
    log = Log.from_arrays(name="car", time=plain.time, accel_cmd=plain.accel_cmd, speed=plain.speed, accel=step)
    fitting, bare, now = with_effects(log, DeadBand)
    own = with_sizes(Selection(fitting, (bare, replace(now, entered="dead_band")), judging=own_noise(now.fit))).sized
    searched, found = (float(step.fit.model.values(step.fit.z)["T_L"]) for step in (now, own))
    # in 31 drives the fit over eleven rows differs by -0.044, with a standard deviation of 0.010
    assert found == pytest.approx(searched, abs=0.1)
