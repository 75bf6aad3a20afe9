"""The prediction of each remaining cause for a manoeuvre, a normal distribution of the measured rows, and how well the
manoeuvre would distinguish the causes.

Its mean is the rollout at the posterior mean of the parameters, its spread that of rollouts at posterior draws (and at
draws of the unknown slope); its noise is that of the log. Measurements are compared as a diagnosis compares them, in
the engine's coefficients: nearly independent, each with the noise of its frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from scipy.integrate import cumulative_trapezoid
from scipy.special import logsumexp
from torch.distributions import LowRankMultivariateNormal

from avtorch.arrays import FloatArray
from avtorch.experiment.manoeuvres import Manoeuvre
from avtorch.gap.effects.road_grade import RoadGrade
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.result.predictive_model import PredictiveModel
from avtorch.gap.simulator.simulator_input import Response, SimulatorInput
from avtorch.io import Log

_SLOWEST_MPS = 0.5
_LONG_AGO_S = -1e6


def responses(contender: PredictiveModel, manoeuvres: Sequence[Manoeuvre], draws: slice) -> Response:
    """Rollouts (manoeuvre, draw, time) of manoeuvres of one length, at `draws` of the belief."""
    command = torch.as_tensor(np.stack([m.command for m in manoeuvres]))[:, None]
    speed = torch.as_tensor(np.stack([np.maximum(m.speed, _SLOWEST_MPS) for m in manoeuvres]))[:, None]
    time = torch.as_tensor(manoeuvres[0].time)
    belief = {k: torch.as_tensor(x[draws]) for k, x in contender.belief.items()}
    effects = contender.plant.effects
    for effect in effects:  # an effect with an onset in the log acts from the start
        if effect.own_onset is not None:
            belief |= {f"{effect.name}.{effect.own_onset}": torch.full_like(belief["T_L"], _LONG_AGO_S)}
    with torch.inference_mode():
        return contender.plant.response(SimulatorInput(time, command, speed, 0.0, contender.specific_force), belief)


@dataclass(frozen=True, eq=False)
class PredictiveLaw:
    """One contender's prediction of one manoeuvre in coefficients: `mean` (channel, frame, bin), `spread` (direction,
    channel, frame, bin), and a `root` (bin, channel, channel) of the noise's covariance."""

    mean: FloatArray = field(repr=False)
    spread: FloatArray = field(repr=False)
    root: FloatArray = field(repr=False)

    def log_density(self, measured: FloatArray) -> FloatArray:
        """Log density of coefficients (draw, channel, frame, bin): (draw,) [nats]."""
        errors, spread = (torch.as_tensor(self.whitened(x)) for x in (measured - self.mean, self.spread))
        law = LowRankMultivariateNormal(torch.zeros_like(spread[0]), spread.T, torch.ones_like(spread[0]))
        frames = self.mean.shape[1]
        scale = frames * float(np.log(np.einsum("kcc->kc", self.root)).sum())
        return law.log_prob(errors).numpy() - scale

    def whitened(self, errors: FloatArray) -> FloatArray:
        """Errors (column, channel, frame, bin) in units of the noise: (column, coefficient)."""
        return np.einsum("kcd,ndfk->ncfk", np.linalg.inv(self.root), errors).reshape(len(errors), -1)


class ManoeuvrePrediction:
    """One `contender` on all `manoeuvres`, simulated with so many `draws` of its belief: `rollouts` (manoeuvre, draw,
    channel, row), half of which make the laws and half the examples.

    Rows of the manoeuvres are means of `group` rows of a log that has these `channels`.
    """

    def __init__(
        self,
        contender: PredictiveModel,
        manoeuvres: Sequence[Manoeuvre],
        channels: tuple[str, ...],
        group: int,
        draws: int,
    ) -> None:
        self.contender, self.manoeuvres, self.channels, self.group = contender, manoeuvres, channels, group
        seen = responses(contender, manoeuvres, slice(0, draws))
        # parts that do not depend on the draw come without that dimension
        shape = (len(manoeuvres), draws, len(manoeuvres[0].time))
        parts = {"accel": seen.accel_measured, "speed": seen.speed_measured}
        self.rollouts: FloatArray = torch.stack([parts[name].expand(shape) for name in channels], -2).numpy()

    def law(self, number: int) -> PredictiveLaw:
        """The prediction for manoeuvre `number`."""
        some = self.coefficients(self.rollouts[number, ::2])
        mean = some.mean(0)
        spread = (some - mean) / np.sqrt(max(len(some) - 1, 1))
        road = self._road(number)
        return PredictiveLaw(mean, spread if road is None else np.concatenate([spread, road]), self._root)

    def examples(self, number: int, rng: np.random.Generator) -> FloatArray:
        """Coefficients of simulated measurements, (draw, channel, frame, bin)."""
        some = self.coefficients(self.rollouts[number, 1::2])
        seen = some + np.einsum("kcd,ndfk->ncfk", self._root, rng.standard_normal(some.shape))
        road = self._road(number)
        return seen if road is None else seen + np.tensordot(rng.standard_normal((len(seen), len(road))), road, 1)

    def coefficients(self, rows: FloatArray) -> FloatArray:
        """Readings (column, channel, row) as coefficients (column, channel, frame, bin)."""
        data = self._frames
        each = [dict(zip(self.channels, one, strict=True)) for one in rows]
        return np.stack([data.transform(data.channel_rows(x.get("accel"), x.get("speed"))) for x in each])

    @cached_property
    def _frames(self) -> DriveData:
        """The frames that a log of a manoeuvre has; they depend on its time alone."""
        m = self.manoeuvres[0]
        speed = np.maximum(m.speed, _SLOWEST_MPS)
        given = {"accel": np.gradient(speed, m.time), "speed": speed}
        log = Log.from_arrays(time=m.time, accel_cmd=m.command, **{name: given[name] for name in self.channels})
        return DriveData.of(log).below(self.contender.noise.highest)

    @cached_property
    def _root(self) -> FloatArray:
        return np.asarray(np.linalg.cholesky(self.contender.noise.at(self._frames, self.group)), np.float64)

    def _road(self, number: int) -> FloatArray | None:
        """Directions (knot, channel, frame, bin) in which an unknown slope moves the measurements."""
        size = self.contender.grade_rms
        if not size:
            return None
        m = self.manoeuvres[number]
        drive = SimulatorInput(torch.as_tensor(m.time), torch.as_tensor(m.command), torch.as_tensor(m.speed))
        assert drive.position is not None
        own = next(e for e in self.contender.plant.effects if isinstance(e, RoadGrade))
        road = own.prepared(drive.time, drive.speed, drive.position)
        force = size * road.columns(drive.position).numpy().T
        speed = cumulative_trapezoid(force, m.time, initial=0.0)
        accel = np.zeros_like(force) if self.contender.specific_force else force
        return self.coefficients(np.stack([{"accel": accel, "speed": speed}[name] for name in self.channels], 1))


@dataclass(frozen=True)
class Information:
    """`nats`: mutual information between the cause and the measurements to come, at most the entropy of the cause.

    `truth_probability`: expected probability of the true cause afterwards. `margin`: median log odds [nats] of the true
    cause against the likest other one, for the worst pair.
    """

    nats: float
    truth_probability: float
    margin: float


def information(
    predictions: Sequence[ManoeuvrePrediction], number: int, prior: Sequence[float], *, seed: int = 0
) -> Information:
    """The information of manoeuvre `number`, from simulated measurements; `prior` has the causes' probabilities.

    Each simulated measurement is scored under the distribution of each cause.
    """
    rng = np.random.default_rng([seed, number])
    laws = [f.law(number) for f in predictions]
    log_prior = np.log(np.maximum(np.asarray(prior, float) / np.sum(prior), 1e-6))
    nats, truth_probability, margin = 0.0, 0.0, np.inf
    for i, one in enumerate(predictions):
        measured = one.examples(number, rng)
        densities = np.stack([law.log_density(measured) for law in laws])
        joint = densities + log_prior[:, None]
        posterior = joint[i] - logsumexp(joint, axis=0)
        weight = float(np.exp(log_prior[i]))
        nats += weight * float((posterior - log_prior[i]).mean())
        truth_probability += weight * float(np.exp(posterior).mean())
        others = np.delete(densities, i, axis=0)
        margin = min(margin, float(np.median(densities[i] - others, axis=1).min()))
    return Information(max(nats, 0.0), truth_probability, margin)
