"""Law, lag and delay of a car that follows, estimated from its log: a law in front of a plant.

The law's inputs are the measured signals, so that a rollout covers the plant alone. Unmodelled motion of the car feeds
back through its own sensors; fitted over the whole band it does not bias the loop (prediction-error identification; see
`gap.engine.likelihood`). `K_L` is held at 1: it cannot be distinguished from the law's gains. The recorder has no delay
or filter of its own here: nothing tells it from those of the car.

The noise of the speed is what the controller does that no law predicts:

    V(f) = G(f)^2 [ 2 p^2 t / (1 + (w t)^2) + 2 s^2 tau / (1 + (w tau)^2) ] / dt + (w G(f))^2 r^2,    w = 2 pi f

jerk noise behind the lag, a slow force, and white noise of the measured speed, as a difference over rows dt apart sees
them (G). The diagnosis leaves the spectrum free; here it has this shape, and sizes with priors. With one channel and a
law that misses much, free bands are given up one by one: the loop is then fitted to the quietest, in which a recorder's
smoothing is all there is.

The likelihood alone gives intervals that are too narrow, so the spread between fits to parts of the drive widens them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.follower.laws import FollowerMeasurements, HeadwayLaw, of_law
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.simulator.effect import delay_effect, delay_key
from avtorch.gap.simulator.parameter import Parameter
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log

NEEDED = ("speed", "spacing", "lead_speed")
_WIDER = 2.0  # a delay can be far shorter than is typical, down to none


class Followed:
    """`law`, and a plant with a dead time or without, over the speed of a log; `data`: the log in coefficients.

    `seen`: the law's inputs (row,) in each stretch of `data`. Only the speed is a channel, as the acceleration of
    public recordings is its derivative. Raises `InputError` for a log without speed, spacing and the leader's speed,
    or without a stretch of following that is long enough.
    """

    def __init__(self, log: Log, law: HeadwayLaw, plant: GapPlant) -> None:
        for name in NEEDED:
            if getattr(log, name) is None:
                raise InputError(f"{log.name}: has no {name}, which a follower needs (with {', '.join(NEEDED)})")
        self.log, self.law, self.plant = log, law, plant
        self.data = DriveData.of(replace(log, accel=None, accel_cmd=np.zeros(log.rows)))
        rows = torch.as_tensor(self.data.source[:, None] + np.arange(self.data.group))
        means = [x[rows].mean(1) for x in seen_in(log)]
        bounds = pairwise(self.data.bounds.tolist())
        self.seen = [FollowerMeasurements(*(x[i:j] for x in means)) for i, j in bounds]

    @cached_property
    def coordinates(self) -> dict[str, Parameter]:
        """The law's parameters by `law.parameter`, `T_L` [s], and the dead time [s]; standard normal a priori."""
        law = {f"law.{p.name}": p for p in self.law.parameters}
        car = {key: p if key == "T_L" else _widened(p) for key, p in self.plant.parameters().items() if key != "K_L"}
        return law | car

    @property
    def size(self) -> int:
        return len(self.coordinates)

    @property
    def seconds(self) -> float:
        """Time that the car follows [s], in stretches that are long enough."""
        return len(self.data.time) * self.data.dt

    def values(self, z: FloatArray) -> dict[str, Tensor]:
        """Values (column,) by key, for `z` (column, coordinate)."""
        return {key: p.constrain(torch.as_tensor(z[:, i])) for i, (key, p) in enumerate(self.coordinates.items())}

    def z_of(self, values: Mapping[str, float]) -> FloatArray:
        """Coordinates (coordinate,) for values by key, at most four standard deviations from their priors' centres,
        where missing ones are."""
        there = [(p, values.get(key, float(p.typical()))) for key, p in self.coordinates.items()]
        return np.clip([float(p.unconstrain(torch.tensor(x, dtype=torch.float64))) for p, x in there], -4.0, 4.0)

    def residual(self, z: FloatArray) -> FloatArray:
        """Measured less simulated coefficients of the differenced speed, (column, frame, bin)."""
        values, data = self.values(z), self.data
        law = {k: v[:, None] for k, v in of_law(values).items()}
        car = {k: v for k, v in values.items() if not k.startswith("law.")} | {"K_L": torch.ones(len(z)).double()}
        speed = np.empty((len(z), len(data.time)))
        with torch.inference_mode():
            for (i, j), seen in zip(pairwise(data.bounds.tolist()), self.seen, strict=True):
                sent = self.law.command(law, seen).expand(len(z), -1)
                drive = SimulatorInput(torch.as_tensor(_even(data.time[i:j])), sent, seen.speed)
                speed[:, i:j] = self.plant.response(drive, car).speed.numpy()
        return data.measured[0] - data.transform([data.speed_difference(data.held(v)) for v in speed])

    def on(self, log: Log) -> Followed:
        """The same law and plant over other rows."""
        return Followed(log, self.law, self.plant)


def followed(log: Log, law: HeadwayLaw, *, dead_time: bool = True) -> Followed:
    """The response to a car-following log; `dead_time` False: the plant is the bare GLVD. Raises as `Followed`."""
    return Followed(log, law, plant([delay_effect()()] if dead_time else []))


def seen_in(log: Log) -> FollowerMeasurements:
    """The law's inputs over all rows of the log."""
    assert log.spacing is not None
    assert log.speed is not None
    assert log.lead_speed is not None
    return FollowerMeasurements(*(torch.as_tensor(x) for x in (log.spacing, log.speed, log.lead_speed)))


def car_of(values: Mapping[str, float]) -> GapPlant:
    """The plant with lag and delay as found, `K_L` 1."""
    kind, delay = delay_effect(), values.get(delay_key())
    return plant([] if delay is None else [kind.of({str(kind.shift): delay})], T_L=values["T_L"], K_L=1.0)


def _widened(p: Parameter) -> Parameter:
    """The parameter with a prior of more standard deviations."""
    low, high = p.constrain(_WIDER * p.unconstrain(torch.tensor([p.low, p.high], dtype=torch.float64))).tolist()
    return replace(p, low=low, high=high)


def _even(time: FloatArray) -> FloatArray:
    """Time stamps, made uniform where they only jitter in their last digits."""
    even = np.linspace(time[0], time[-1], len(time))
    return even if np.abs(even - time).max() < 0.02 * (even[1] - even[0]) else time


_PRIORS = np.array(
    [
        (np.log(0.05), 1.2),  # p [m/s²]
        (0.0, 0.3),  # t, over T_L
        (np.log(0.1), 1.0),  # s [m/s²]
        (np.log(2.2), 0.63),  # tau [s]
        (np.log(0.02), 1.2),  # r [m/s]
    ]
)
"""Mean and standard deviation of the logarithms. A controller's own doings are as large as a gust."""


def _log_variance(data: DriveData, lag: float, w: FloatArray) -> FloatArray:
    """Logarithm of the noise's variance (bin,) by the five sizes and times `w`, standard normal a priori; `lag` [s] is
    the actuator's."""
    p, ratio, s, tau, r = np.exp(_PRIORS[:, 0] + _PRIORS[:, 1] * w)
    turn = 2 * np.pi * data.frequency
    gain = np.sinc(2 * data.frequency * data.dt)
    force = sum(2 * sd**2 * time / (1 + (turn * time) ** 2) for sd, time in ((p, ratio * lag), (s, tau)))
    return np.log(gain**2 * (force / data.dt + (turn * r) ** 2) + 1e-16)


_ITERATIONS = 30
_ENOUGH = 0.01  # nats that a last step gains
_STEP = 1e-4  # of finite differences
_LONGEST, _SHORTEST = 1.0, 1e-4  # steps, in standard deviations of the prior
_FARTHEST, _NOISE_FARTHEST = 5.0, 4.0
_DRAWS = 2000
_PART_S = 60.0
_PARTS = 6
_DELAYS_S = (0.3, 1.2)


@dataclass(frozen=True, eq=False)
class Identified:
    """`z` (coordinate,) at the mode, and its `covariance`; `w`: the noise's sizes and times there."""

    candidate: Followed = field(repr=False)
    z: FloatArray
    w: FloatArray = field(repr=False)
    covariance: FloatArray = field(repr=False)

    @property
    def values(self) -> Mapping[str, float]:
        """Parameters at the mode, by key: `law.*`, `T_L` [s], `dead_time.delay_s` [s]."""
        return {k: float(v[0]) for k, v in self.candidate.values(self.z[None]).items()}

    @property
    def noise(self) -> FloatArray:
        """Variance (bin,) of the differenced speed's coefficients [(m/s²)²]."""
        return np.exp(_log_variance(self.candidate.data, self.values["T_L"], self.w))

    def draws(self, covariance: FloatArray, *, seed: int = 0) -> dict[str, FloatArray]:
        """Parameters (draw,) of a normal posterior in `z` with this covariance."""
        noise = np.random.default_rng(seed).standard_normal((_DRAWS, len(self.z)))
        # a root that is valid also where round-off made the covariance indefinite
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        z = np.clip(self.z + noise @ (vectors * np.sqrt(np.maximum(values, 1e-14))).T, -8.0, 8.0)
        return {k: x.numpy() for k, x in self.candidate.values(z).items()}


def identified(candidate: Followed, *, start: Identified | None = None) -> Identified:
    """The fit to the candidate's log, from a short and a long delay, or from another fit's place."""
    delays = _DELAYS_S if delay_key() in candidate.coordinates else _DELAYS_S[:1]
    starts = [(candidate.z_of({delay_key(): delay}), np.zeros(len(_PRIORS))) for delay in delays]
    starts = starts if start is None else [(start.z, start.w)]
    best, _ = min((_mode(candidate, np.concatenate(place)) for place in starts), key=lambda found: found[1])
    n = candidate.size
    covariance = np.asarray(np.linalg.inv(_expansion(candidate, best)[1]), np.float64)[:n, :n]
    return Identified(candidate, best[:n], best[n:], covariance)


def widened(found: Identified) -> FloatArray:
    """The fit's covariance, each coordinate widened by the excess spread of fits to parts of its log."""
    own = found.candidate
    count = int(min(_PARTS, own.seconds // _PART_S))
    if count < 2:
        return found.covariance
    edges = [*own.data.source[np.arange(count) * len(own.data.source) // count].tolist(), own.log.rows]
    parts = []
    for first, last in pairwise(edges):
        try:
            part = own.on(own.log[first:last])
        except InputError:  # no stretch of it is long enough
            continue
        if part.seconds > 0.3 * _PART_S:
            parts.append(identified(part, start=found).z)
    if len(parts) < 2:
        return found.covariance
    # the same prior pulls each part: their spread is a lower bound on the uncertainty
    between = np.var(parts, axis=0, ddof=1) / len(parts)
    wider = np.sqrt(np.maximum(between / np.diag(found.covariance), 1.0))
    return found.covariance * np.outer(wider, wider)


def _mode(own: Followed, start: FloatArray) -> tuple[FloatArray, float]:
    """The likeliest coordinates and noise, and `_cost` there, by scoring steps within limits and a box of trust. One
    across a crease of the delay gains nothing and is shortened."""
    farthest = np.repeat([_FARTHEST, _NOISE_FARTHEST], [own.size, len(_PRIORS)])
    x, cost, trust = start, _cost(own, start), _LONGEST
    for _ in range(_ITERATIONS):
        gradient, information = _expansion(own, x)
        root = np.linalg.cholesky(information)
        gain = 0.0
        while gain <= 0 and trust > _SHORTEST:
            ends = np.maximum(-farthest - x, -trust) - 1e-12, np.minimum(farthest - x, trust) + 1e-12
            step = lsq_linear(root.T, -np.linalg.solve(root, gradient), ends, "bvls").x
            gain = cost - _cost(own, x + step)
            trust = min(4 * trust, _LONGEST) if gain > 0 else trust / 8
        if gain > 0:
            x, cost = x + step, cost - gain
        if gain < _ENOUGH:
            break
    return x, cost


def _cost(own: Followed, x: FloatArray) -> float:
    """Minus the log posterior [nats] of coordinates and then noise, x (size,)."""
    z, w = x[None, : own.size], x[own.size :]
    residual = own.residual(z)[0]
    shape = _log_variance(own.data, float(own.values(z)["T_L"]), w)
    return 0.5 * float(((residual**2) * np.exp(-shape) + shape).sum() + x @ x)


def _expansion(own: Followed, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (size,) of `_cost` and Fisher's information (size, size); all rollouts are one batch."""
    n = own.size
    near = x + np.vstack([np.zeros(len(x)), _STEP * np.eye(len(x))])
    residual, *moved = own.residual(near[: n + 1, :n])
    lags = own.values(near[:, :n])["T_L"].tolist()
    shape, *shapes = (_log_variance(own.data, lag, w) for lag, w in zip(lags, near[:, n:], strict=True))
    by_shape = (np.stack(shapes) - shape) / _STEP
    sd = np.exp(0.5 * shape)
    left = residual / sd
    slopes = np.zeros((len(x), left.size))
    slopes[:n] = ((np.stack(moved) - residual) / (_STEP * sd)).reshape(n, -1)
    gradient = slopes @ left.ravel() + 0.5 * by_shape @ (1 - left**2).sum(0) + x
    return gradient, slopes @ slopes.T + 0.5 * len(left) * by_shape @ by_shape.T + np.eye(len(x))
