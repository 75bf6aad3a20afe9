"""The noise of a log as the engine has it, band by band, and the same at the rows of another drive.

Coefficients of an orthonormal transform have the variance of white rows, whatever their rate. The mean of n rows has
an n-th of it. A central difference over rows dt apart sees less of a fast speed than its derivative has,

    sin(2 pi f dt) / (2 pi f dt),

so that the spectrum of the derivative is what is carried over.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis

_LEAST_GAIN = 0.03  # of a difference: at half of the rows' rate it sees nothing


@dataclass(frozen=True, eq=False)
class NoiseSpectrum:
    """`covariance` (band, channel, channel) [(m/s²)²] of the coefficients of single rows of a log, at the bands'
    middles `frequency` (band,) [Hz]: of acceleration and derivative of the speed, as far as `channels` has them.

    `highest` [Hz]: nothing is known above.
    """

    channels: tuple[str, ...]
    frequency: FloatArray = field(repr=False)
    covariance: FloatArray = field(repr=False)
    highest: float

    @classmethod
    def of(cls, h: Hypothesis) -> Self:
        """What an evaluated hypothesis leaves."""
        data = h.data
        middle = np.add.reduceat(data.frequency, data.band_edges[:-1]) / np.diff(data.band_edges)
        gain = _gains(data.channels, middle, data.dt)
        return cls(data.channels, middle, data.group * h.covariance / gain, float(data.frequency[-1]))

    def at(self, data: DriveData, group: int) -> FloatArray:
        """Covariance (bin, channel, channel) of the coefficients of `data`, whose rows are means of `group` rows of
        the log."""
        of = [self.channels.index(name) for name in data.channels]
        S = self.covariance[:, of][:, :, of].reshape(len(self.frequency), -1)
        near = np.log(data.frequency)
        each = np.stack([np.interp(near, np.log(self.frequency), entry) for entry in S.T], 1)
        gain = _gains(data.channels, data.frequency, data.dt)
        return each.reshape(-1, len(of), len(of)) / group * gain


def _gains(channels: tuple[str, ...], frequency: FloatArray, dt: float) -> FloatArray:
    """Products (frequency, channel, channel) of the channels' gains over acceleration and derivative of the speed."""
    difference = np.maximum(np.sinc(2 * frequency * dt), _LEAST_GAIN)
    each = np.stack([difference if name == "speed" else np.ones_like(frequency) for name in channels], 1)
    return each[:, :, None] * each[:, None]
