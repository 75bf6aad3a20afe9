"""The response of a model whose effects set in during the drives."""

from __future__ import annotations

import numpy as np
import torch

from avtorch.gap import plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.effects import DeadTime, SensorBias

from .cars import log_of


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
