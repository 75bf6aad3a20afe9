"""Errors of short rollouts against short rollouts."""

import numpy as np
import pytest
import torch

from avtorch.gap.effects import ConstantResistance
from avtorch.gap.rollout_errors import RolloutMetric, rolled_out, rollout_metrics
from avtorch.gap.simulator.plant import plant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from tests.gap.records import command_over, record_of

RATE = 10


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
    told = RolloutMetric(channel, horizon).products(np.stack([long, -2 * long]), blocks, 1 / RATE, 0.4)
    length = round(horizon * RATE)
    squares: list[list[float]] = [[] for _ in time]
    squares[-1].append(0.0)  # a rollout begun at the last row
    for first in range(len(time) - 1):
        last = min(first + length, len(time))
        errors = seen[channel][first:last] - rolled(first, last, begun[first])[channel]
        for row, error in enumerate(errors, first):
            squares[row].append(error**2)
    by_row = np.array([np.mean(each) for each in squares])
    want = np.array([by_row[b].sum() for b in blocks])
    np.testing.assert_allclose(told, want[:, None, None] * np.array([[1, -2], [-2, 4]]), atol=1e-9)


def test_the_usual_ones_have_the_schemas_names() -> None:
    names = [m.name for m in rollout_metrics(("accel", "speed"))]
    assert {"rollout_rmse_accel", "rollout_rmse_speed", "rollout_rmse_accel_2s", "rollout_rmse_speed_whole"} <= {*names}
    assert len(set(names)) == len(names) == 8
    rows = np.arange(1.0, 6.0)[None]
    assert RolloutMetric("accel", None).products(rows, [slice(1, 5)], 0.1, 0.3).tolist() == [[[4 + 9 + 16 + 25]]]
    assert RolloutMetric("speed", None).products(rows, [slice(1, 5)], 0.1, 0.3).tolist() == [[[1 + 4 + 9 + 16]]]


def test_a_force_that_sets_in_leaves_the_speed_where_it_is() -> None:
    """Rolled out from the start on, the speed would have fallen by half a minute's resistance at the onset."""
    record = record_of(60.0)
    plain, late = plant([]), plant([ConstantResistance(0.4)])
    before, found = rolled_out(record, plain), rolled_out(record, late, {"constant_resistance": 30.0})
    whole, time = rolled_out(record, late), record.time[record.source]
    early, speed, accel = time < 30.0, record.channels.index("speed"), record.channels.index("accel")
    np.testing.assert_array_equal(found[:, early], before[:, early])
    np.testing.assert_array_equal(found[accel][~early], whole[accel][~early])
    fallen = (before - found)[speed][~early].mean(-1)
    np.testing.assert_allclose(fallen, 0.4 * (time[~early] - time[~early][0]), atol=0.05)
