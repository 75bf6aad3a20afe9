"""The budget alone, as a call of its own and in a file of its own: pages of `diagnose` could not link to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike

from avtorch.display.progress import shows_progress
from avtorch.errors import InputError
from avtorch.gap.answer.budget import MATERIAL, Budget
from avtorch.gap.diagnose import diagnose
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import LogSource


@shows_progress
def gap_budget(
    logs: LogSource | Sequence[LogSource],
    *,
    baseline: GapPlant | str | PathLike[str] | None = None,
    effects: Sequence[str | type[Effect]] | None = None,
    material: float = MATERIAL,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | bool | None = None,
) -> Budget:
    """The budget of the gap between `baseline` (default: bare GLVD) and the car of these drives: that of `diagnose`.

    Args: as of `diagnose`. Raises `InputError` as it does, and for drives too short to hold out five blocks.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from avtorch.gap import ConstantResistance, gap_budget, plant
        >>> dragging = plant([ConstantResistance(0.2)], sigma=0.02)
        >>> log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05), plant=dragging).log()
        >>> gap_budget(log, effects=["constant_resistance", "dead_time"]).names
        ('constant_resistance',)
    """
    found = diagnose(logs, baseline=baseline, effects=effects, material=material, seed=seed, progress=progress)
    if found.budget is None:
        raise InputError(f"{found.log.name}: {found.log.seconds:.0f} s are too short to hold out five blocks of 4 s")
    return found.budget
