"""Errors of short rollouts against short rollouts."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from avtorch.gap.chain.drive import Drive
from avtorch.gap.chain.plant import plant
from avtorch.gap.heldout.rollout_errors import Measure, measures
from tests.gap.records import command_over

RATE = 50


@pytest.mark.parametrize("witness", ["accel", "speed"])
@pytest.mark.parametrize("horizon", [0.5, 2.0, 10.0])
def test_they_are_those_of_rollouts_begun_at_what_was_measured(witness: str, horizon: float) -> None:
    rng = np.random.default_rng(3)
    time = np.arange(21 * RATE) / RATE
    command = command_over(time)
    seen = {"accel": rng.normal(size=len(time)), "speed": 15 + np.cumsum(rng.normal(size=len(time))) / RATE}
    car = plant(T_L=0.4, K_L=0.9)

    def rolled(first: int, last: int, accel0: float) -> dict[str, np.ndarray]:
        part = slice(first, last)
        speed = torch.as_tensor(seen["speed"][part])
        answer = car.response(Drive(torch.as_tensor(time[part]), torch.as_tensor(command[part]), speed, accel0))
        return {"accel": answer.accel.numpy(), "speed": answer.speed.numpy()}

    whole = rolled(0, len(time), seen["accel"][0])
    # the speed's rollout begins with the actuator where the commands have brought it
    begun = seen["accel"] if witness == "accel" else whole["accel"]
    long = seen[witness] - whole[witness]
    told = Measure(witness, horizon).of(long, 1 / RATE, 0.4)
    length = round(horizon * RATE)
    edges = [*range(0, len(time), length), len(time)]
    if edges[-1] - edges[-2] <= length // 5:
        edges.pop(-2)
    want = [seen[witness][a:b] - rolled(a, b, begun[a])[witness] for a, b in pairwise(edges)]
    np.testing.assert_allclose(told, np.concatenate(want), atol=1e-9)


def test_the_usual_ones_have_the_schemas_names() -> None:
    names = [m.name for m in measures(("accel", "speed"))]
    assert {"rollout_rmse_accel", "rollout_rmse_speed", "rollout_rmse_accel_2s", "rollout_rmse_speed_whole"} <= {*names}
    assert len(set(names)) == len(names) == 8
    assert Measure("accel", None).of(np.arange(5.0), 0.1, 0.3).tolist() == [0, 1, 2, 3, 4]
