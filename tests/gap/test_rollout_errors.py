"""Errors of short rollouts against short rollouts."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from avtorch.gap.rollout_errors import block_squares
from avtorch.gap.simulator.plant import plant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from tests.gap.records import command_over

RATE = 10


class Stretch(NamedTuple):
    dt: float
    group: int
    starts: np.ndarray
    rows: int
    channels: tuple[str, ...]


@pytest.mark.parametrize("channel", ["accel", "speed"])
@pytest.mark.parametrize("horizon", [0.5, 2.0, 10.0])
def test_they_are_those_of_rollouts_begun_at_what_was_measured(channel: str, horizon: float) -> None:
    rng = np.random.default_rng(3)
    time = np.arange(15 * RATE) / RATE
    command = command_over(time)
    seen = {"accel": rng.normal(size=len(time)), "speed": 15 + np.cumsum(rng.normal(size=len(time))) / RATE}
    car = plant(T_L=0.4, K_L=0.9)

    def rolled(first: int, last: int, accel0: float) -> dict[str, np.ndarray]:
        part = slice(first, last)
        speed = torch.as_tensor(seen["speed"][part])
        answer = car.response(
            SimulatorInput(torch.as_tensor(time[part]), torch.as_tensor(command[part]), speed, accel0)
        )
        return {"accel": answer.accel.numpy(), "speed": answer.speed.numpy()}

    whole = rolled(0, len(time), seen["accel"][0])
    # the speed's rollout begins with the actuator where the commands have brought it
    begun = seen["accel"] if channel == "accel" else whole["accel"]
    long = seen[channel] - whole[channel]
    blocks = [slice(0, 40), slice(40, 45), slice(70, len(time))]
    length = round(horizon * RATE)
    record = Stretch(1 / RATE, 1, np.zeros(1, np.int64), len(time), (channel,))
    told = block_squares(record, long[None, :, None], blocks, 0.4, horizon)[f"rollout_rmse_{channel}"]
    squares: list[list[float]] = [[] for _ in time]
    squares[-1].append(0.0)  # a rollout begun at the last row
    for first in range(len(time) - 1):
        last = min(first + length, len(time))
        errors = seen[channel][first:last] - rolled(first, last, begun[first])[channel]
        for row, error in enumerate(errors, first):
            squares[row].append(error**2)
    by_row = np.array([np.mean(each) for each in squares])
    want = np.array([by_row[b].sum() for b in blocks])
    np.testing.assert_allclose(told, want, atol=1e-9)
