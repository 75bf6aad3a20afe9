"""The transpose of the map that makes errors white: the same filter, run backward in time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from avtorch.gap.innovations import Whitener

Float = NDArray[np.float64]


def adjoint(white: Whitener, images: Float) -> Float:
    """`Wᵀ` of images (..., witness, counted, 1 + group) of `white`, or (..., 1): (..., witness, counted, group)."""
    record = white.record
    mean = np.array(images[..., 0])
    starts, stretch = record.starts, record.stretch
    offset = "speed" in record.witnesses
    if offset:
        image, square = white._offset
        part = np.add.reduceat((mean * image).sum(-2), starts, -1) / square
        mean -= image * part[..., None, stretch]
    tops, bottom, _ = white._filter
    turned = record.padded(mean)[..., ::-1]
    back = np.empty_like(mean)
    count = mean.shape[-2]
    for i in range(count):
        total = np.sum([np.asarray(lfilter(tops[o][i], bottom, turned[..., o, :], axis=-1)) for o in range(count)], 0)
        back[..., i, :] = total[..., ::-1][..., record.target]
    if offset:  # each stretch's first speed was taken off all of its rows
        back[..., -1, starts] -= np.add.reduceat(back[..., -1, :], starts, -1)
    spread = np.repeat(back[..., None] / record.group, record.group, -1)
    if images.shape[-1] == 1 or white.noise.within is None:
        return spread
    apart = images[..., 1:] / np.array(white.noise.within)[:, None, None]
    return spread + apart - apart.mean(-1, keepdims=True)
