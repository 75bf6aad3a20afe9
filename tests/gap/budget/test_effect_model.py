"""The response of a model whose effects set in during the drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.signal import lfilter

from avtorch.gap import gap_budget, plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.effects import DeadTime, SensorBias

from .cars import DT, log_of


def test_until_its_onset_an_effect_of_the_baseline_acts_as_the_baseline_has_it() -> None:
    record = AnalysisRecord.for_budget([log_of(seconds=60.0)])
    base = plant([DeadTime(0.2), SensorBias(0.1)])
    bare = EffectModel(record, base)
    model = EffectModel(record, base, (DeadTime, SensorBias), {"dead_time": 30.0, "sensor_bias": 40.0})
    values = {"dead_time.delay_s": 0.5, "sensor_bias.bias_mps2": -0.3}
    parameters = model.plant.parameters()
    z = model.coordinates({key: parameters[key].unconstrain(torch.tensor(x)).numpy() for key, x in values.items()})

    def responds(car: EffectModel) -> np.ndarray:
        return car.simulate(z if car is model else np.zeros(car.size))

    found, before = responds(model), responds(bare)
    between, after = (
        responds(EffectModel(record, plant(effects)))
        for effects in ([DeadTime(0.5), SensorBias(0.1)], [DeadTime(0.5), SensorBias(-0.3)])
    )
    for expected, begin, end in ((before, 0.0, 30.0), (between, 30.0, 40.0), (after, 40.0, 60.0)):
        rows = (record.time >= begin) & (record.time < end)
        np.testing.assert_allclose(found[:, rows], expected[:, rows], atol=1e-6)
    assert np.abs(before - after).max() > 0.1


def test_a_filter_of_the_only_speed_is_no_effect_and_takes_no_dead_time() -> None:
    pole = np.exp(-DT / 0.07)  # a recorder's low-pass of 70 ms, and nothing beside it that would tell

    def budget(*effects: DeadTime, seed: int) -> dict:
        log = log_of(effects, seconds=120.0, seed=seed)
        assert log.speed is not None
        read = lfilter([1 - pole], [1.0, -pole], log.speed - log.speed[0]) + log.speed[0]
        found = gap_budget(replace(log, speed=read, accel=None), effects=["dead_time", "second_order_actuator"])
        return {part.name: part for part in found.parts}

    assert not budget(seed=0)  # it was a second-order actuator at 0.71
    late = budget(DeadTime(0.3), seed=1)
    assert set(late) == {"dead_time"}
    delay = late["dead_time"].parameters["delay_s"]
    assert delay.q05 < 0.3 < delay.q95  # 0.337 to 0.346 where the filter counts as the car's
