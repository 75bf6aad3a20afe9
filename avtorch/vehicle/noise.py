"""Jerk noise by scenario seed and step number.

Counter-based (Philox), hence random access: the draw at a step depends on the seed, the vehicle and the step alone. A
scenario therefore gives the same run alone or in a batch, for any division into blocks, and copying a loop copies no
generator. numpy, because torch's CPU generator keeps 32 bits of a seed and cannot jump.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError

_CHUNK = 1024  # steps drawn together: amortises the set-up of a stream


class Noise:
    """Standard normal draws for `seeds` (one per scenario) and `vehicles`."""

    def __init__(self, seeds: int | Sequence[int] | Tensor | None, scenarios: int, vehicles: int | None = None) -> None:
        """`seeds`: one per scenario; an int `s` means s, s+1, …; None means 0, 1, …. Raises `InputError` otherwise."""
        if seeds is None or isinstance(seeds, int):
            listed = [(seeds or 0) + i for i in range(scenarios)]
        else:
            listed = [int(s) for s in seeds]
        if len(listed) != scenarios or any(not 0 <= s < 2**63 for s in listed):
            raise InputError(f"seeds: found {len(listed)} for {scenarios} scenarios, needs one >= 0 for each")
        self.seeds = tuple(listed)
        self.vehicles = vehicles
        self._cached: tuple[int, Tensor] | None = None

    def _chunk(self, number: int) -> Float[Tensor, "time *vehicle scenario"]:
        if self._cached is None or self._cached[0] != number:
            rows = [
                [np.random.Generator(np.random.Philox(key=s, counter=[0, 0, i, number])) for s in self.seeds]
                for i in range(self.vehicles or 1)
            ]
            drawn = np.stack([np.stack([g.standard_normal(_CHUNK) for g in row], -1) for row in rows], -2)
            self._cached = number, torch.as_tensor(drawn if self.vehicles else drawn[:, 0])
        return self._cached[1]

    def steps(self, first: int, count: int) -> Float[Tensor, "time *vehicle scenario"]:
        """Draws of steps `first` … `first + count - 1`, (time, scenario), or (time, vehicle, scenario) in a platoon."""
        parts: list[Tensor] = []
        while count > 0:
            number, offset = divmod(first, _CHUNK)
            part = self._chunk(number)[offset : offset + count]
            parts.append(part)
            first, count = first + part.shape[0], count - part.shape[0]
        return torch.cat(parts)
