"""Whether part of the noise is a slow force by chance, such as wind: from the residuals' spectrum below 1 Hz.

GLVD has a random force of its own (`eps`), which its lag turns into noise that is flat up to 1 / (2 pi T_L); a sensor's
noise is flat, or in the derivative of speed grows with frequency. A slow force is none of these: it adds power below
0.2 Hz alone. The periodogram's ordinates are independent and exponential about the spectrum (Whittle), so the three
sizes without the force and with it are compared by likelihood. What a flexible regression makes of the residuals is
taken off first, and with it some of the force: what is left is predicted by nothing, whatever shook the car.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from avtorch.arrays import FloatArray
from avtorch.gap.answer.budget import ChancePart
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.quantity import Quantity
from avtorch.gap.selection.calibration import CALIBRATION
from avtorch.gap.simulator.effect import Effect

_BELOW_HZ = 1.0
_LEAST_S = 15.0  # of rows without a gap, for a periodogram
_REPEATED = 1 + 2 * ((2 / 3) ** 2 + (1 / 6) ** 2)  # ordinates that say the same, under a Hann window
_TIMES_S = (0.7, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)
_LAGS = (0.5, 1.0, 2.0)  # times a car's lag, that of GLVD's own noise may be: other equations of the actuator change it
_SLOWEST_S = 1.0  # lag that noise has from an actuator: a bare baseline may have a longer one in place of what it lacks
_RATIOS = np.exp(np.linspace(-1.6, 1.2, 15))  # of the force's SD to its most likely one
_NEGLIGIBLE = 1e-9
_FEWEST = 16  # independent ordinates, some four for each size
_SMALL = 0.05  # of its equal share, where a size starts that may be absent


@dataclass(frozen=True, eq=False)
class Periodogram:
    """Ordinates `power` (ordinate,) [(m/s²)² / Hz] at `frequency` [Hz]; `variance` [(m/s²)²] of all rows that count."""

    frequency: FloatArray
    power: FloatArray
    variance: float

    @classmethod
    def of(cls, record: AnalysisRecord, x: FloatArray) -> Periodogram:
        """Of `x` (row,), each run of rows that count by itself."""
        frequencies: list[FloatArray] = [np.zeros(0)]
        powers: list[FloatArray] = [np.zeros(0)]
        for run in record.runs():
            if (run.stop - run.start) * record.dt < _LEAST_S:
                continue
            rows = x[run] - x[run].mean()
            window = np.hanning(len(rows) + 2)[1:-1]
            frequency = np.fft.rfftfreq(len(rows), record.dt)
            power = 2 * record.dt * np.abs(np.fft.rfft(window * rows)) ** 2 / (window**2).sum()
            kept = (frequency > 0) & (frequency < _BELOW_HZ)
            frequencies.append(np.asarray(frequency[kept], float))
            powers.append(np.asarray(power[kept], float))
        return cls(np.concatenate(frequencies), np.concatenate(powers), float(x[record.counts].var()))

    def nats(self, spectrum: FloatArray) -> float:
        """Cost of a `spectrum` (ordinate,) (Whittle)."""
        spectrum = spectrum + _NEGLIGIBLE * self.power.mean()
        return float((np.log(spectrum) + self.power / spectrum).sum()) / _REPEATED

    def fitted(self, shapes: FloatArray) -> tuple[float, FloatArray]:
        """Least cost of a sum of `shapes` (shape, ordinate), and the sizes (shape,) in it."""
        equal = np.log(self.power.mean() / len(shapes) / shapes.mean(-1))

        def cost(z: FloatArray) -> float:
            return self.nats(np.exp(z) @ shapes)

        absent = np.eye(len(shapes)) * np.log(_SMALL)
        starts = equal + np.concatenate([np.zeros((1, len(shapes))), absent])
        bounds = [(z - 12.0, z + 6.0) for z in equal]
        found = min((minimize(cost, z, method="L-BFGS-B", bounds=bounds) for z in starts), key=lambda r: float(r.fun))
        return float(found.fun), np.exp(found.x)


def slow_disturbance(
    record: AnalysisRecord, residuals: FloatArray, T_L: float, kind: type[Effect], *, bare_lag: float | None = None
) -> ChancePart | None:
    """The random force `kind` in `residuals` (channel, row) [m/s²] of a car with lag `T_L` [s].

    `bare_lag` [s]: that of the baseline without any effect. A dead time leaves little to the lag beside it, and what
    shakes an actuator passes through all of it: by a lag of 0.03 s the Genesis had a gust of 0.7 s.

    Its probability weighs the likelihood's gain against two more parameters (BIC) and against what any effect has to
    gain over none (`calibration.json`). None where it is less likely than not, or where no run is long enough to see.
    """
    seen = Periodogram.of(record, residuals.mean(0))
    ordinates = len(seen.power) / _REPEATED
    if ordinates < _FEWEST:
        return None
    omega = 2 * np.pi * seen.frequency
    sensors = [omega**2 if channel == "speed" else np.ones_like(omega) for channel in record.channels]
    lags = [ratio * T_L for ratio in _LAGS] + ([] if bare_lag is None else [min(bare_lag, _SLOWEST_S)])
    owns = [np.array([1 / (1 + (omega * lag) ** 2), *sensors]) for lag in lags]
    bares = [seen.fitted(own)[0] for own in owns]
    own, bare = owns[int(np.argmin(bares))], min(bares)
    forces = [4 * time / (1 + (omega * time) ** 2) for time in _TIMES_S]  # of unit variance
    fits = [seen.fitted(np.concatenate([own, force[None]])) for force in forces]
    best = int(np.argmin([nats for nats, _ in fits]))
    probability = float(expit(bare - fits[best][0] - np.log(ordinates) - CALIBRATION.odds.effect))
    if probability < 0.5:
        return None
    # the two parameters over a grid, the other sizes as they give way
    sd = np.sqrt([sizes[-1] for _, sizes in fits])[:, None] * _RATIOS
    nats = np.array(
        [
            [seen.nats(sizes[:-1] @ own + (ratio**2 * sizes[-1]) * force) for ratio in _RATIOS]
            for force, (_, sizes) in zip(forces, fits, strict=True)
        ]
    )
    weight = np.exp(nats.min() - nats) * sd  # spaced by ratios
    weight /= weight.sum()
    times = np.broadcast_to(np.array(_TIMES_S)[:, None], sd.shape)
    names = kind.noise_parameters
    return ChancePart(
        name=kind.name,
        probability=probability,
        share_of_noise=min(float(fits[best][1][-1]) / seen.variance, 1.0),
        parameters={names["force_sd"]: _weighed(sd, weight), names["force_time"]: _weighed(times, weight)},
    )


def _weighed(x: FloatArray, weight: FloatArray) -> Quantity:
    order = np.argsort(x, axis=None, kind="stable")
    values, below = x.ravel()[order], np.cumsum(weight.ravel()[order])
    mean = float((x * weight).sum())
    sd = float(np.sqrt(((x - mean) ** 2 * weight).sum()))
    q05, q95 = (float(values[min(int(np.searchsorted(below, p)), len(values) - 1)]) for p in (0.05, 0.95))
    return Quantity(mean, sd, min(q05, mean), max(q95, mean))
