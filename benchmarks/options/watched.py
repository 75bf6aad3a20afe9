"""Drives under the supervisor that the options share: US06, a change to (1.5 s, 0.5) at 26 s, 80 s in all."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from avtorch.decision import SupervisedRun, Supervisor
from avtorch.inference.sequential import Belief
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader

CHANGE_S, DURATION_S = 26.0, 80.0
WORN = (1.5, 0.5)


def watched(
    loop: Callable[[Leader], ClosedLoop] | None = None,
    *,
    vehicle: tuple[float, float] = WORN,
    runs: int = 20,
    duration: float = DURATION_S,
    **supervisor: Any,
) -> SupervisedRun:
    """`runs` loops (default: the paper's) whose vehicle becomes `vehicle` (T_L [s], K_L) at 26 s."""
    leader = Leader.default()
    made = loop(leader) if loop else ClosedLoop(leader, scenarios=runs, seeds=0)

    def change(world: ClosedLoop) -> None:
        world.plant = GLVDPlant(*vehicle, sigma=0.1)

    return Supervisor(made, seed=0, **supervisor).run(duration, events=[(CHANGE_S, change)])


@lru_cache
def belief(vehicle: tuple[float, float] = WORN) -> tuple[Tensor, Tensor]:
    """Draws (draw,) of T_L [s] and K_L after the change, from the last window that was used by 40 s of one drive."""
    last = last_used(watched(vehicle=vehicle, runs=1, duration=40.0))
    T, K = (last.draws[:, 0, i].double() for i in range(2))
    return T, K


def last_used(run: SupervisedRun) -> Belief:
    """The last belief of a run of one car that followed from an excited window."""
    beliefs = [w.window.belief for w in run.windows]
    return [b for b in beliefs if bool(b.excited[0] & b.converged[0])][-1]


def median_and_range(values: Tensor) -> str:
    """Median of the runs with the range of the middle 90 %."""
    low, middle, high = torch.quantile(values.double(), torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)).tolist()
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"
