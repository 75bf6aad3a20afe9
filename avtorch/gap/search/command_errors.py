"""Random errors of the command with a variance given by an effect: their gain in the likelihood of a rollout.

An error in one row's command passes the actuator as the command does. The whitened errors are therefore white noise
plus the output of a small linear system driven by the command's errors. A Kalman filter of that system gives each row's
density given the earlier rows. Stretches are processed in parallel chunks, each started some rows earlier.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.row_response import RowResponse


def command_error_gains(
    white: WhiteningFilter, errors: FloatArray, variance: FloatArray, T_L: float, K_L: float
) -> FloatArray:
    """Log likelihood ratio (counted,) of each row: commands with errors of this `variance` against commands as logged.

    Args: `errors` (channel, counted, 1) of a rollout with `T_L` [s] and `K_L` at the log's own rate; `variance`
    (counted,) [(m/s²)²], independent from row to row.
    """
    record, response = white.record, RowResponse.of(white, T_L, K_L)
    move, push, see, warm = response.move, response.push, response.see, response.warm
    place, valid = zip(*response.chunks(record), strict=True)
    at, own = np.array(place), np.array(valid)
    e = np.where(own, white(errors)[:, at, 0], 0.0)  # (channel, chunk, step)
    driven = np.where(own, variance[at], 0.0)
    one, pushed = np.eye(len(see)), np.outer(push, push)
    state, spread = np.zeros((len(at), len(push))), np.zeros((len(at), len(push), len(push)))
    out = np.zeros(at.shape)
    for t in range(at.shape[1]):
        left = e[:, :, t].T - state @ see.T
        cross = spread @ see.T
        inverse = np.linalg.inv(see @ cross + one)
        gain = cross @ inverse
        out[:, t] = 0.5 * (
            (e[:, :, t] ** 2).sum(0) - np.einsum("cw,cwx,cx->c", left, inverse, left) + np.linalg.slogdet(inverse)[1]
        )
        state = (state + (gain @ left[..., None])[..., 0]) @ move.T
        spread = move @ (spread - gain @ cross.mT) @ move.T + driven[:, t, None, None] * pushed
    rows = np.zeros(record.rows)
    kept = own[:, warm:]
    rows[at[:, warm:][kept]] = out[:, warm:][kept]
    return rows
