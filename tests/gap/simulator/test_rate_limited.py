"""Rate limits row by row against the actuator's own closed form, one part at a time."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avtorch.gap.simulator import actuator
from avtorch.gap.simulator.actuator import Actuator, ActuatorState, Substep, by_rows

D = torch.float64
ROWS = 60


def _parts(batch: tuple[int, ...], generator: torch.Generator, count: int) -> list[Substep]:
    """Targets that jump, some parts of length 0, lags by column."""
    made = []
    for _ in range(count):
        target = 2 * torch.randn(*batch, ROWS, generator=generator, dtype=D).cumsum(-1) / 4
        length = 0.05 * torch.rand(*batch, ROWS, generator=generator, dtype=D)
        length[..., 7] = 0.0
        lag = 0.1 + torch.rand(*batch, 1, generator=generator, dtype=D)
        made.append(Substep(target, lag, length))
    return made


def _stepped(start: Tensor, parts: list[Substep], rise: Tensor, fall: Tensor) -> Tensor:
    """Closed form, a row at a time: where the limit lets go is solved for, then the exponential."""
    state, rows = start, []
    for k in range(ROWS):
        for part in parts:
            target, lag, length = (x[..., k] if x.shape[-1] > 1 else x[..., 0] for x in vars(part).values())
            d = target - state
            jerk = torch.where(d > 0, rise, fall)
            # at the limit until |target - a| / T = J
            until = ((d.abs() - jerk * lag) / jerk).clamp_min(0.0).minimum(length)
            state = state + d.sign() * jerk * until
            state = target + (state - target) * torch.exp(-(length - until) / lag)
        rows.append(state)
    return torch.stack(rows, -1)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("limit", [0.3, 2.0, 1e3])
def test_rows_are_the_closed_form(batch: tuple[int, ...], count: int, limit: float, fresh_seed: int) -> None:
    g = torch.Generator().manual_seed(fresh_seed)
    parts = _parts(batch, g, count)
    start = torch.randn(batch, generator=g, dtype=D)
    jerk = limit * (0.5 + torch.rand(*batch, 1, generator=g, dtype=D))
    fall = jerk * (0.3 + torch.rand(*batch, 1, generator=g, dtype=D))
    got = by_rows(start, parts, (jerk, fall))
    assert got.shape == (*batch, ROWS)
    torch.testing.assert_close(got, _stepped(start, parts, jerk[..., 0], fall[..., 0]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("limit", [0.3, 2.0, 1e3, float("inf")])
def test_rows_are_the_actuators_steps(limit: float, fresh_seed: int) -> None:
    """`over` is built on the rows, `step` is not."""
    g = torch.Generator().manual_seed(fresh_seed)
    parts = _parts((4,), g, 2)
    start = torch.randn(4, generator=g, dtype=D)
    jerk, fall = torch.full((4, 1), limit, dtype=D), torch.full((4, 1), 0.6, dtype=D)
    one = Actuator(jerk=jerk[:, 0], fall=fall[:, 0])
    state, rows, speeds = ActuatorState(start), [start], []
    for k in range(ROWS - 1):
        now = [Substep(p.target[:, k], p.lag[:, 0], p.length[:, k]) for p in parts]
        state, gained, _ = one.step(state, now)
        rows.append(state.accel)
        speeds.append(gained)
    a, gained = Actuator(jerk=jerk, fall=fall).over(start, parts)
    torch.testing.assert_close(a, torch.stack(rows, -1), rtol=0, atol=1e-10)
    torch.testing.assert_close(gained, torch.stack(speeds, -1), rtol=0, atol=1e-10)


def test_slewed_rows_are_the_closed_form(fresh_seed: int) -> None:
    g = torch.Generator().manual_seed(fresh_seed)
    parts = _parts((3,), g, 2)
    start, jerk = torch.randn(3, generator=g, dtype=D), torch.full((3, 1), 1.5, dtype=D)
    got, state, limits = by_rows(start, parts, (jerk, 0.5 * jerk), slews=True), start, (jerk[:, 0], 0.5 * jerk[:, 0])
    for k in range(ROWS):
        for part in parts:
            now = Substep(part.target[:, k], part.lag[:, 0], part.length[:, k])
            state = actuator._slewed(state, now, limits)[0]
        torch.testing.assert_close(got[:, k], state, rtol=0, atol=1e-12)


def test_a_limit_that_never_binds_is_the_lag_alone() -> None:
    target, h, lag = torch.ones(ROWS, dtype=D), torch.tensor(0.05, dtype=D), torch.tensor([0.4], dtype=D)
    got = by_rows(torch.zeros((), dtype=D), [Substep(target, lag, h)], (torch.tensor(float("inf"), dtype=D),) * 2)
    time = 0.05 * torch.arange(1, ROWS + 1, dtype=D)
    torch.testing.assert_close(got, 1 - torch.exp(-time / 0.4), rtol=0, atol=1e-12)
