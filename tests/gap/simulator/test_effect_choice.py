"""Every function that takes effects refuses what names none, before it works."""

from __future__ import annotations

import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, SensorBias
from avtorch.gap.simulator.effect import chosen_effects
from avtorch.io import Log
from tests.gap.records import log_of


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ("sensor_bias", "effects: found 'sensor_bias', needs a list of names or classes"),
        ("", "effects: found '', needs a list of names or classes"),
        (["sensor_bais"], "effect: found 'sensor_bais', needs an effect's name; perhaps sensor_bias"),
        ([3], "effects: found '3', needs names or classes of effects"),
        ([Log], "effects: found .*, needs names or classes of effects"),
        (["sensor_bias", SensorBias], "effects: found sensor_bias twice, needs each effect once"),
    ],
)
def test_effects_that_are_none(effects: object, message: str) -> None:
    log = log_of(seconds=20.0)
    with pytest.raises(InputError, match=message):
        avtorch.diagnose(log, effects=effects)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        avtorch.compare(log, log, effects=effects)  # type: ignore[arg-type]


def test_effects_by_name_and_by_class() -> None:
    assert chosen_effects(["dead_time", SensorBias]) == [EFFECTS["dead_time"], SensorBias]
    assert chosen_effects(None) == [EFFECTS[name] for name in sorted(EFFECTS)]
