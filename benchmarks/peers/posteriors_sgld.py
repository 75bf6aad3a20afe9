"""SGLD of the package ``posteriors``: many chains as leading dimension, eager torch, from the sums.

Settings: as in `benchmarks.peers.blackjax_sgld`; always whitened, and several windows are one more dimension. avtorch's
own search for the mode and its log density are used, so only the sampler differs.
"""

from __future__ import annotations

import numpy as np
import posteriors
import torch
from torch import Tensor

from avtorch.inference import JerkDensity, Mode, find_mode
from benchmarks.peers.contract import Answer
from benchmarks.peers.own import OwnDensity, density_of
from benchmarks.peers.problem import Windows


class Runner(OwnDensity):
    def run(self, windows: Windows, seed: int) -> Answer:
        s, density = self.settings, density_of(windows)
        torch.manual_seed(seed)  # posteriors draws from the global generator
        mode = find_mode(density)
        scale = mode.scale / _stiffness(density, mode).sqrt()[:, None, None]

        def log_posterior(w: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
            z = mode.z + torch.einsum("wij,cwj->cwi", scale, w)
            return density.log_prob(z).sum(), torch.tensor([])

        # its step is that of w + e grad + sqrt(2 e) noise
        sgld = posteriors.sgmcmc.sgld.build(log_posterior, lr=0.5 * s["step"])
        state, batch = sgld.init(torch.zeros(s["chains"], *mode.z.shape, dtype=torch.float64)), torch.tensor([])
        kept = torch.empty(s["draws"], *state.params.shape, dtype=torch.float64)
        for k in range(s["burn_in"] + s["draws"] * s["thinning"]):
            state, _ = sgld.update(state, batch)
            collected = k + 1 - s["burn_in"]
            if collected > 0 and collected % s["thinning"] == 0:
                kept[collected // s["thinning"] - 1] = state.params
        z = mode.z + torch.einsum("wij,ncwj->cnwi", scale, kept)
        return Answer(np.asarray(z.exp()))


def _stiffness(density: JerkDensity, mode: Mode, radius: float = 3.0) -> Tensor:
    """How much steeper the whitened potential of each window gets ``radius`` SDs out, ``(window,)``."""
    axes = radius * torch.eye(3, dtype=torch.float64)
    probes = torch.cat([axes, -axes])[:, None].expand(-1, density.windows, 3).clone().requires_grad_()
    potential = -density.log_prob(mode.z + torch.einsum("wij,cwj->cwi", mode.scale, probes))
    (gradient,) = torch.autograd.grad(potential.sum(), probes)
    slope = (gradient * probes.detach()).sum(-1) / radius**2
    return slope.nan_to_num(posinf=1e6).amax(0).clamp(1.0, 1e6)
