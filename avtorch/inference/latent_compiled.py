"""Values of the latent log likelihood by compiled loops: what `latent_values` and `latent_rows` give without them.

A window of 200 rows at 256 parameters takes about a tenth of the time, on even rows and on uneven ones.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.latent_model import ACCEL_SD0, SPEED_SD0
from avtorch.inference.latent_steady import EvenRows
from avtorch.inference.latent_window import LatentWindow


@torch.no_grad()
def compiled_values(
    kernels: ModuleType,
    T_L: Float[Tensor, "*draw run"],
    K_L: Float[Tensor, "*draw run"],
    process_noise: Float[Tensor, "*draw run"],
    coloured_sd: Float[Tensor, "*draw run"],
    coloured_time: Float[Tensor, "*draw run"],
    runs: LatentWindow,
    even: EvenRows | None,
    *,
    accel_noise: Float[Tensor, "*draw run"] | None = None,
    speed_noise: Float[Tensor, "*draw run"] | None = None,
    road_noise: Float[Tensor, "*draw run"] | None = None,
) -> Float[Tensor, "*draw run"]:
    """Log likelihood ``(..., run)`` [nats] of stretches of rows in use, with no gradient; NaN where digits are lost.

    ``kernels`` is the module `latent_kernels`; where ``even`` is given the rows of a run are as far apart as it says.
    """
    zero = torch.zeros_like(T_L)
    six = (T_L, K_L, process_noise, zero if road_noise is None else road_noise, coloured_sd, coloured_time)
    two = (zero if x is None else x.square() for x in (speed_noise, accel_noise))
    given = torch.stack((*six, *two)).reshape(8, -1, T_L.shape[-1]).movedim(-1, 0).contiguous().numpy()
    speed = None if speed_noise is None or runs.speed is None else (runs.speed - runs.speed[:, :1]).numpy()
    accel = None if accel_noise is None or runs.accel is None else runs.accel.numpy()
    time, u, none = runs.time.numpy(), runs.u.numpy(), np.empty(0)
    found = np.empty((len(u), given.shape[2]))
    for run, rows in enumerate(runs.mask.sum(-1).tolist()):
        steps = np.diff(time[run, :rows]) if even is None else np.full(rows - 1, float(even.dt[run]))
        signals = (none if x is None else x[run, :rows] for x in (speed, accel))
        kernels.filtered(
            found[run],
            given[run, :6],
            given[run, 6:],
            SPEED_SD0,
            ACCEL_SD0,
            steps,
            even is not None,
            u[run, :rows],
            *signals,
        )
    return torch.from_numpy(found.T.copy()).reshape(T_L.shape)
