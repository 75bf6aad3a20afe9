r"""A random force that is there while the car is braked, or while it is driven.

Brakes that pulse and engines that surge leave a residual that is larger in the frames where they work (noise with a
variance that depends on a regressor; Harvey 1976). In frame f and band b

    V_fb = S_b + r_b^2 e_f 1 1',

e_f the mean square of the demand of that sign in the frame, as the force of both channels would show it if it were
spread evenly below `CLAIM_HZ`; S_b is free. The relative size r_b of each band is summed over a grid, of which 0 has
half of the prior.
"""

from __future__ import annotations

import numpy as np

from avtorch.gap.engine.free_forms import FreeFormFit, demand_response
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import claim_bands, log_sum
from avtorch.gap.engine.priors import CLAIM_HZ
from avtorch.gap.engine.shape_error import frame_energy, noise_beside
from avtorch.gap.engine.slow_forces import expected_force

SIZES = (0.0, 0.03, 0.06, 0.12, 0.24, 0.48)
"""Root mean square of the force over that of the demand [-]: doublings up to a half."""
SIGNS = {"rough_braking": -1.0, "rough_driving": 1.0}
_LOG_PRIOR = np.log([0.5, *[0.5 / (len(SIZES) - 1)] * (len(SIZES) - 1)])


def roughness(h: Hypothesis, form: str) -> FreeFormFit:
    """Evidence of a random force, one of `SIGNS`, beside a hypothesis of two channels.

    `nats` over equal noise in all frames; `residual` without what the force is expected to have done; `coefficients`
    (band,): the likeliest size [-].
    """
    data, bands = h.data, claim_bands(h.data)
    demand = np.maximum(SIGNS[form] * h["K_L"] * h.command(), 0.0)[None]
    response = demand_response(h, demand, np.array([h["T_L"]]))[0, 0]
    rows = 1.0 / data.dt
    square = (response**2).sum(-1) / (data.hop_s * rows)
    force = (square * rows / (2 * CLAIM_HZ))[:, None, None, None] * np.ones((1, bands, 2, 2))
    observed = frame_energy(data, h.residual)[:, :bands]
    counts = np.diff(data.band_edges)[:bands].astype(float)
    nats, covariances, _ = noise_beside(observed, force, counts, np.array(SIZES))
    each = nats - nats[0] + _LOG_PRIOR[:, None]
    best = each.argmax(0)
    size = np.array(SIZES)[best]
    noise = covariances[best, np.arange(bands)]
    return FreeFormFit(
        float(sum(log_sum(list(band)) for band in each.T)),
        h.residual - expected_force(data, h.residual, size**2 * force[..., 0, 0], noise),
        size,
    )
