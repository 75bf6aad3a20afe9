"""The prediction of each remaining cause for a manoeuvre: a normal distribution of the measured rows.

Its mean is the rollout at the posterior mean of the parameters, its spread that of rollouts at posterior draws (and at
draws of the unknown slope); its noise is that of the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.experiment.manoeuvres import Manoeuvre
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.noise_draws import noise_draws
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.result.predictive_model import PredictiveModel
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.simulator_input import Response, SimulatorInput
from avtorch.io import Log

_SLOWEST_MPS = 0.5


def responses(contender: PredictiveModel, manoeuvres: Sequence[Manoeuvre], draws: slice) -> Response:
    """Rollouts (manoeuvre, draw, time) of manoeuvres of one length, at `draws` of the belief."""
    command = torch.as_tensor(np.stack([m.command for m in manoeuvres]))[:, None]
    speed = torch.as_tensor(np.stack([np.maximum(m.speed, _SLOWEST_MPS) for m in manoeuvres]))[:, None]
    time = torch.as_tensor(manoeuvres[0].time)
    belief = {k: torch.as_tensor(x[draws]) for k, x in contender.belief.items()}
    effects = contender.plant.effects
    for effect in effects:  # an effect with an onset in the log acts from the start
        for name, value in effect.values_after_onset().items():
            key = f"{effect.name}.{name}"
            if key in belief or name == effect.own_onset:
                belief |= {key: torch.full_like(belief["T_L"], value)}
    with torch.inference_mode():
        return contender.plant.response(SimulatorInput(time, command, speed, 0.0, contender.specific_force), belief)


@dataclass(frozen=True, eq=False)
class PredictiveLaw:
    """One contender's prediction of one manoeuvre: `mean` (channel, row), `spread` (direction, channel, row), noise."""

    white: WhiteningFilter = field(repr=False)
    mean: FloatArray = field(repr=False)
    spread: FloatArray = field(repr=False)

    def log_density(self, measured: FloatArray) -> FloatArray:
        """Log density of rows (draw, channel, row): (draw,) [nats]."""
        e = self._white(measured - self.mean)
        u = self._white(self.spread)
        constant = self.white.constant_of(coarse=False)
        gram = np.eye(len(u)) + u @ u.T
        match = e @ u.T
        taken = np.linalg.solve(gram, match.T).T
        size = float(np.linalg.slogdet(gram)[1])
        return constant - 0.5 * ((e**2).sum(-1) - (match * taken).sum(-1) + size)

    def _white(self, errors: FloatArray) -> FloatArray:
        """Whitened errors (column, white row) from errors (column, channel, row)."""
        if not len(errors):
            return np.zeros((0, 1))
        kept = errors[..., self.white.record.source, None]
        return self.white(kept).reshape(len(errors), -1)


@dataclass(frozen=True, eq=False)
class ManoeuvrePrediction:
    """One contender on all manoeuvres: `rollouts` (manoeuvre, draw, channel, row), half of which make the laws and
    half the examples.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.experiment import ManoeuvrePrediction, library
        >>> from avtorch.gap import DeadTime, plant
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log()
        >>> cause = diagnose(log, effects=["dead_time"], pairs=False).contenders[0]
        >>> manoeuvres = library()
        >>> predicted = ManoeuvrePrediction.of(cause, manoeuvres, ("accel", "speed"), group=1, draws=20)
        >>> predicted.rollouts.shape == (len(manoeuvres), 20, 2, len(manoeuvres[0].time))
        True
    """

    contender: PredictiveModel
    channels: tuple[str, ...]
    manoeuvres: Sequence[Manoeuvre] = field(repr=False)
    rollouts: FloatArray = field(repr=False)
    group: int

    @classmethod
    def of(
        cls,
        contender: PredictiveModel,
        manoeuvres: Sequence[Manoeuvre],
        channels: tuple[str, ...],
        group: int,
        draws: int,
    ) -> ManoeuvrePrediction:
        """Simulate with this many `draws`; rows of the manoeuvres are means of `group` rows of a log."""
        seen = responses(contender, manoeuvres, slice(0, draws))
        # parts that do not depend on the draw come without that dimension
        shape = (len(manoeuvres), draws, len(manoeuvres[0].time))
        parts = {"accel": seen.accel_measured, "speed": seen.speed}
        stacked = torch.stack([parts[name].expand(shape) for name in channels], -2).numpy()
        return cls(contender, channels, manoeuvres, stacked, group)

    def law(self, number: int) -> PredictiveLaw:
        """The prediction for manoeuvre `number`."""
        some = self.rollouts[number, ::2]
        mean = some.mean(0)
        spread = (some - mean) / np.sqrt(max(len(some) - 1, 1))
        road = self._road(number)
        white = WhiteningFilter(
            _record(self.manoeuvres[number], self.channels), self.contender.noise.of_means(self.group)
        )
        return PredictiveLaw(white, mean, spread if road is None else np.concatenate([spread, road]))

    def examples(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Simulated measurements, (draw, channel, row)."""
        some = self.rollouts[number, 1::2]
        count, _, rows = some.shape
        time = self.manoeuvres[number].time
        noise = self.contender.noise.of_means(self.group)
        seen = some + noise_draws(noise, rows, float(time[1] - time[0]), self.channels, count, rng)
        road = self._road(number)
        return seen if road is None else seen + np.einsum("dk,kwr->dwr", rng.standard_normal((count, len(road))), road)

    def _road(self, number: int) -> FloatArray | None:
        """Directions (knot, channel, row) in which an unknown slope moves the measurements."""
        size = self.contender.grade_rms
        if not size:
            return None
        m = self.manoeuvres[number]
        drive = SimulatorInput(torch.as_tensor(m.time), torch.as_tensor(m.command), torch.as_tensor(m.speed))
        assert drive.position is not None
        own = next(e for e in self.contender.plant.effects if isinstance(e, Integrated))
        road = own.prepared(drive.time, drive.speed, drive.position)
        force = size * road.columns(drive.position).numpy().T
        step = float(m.time[1] - m.time[0])
        gained = np.cumsum(0.5 * step * (force[:, 1:] + force[:, :-1]), -1)
        speed = np.concatenate([np.zeros((len(force), 1)), gained], -1)
        accel = np.zeros_like(force) if self.contender.specific_force else force
        return np.stack([{"accel": accel, "speed": speed}[name] for name in self.channels], 1)


def _record(m: Manoeuvre, channels: tuple[str, ...]) -> Record:
    """Rows of a manoeuvre at the sampling that a diagnosis uses."""
    speed = np.maximum(m.speed, _SLOWEST_MPS)
    given = {"accel": np.gradient(speed, m.time), "speed": speed}
    log = Log.from_arrays(time=m.time, accel_cmd=m.command, **{name: given[name] for name in channels})
    return Record.of(log, rate_hz=0.9 / float(m.time[1] - m.time[0]))
