"""A model of the alias set, with all that is needed to predict another drive of the same car.

Its noise is that of the log band by band, and the same at the rows of another drive. Coefficients of an orthonormal
transform have the variance of white rows, whatever their rate. The mean of n rows has an n-th of it. A central
difference over rows dt apart sees less of a fast speed than its derivative has,

    sin(2 pi f dt) / (2 pi f dt),

so that the spectrum of the derivative is what is carried over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.result.hypotheses import Verdict
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io.units import GRAVITY

MOST_MODELS = 5
"""That an experiment is asked to tell apart."""
_STAND_IN = 3
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


@dataclass(frozen=True, eq=False)
class PredictiveModel:
    """`plant` with the settings taken from the log; `belief`: draws (draw,) of its parameters by its own names.

    `noise`: of the log. `grade_rms`: size of an unknown road grade, None where the model has none.
    `specific_force`: whether the log's `accel` is an accelerometer's reading.
    """

    name: str
    plant: GapPlant = field(repr=False)
    belief: Mapping[str, FloatArray] = field(repr=False)
    noise: NoiseSpectrum = field(repr=False)
    grade_rms: float | None = None
    specific_force: bool = False

    @classmethod
    def of(cls, posterior: ParameterPosterior, baseline: GapPlant | None, noise: NoiseSpectrum) -> PredictiveModel:
        """The predictive model of a weight of the model average."""
        weight = posterior.weight
        grade = weight.composition.slow.road_sd / GRAVITY if "road_grade" in posterior.names else None
        return cls(
            name=weight.label,
            plant=posterior.plant(baseline),
            belief=posterior.belief(),
            noise=noise,
            grade_rms=grade,
            specific_force=weight.examined.hypothesis.data.accel_kind == "specific-force",
        )


def predictive_models(
    posteriors: Mapping[str, ParameterPosterior], verdict: Verdict, baseline: GapPlant | None
) -> tuple[PredictiveModel, ...]:
    """Models of the verdict's alias set, the verdict first; at most five.

    `unknown` makes no predictions: where it leaves fewer than two models, the named ones of most weight are added,
    because an experiment that distinguishes these tests the car for all that they represent. All have the noise that
    the first one leaves: a difference of levels would tell models apart in any drive, whatever it is made of.
    """
    names: Sequence[str] = [n for n in verdict.alias_set if n in posteriors]
    if (len(names) < 2 and len(verdict.alias_set) > 1) or verdict.abstained:
        others = [n for n in posteriors if n not in names]
        apart: dict[frozenset[str], str] = {}  # models that differ only in a random effect predict the same
        for n in [*names, *others]:
            apart.setdefault(frozenset(posteriors[n].effects), posteriors[n].weight.label)
        names = list(apart.values())[: len(names) + _STAND_IN]
    if not names:
        return ()
    noise = NoiseSpectrum.of(posteriors[names[0]].weight.examined.hypothesis)
    return tuple(PredictiveModel.of(posteriors[n], baseline, noise) for n in names[:MOST_MODELS])
