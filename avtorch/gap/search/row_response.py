"""What an error in one row's command does to the white errors of that row and of those after it.

The command passes the actuator, and the rollout's errors pass the whitening filter: a linear system of a few states.
Its response dies out, so stretches can be filtered in chunks side by side, each begun some rows earlier.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter

_ORDER = 4  # states at most
_SHORTEST = 120  # rows of a chunk, at least
_REST = 0.005  # share of the response's energy, which may be left when a chunk begins to count


@dataclass(frozen=True, eq=False)
class RowResponse:
    """The linear system: x' = `move` x + `push` u for an error u of the command, and `see` x of the white errors.

    `energy`: the sum of squares of the response. Chunks have `size` rows behind `warm` rows to get going.
    """

    move: FloatArray
    push: FloatArray
    see: FloatArray
    energy: float
    warm: int
    size: int

    @classmethod
    def of(cls, white: WhiteningFilter, T_L: float, K_L: float) -> RowResponse:
        image = image_of_row(white, T_L, K_L)
        move, push, see = states_of(image)
        energy = np.cumsum((image**2).sum(0))
        warm = 8 + int(np.searchsorted(energy, (1 - _REST) * energy[-1]))
        return cls(move, push, see, float(energy[-1]), warm, max(3 * warm, _SHORTEST))

    def chunks(self, record: Record) -> Iterator[tuple[IntArray, BoolArray]]:
        """Rows (step,) of each chunk, and which of them lie within its stretch; others repeat the stretch's ends."""
        for first, last in zip(record.starts, [*record.starts[1:], record.rows], strict=True):
            for begin in range(first, last, self.size):
                rows = np.arange(begin - self.warm, begin + self.size)
                yield rows.clip(first, last - 1), (rows >= first) & (rows < last)


def image_of_row(white: WhiteningFilter, T_L: float, K_L: float) -> FloatArray:
    """White errors (channel, time) of one row whose command is one unit larger than logged."""
    dt = white.record.dt
    length = 2 * max(16, round(6 * T_L / dt) + 8)
    decay = np.exp(-dt / T_L)
    accel, speed = np.zeros(length), np.zeros(length)
    accel[1:] = K_L * (1 - decay) * decay ** np.arange(length - 1)
    # its integral, the command's row exact
    speed[1] = K_L * (dt - T_L * (1 - decay))
    speed[2:] = speed[1] + T_L * K_L * (1 - decay) * (1 - decay ** np.arange(1, length - 1))
    return white.response(np.stack([{"accel": accel, "speed": speed}[name] for name in white.record.channels]))


def states_of(image: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A few states whose response to a unit pulse is `image` (channel, time): (move, push, see) of `RowResponse`.

    Singular vectors of the image's Hankel matrix (Kung 1978), in output-normal coordinates.
    """
    channels, length = image.shape
    half = length // 2
    index = 1 + np.arange(half)[:, None] + np.arange(half - 1)
    hankel = image[:, index].transpose(1, 0, 2).reshape(half * channels, half - 1)  # (later row and channel, earlier)
    u, s, v = np.linalg.svd(hankel, full_matrices=False)
    order = max(1, min(_ORDER, int((s > 1e-3 * s[0]).sum())))
    u, push = u[:, :order], s[:order] * v[:order, 0]
    move = np.linalg.lstsq(u[:-channels], u[channels:], rcond=None)[0]
    return move, push, u[:channels]
