"""Effects judged under the noise of what they leave: those that are there stay, those that are not go."""

from __future__ import annotations

import pytest

from avtorch.gap import plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.forward_selection import baseline_noise
from avtorch.gap.budget.own_noise import settled
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.effects import Backlash, DeadTime, SensorBias
from avtorch.gap.simulator.effect import Effect
from avtorch.io import Log

from .cars import log_of


def with_effects(log: Log, *kinds: type[Effect]) -> tuple[RobustFit, Fit, Fit]:
    """The fit without effects, and that with `kinds`, from where each is small, under the noise of a search."""
    fitting, bare = baseline_noise(AnalysisRecord.for_budget([log]), plant([]))
    model = bare.model
    for kind in kinds:
        model = model.with_effect(kind)
    return fitting, bare, fitting.fit(model, model.coordinates(bare.known)[None], iterations=15)


def test_what_is_there_stays_and_what_is_not_goes(fresh_seed: int) -> None:
    log = log_of([DeadTime(0.3)], seed=fresh_seed)
    fitting, bare, fit = with_effects(log, DeadTime, Backlash)
    found = settled(fitting, bare, fit, {"dead_time": ("dead_time", "late")}, tried=7)
    assert [(step.entered, step.aliases) for step in found.steps] == [(None, ()), ("dead_time", ("dead_time", "late"))]
    assert found.last.evidence.of_entry > 0
    assert (found.tried, found.searching) == (7, fitting)
    assert found.fitting is not fitting


def test_without_effects_the_noise_of_the_search_stays(fresh_seed: int) -> None:
    fitting, bare, fit = with_effects(log_of(seed=fresh_seed), Backlash)
    for one in (bare, fit):
        found = settled(fitting, bare, one, {})
        assert (len(found.steps), found.fitting, found.searching) == (1, fitting, fitting)


def test_a_force_of_chance_counts_once(fresh_seed: int) -> None:
    # it is in both channels, which tell a bias of one of them by their difference
    fitting, bare, fit = with_effects(log_of([SensorBias(0.15)], seed=fresh_seed), SensorBias)
    apart = fitting.evidence(fitting.hold_out(bare), fitting.hold_out(fit))
    assert settled(fitting, bare, fit, {}).last.evidence.nats > 2 * apart.nats


@pytest.mark.parametrize("channel", ["accel", "speed"])
def test_one_channel_has_a_noise_of_its_own(channel: str, fresh_seed: int) -> None:
    both = log_of([DeadTime(0.3)], seed=fresh_seed)
    columns = {channel: getattr(both, channel), "accel_cmd": both.accel_cmd}
    log = Log.from_arrays(name="car", time=both.time, **columns)
    found = settled(*with_effects(log, DeadTime), {})
    assert [step.entered for step in found.steps] == [None, "dead_time"]
    assert found.last.evidence.of_entry > 0
