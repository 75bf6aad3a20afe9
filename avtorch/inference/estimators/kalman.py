r"""Joint Kalman filters: state and parameters in one normal belief, row by row, all vehicles at once.

The extended filter (Jazwinski 1970) replaces the model by its tangent at the mean:

.. math::
    \bar x = f(x),\quad \bar P = F P F^\top + Q, \qquad
    x^+ = \bar x + k\,(y - h(\bar x)),\quad P^+ = \bar P - k s k^\top,\quad
    s = H \bar P H^\top + r,\ k = \bar P H^\top / s

The unscented filter (Julier and Uhlmann 1997, ``kappa = 0``) passes 2d points of equal weight, :math:`x \pm \sqrt{d}\,
L_i` with ``L`` the Cholesky factor of the covariance, through the model itself; mean and covariance of the transformed
points are the prediction. Positive weights keep every covariance positive, and there is no tuning parameter.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.inference.belief import Summary
from avtorch.inference.estimator import WindowedEstimator
from avtorch.inference.form import Form, Rows
from avtorch.inference.jerk import JerkForm, JerkStatistics
from avtorch.inference.latent import GAP, NOISE_PRIOR, LatentForm
from avtorch.inference.latent_model import ACCEL_ROW, SPEED_ROW, Step, discretise, initial_covariance
from avtorch.inference.priors import LogNormalPrior

PLAUSIBLE = ((0.01, 20.0), (0.02, 20.0))
"""Bounds of ``T_L`` [s] and ``K_L``; a filter that leaves them has diverged, and restarts from the prior."""

Pair: TypeAlias = Float[Tensor, "*point vehicle 2"]
Whole: TypeAlias = Float[Tensor, "*point vehicle 6"]
"""States of the jerk form, ``(log T_L, log K_L)``, and of the latent form."""

_ROWS = {"speed": SPEED_ROW, "accel": ACCEL_ROW}


class GaussianState(NamedTuple):
    """A normal state: ``mean`` ``(vehicle, d)``, ``cov`` ``(vehicle, d, d)``; the last two are ``log T_L, log K_L``."""

    mean: Float[Tensor, "vehicle d"]
    cov: Float[Tensor, "vehicle d d"]


@dataclass(frozen=True)
class Observation:
    """One row of every vehicle.

    ``u`` and ``a``: demanded and, where it is known exactly, realised acceleration [m/s²], ``(vehicle,)``;
    ``measured``: ``(vehicle, channel)``; ``dt``: to the next row [s].
    """

    u: Float[Tensor, " vehicle"]
    a: Float[Tensor, " vehicle"]
    measured: Float[Tensor, "vehicle channel"]
    dt: Float[Tensor, ""]


class JerkState:
    """``(log T_L, log K_L)`` as a random walk, observed through Eq. 1: ``jerk = (K_L u - a)/T_L + N(0, sigma^2)``.

    `sigma`: jerk noise [m/s³], ``(vehicle,)``. `drift`: SD of the walk per square root of a second, of both logarithms.
    ``variance``: of every channel's noise, ``(vehicle, channel)``.
    """

    def __init__(self, sigma: Float[Tensor, " vehicle"], drift: float) -> None:
        self.variance = sigma.square().unsqueeze(-1)
        self._walk = drift**2 * torch.eye(2, dtype=sigma.dtype, device=sigma.device)
        self._still = torch.eye(2, dtype=sigma.dtype, device=sigma.device)

    def start(self, actuation: GaussianState, row: Observation) -> GaussianState:
        """The state at the first row of a run, given the belief in ``(log T_L, log K_L)``."""
        return actuation

    def advance(self, x: Pair, row: Observation) -> Pair:
        """The state a step later without noise, shape of ``x``."""
        return x

    def slope(self, x: Pair, row: Observation) -> Float[Tensor, "*point vehicle 2 2"]:
        """Derivative of :meth:`advance`, ``(..., vehicle, d, d)``."""
        return self._still.expand(*x.shape, 2)

    def noise(self, x: Float[Tensor, "vehicle 2"], row: Observation) -> Float[Tensor, "2 2"]:
        """Covariance of the step's noise at ``x`` ``(vehicle, d)``, broadcastable to ``(vehicle, d, d)``."""
        return row.dt * self._walk

    def observe(self, x: Pair, row: Observation, channel: int) -> Float[Tensor, "*point vehicle"]:
        """The channel's reading without noise, ``(..., vehicle)``."""
        log_T, log_K = x.unbind(-1)
        return (log_K.exp() * row.u - row.a) * (-log_T).exp()

    def observed_slope(self, x: Pair, row: Observation, channel: int) -> Pair:
        """Derivative of :meth:`observe`, ``(..., vehicle, d)``."""
        by_gain = (x[..., 1] - x[..., 0]).exp() * row.u
        return torch.stack([(-x[..., 0]).exp() * row.a - by_gain, by_gain], -1)


class LatentState:
    """``(v, a, c, e, log T_L, log K_L)``: the model of :mod:`avtorch.inference.latent_model`, parameters on a walk.

    With the parameters known and at rest the filter's log likelihood is that of the latent form, exactly.

    Args:
        measured: the channels, some of ``"accel"``, ``"speed"``.
        noise: the latent form's noise parameters by name; a filter takes them as given.
        drift: SD of the parameters' walk per square root of a second, of both logarithms.
        vehicles: how many. device: where their rows are.
    """

    def __init__(
        self,
        measured: tuple[str, ...],
        noise: Mapping[str, float],
        drift: float,
        vehicles: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.measured, self.drift = measured, drift
        self._noise = {name: torch.tensor(value, dtype=torch.float64, device=device) for name, value in noise.items()}
        variances = torch.stack([self._noise[f"{name}_noise"].square() for name in measured])
        self.variance = variances.expand(vehicles, -1)
        self._rows = [torch.tensor((*_ROWS[name], 0.0, 0.0), dtype=torch.float64, device=device) for name in measured]

    def start(self, actuation: GaussianState, row: Observation) -> GaussianState:
        vehicles = len(actuation.mean)
        mean, cov = actuation.mean.new_zeros(vehicles, 6), actuation.mean.new_zeros(vehicles, 6, 6)
        mean[:, 4:], cov[:, 4:, 4:] = actuation
        if "speed" in self.measured:
            mean[:, 0] = row.measured[:, self.measured.index("speed")]
        cov[:, :4, :4] = initial_covariance(self._noise["coloured_sd"], self._noise["coloured_time"])
        return GaussianState(mean, cov)

    def _step(self, x: Tensor, row: Observation) -> Step:
        n = self._noise
        road = n.get("road_noise", row.dt.new_zeros(()))
        parameters = (n["process_noise"], road, n["coloured_sd"], n["coloured_time"])
        return discretise(x[..., 4].exp(), x[..., 5].exp(), *parameters, row.dt)

    def advance(self, x: Whole, row: Observation) -> Whole:
        step = self._step(x, row)
        moved = (step.transition @ x[..., :4, None])[..., 0] + step.gain * row.u[:, None]
        return torch.cat([moved, x[..., 4:]], -1)

    def slope(self, x: Whole, row: Observation) -> Float[Tensor, "*point vehicle 6 6"]:
        step = self._step(x, row)
        a, K, u = x[..., 1], x[..., 5].exp(), row.u
        decay, reach = step.transition[..., 1, 1], step.transition[..., 0, 1]
        out = torch.diag_embed(torch.ones_like(x))
        out[..., :4, :4] = step.transition
        out[..., 0, 4] = (reach - decay * row.dt) * (a - K * u)
        out[..., 1, 4] = decay * row.dt * (-x[..., 4]).exp() * (a - K * u)
        out[..., :2, 5] = step.gain[..., :2] * u[:, None]
        return out

    def noise(self, x: Float[Tensor, "vehicle 6"], row: Observation) -> Float[Tensor, "vehicle 6 6"]:
        out = x.new_zeros(*x.shape, 6)
        out[..., :4, :4] = self._step(x, row).noise
        out[..., 4, 4] = out[..., 5, 5] = self.drift**2 * row.dt
        return out

    def observe(self, x: Whole, row: Observation, channel: int) -> Float[Tensor, "*point vehicle"]:
        return x @ self._rows[channel]

    def observed_slope(self, x: Whole, row: Observation, channel: int) -> Whole:
        return self._rows[channel].expand_as(x)


StateModel = JerkState | LatentState
"""A state-space model, batched over vehicles; ``x`` is ``(..., vehicle, d)``. Methods are described at `JerkState`."""


class JointKalman(WindowedEstimator):
    """A filter over the state and ``(log T_L, log K_L)``; subclasses pass a normal through the non-linear model.

    The parameters follow a random walk of ``drift`` over the rows used. A filter needs its noise levels. In the jerk
    form the level is the SD of the window's residual under least squares, which becomes the belief's ``sigma``; in the
    latent form it is ``noise``, which the belief repeats without spread. A window in which the filter diverges does not
    count as converged: the belief is carried over and the filter begins anew.

    `drift`: SD of the walk of both logarithms per square root of a second. `noise`: levels by name for the latent form,
    in the units of ``NOISE_PRIOR``, whose medians are the default.

    Raises `InputError` for a form without a state model, a ``drift`` below 0, or noise that the form does not have.
    """

    def __init__(
        self, form: Form, *, drift: float = 0.01, noise: Mapping[str, float] | None = None, **options: Any
    ) -> None:
        if not isinstance(form, JerkForm | LatentForm):
            raise InputError(f"form: {type(form).__name__} has no state model; give a JerkForm or a LatentForm")
        if not 0 <= drift < math.inf:
            raise InputError(f"drift: {drift} is not a finite number, 0 or more")
        levels = form.names[2:] if isinstance(form, LatentForm) else ()
        wrong = [name for name, value in (noise or {}).items() if name not in levels or not 0 < value < math.inf]
        if wrong:
            raise InputError(f"noise: found {wrong}, needs positive numbers for some of {list(levels)}")
        super().__init__(form, **options)
        self.drift = drift
        self.noise = {name: NOISE_PRIOR[name][0] for name in levels} | dict(noise or {})
        prior = self.first_prior.actuation
        if not isinstance(prior, LogNormalPrior):
            raise InputError(f"actuation_prior: found a {type(prior).__name__}, a filter needs a LogNormalPrior")
        self._first = GaussianState(prior.median.log()[None], torch.diag(prior.log_sd.square())[None])
        self._memory = {
            "mean": self._first.mean.expand(self.vehicles, 2).clone(),
            "cov": self._first.cov.expand(self.vehicles, 2, 2).clone(),
        }

    @abstractmethod
    def through(
        self, function: Callable[[Tensor], Tensor], slope: Callable[[Tensor], Tensor], state: GaussianState
    ) -> tuple[Float[Tensor, "vehicle e"], Float[Tensor, "vehicle e e"], Float[Tensor, "vehicle d e"]]:
        """Mean and covariance of a function of the state, and its covariance with the state; ``slope``: its derivative,
        ``(..., vehicle, e, d)``."""

    def predict(self, model: StateModel, state: GaussianState, row: Observation) -> GaussianState:
        """The state at the next row."""
        mean, cov, _ = self.through(lambda x: model.advance(x, row), lambda x: model.slope(x, row), state)
        return GaussianState(mean, cov + model.noise(state.mean, row))

    def correct(
        self, model: StateModel, state: GaussianState, row: Observation, channel: int
    ) -> tuple[GaussianState, Float[Tensor, " vehicle"]]:
        """The state after one channel's reading, and the log likelihood of the reading, ``(vehicle,)``."""
        expected, spread, pointing = self.through(
            lambda x: model.observe(x, row, channel).unsqueeze(-1),
            lambda x: model.observed_slope(x, row, channel).unsqueeze(-2),
            state,
        )
        spread = spread[:, 0, 0] + model.variance[:, channel]
        innovation = row.measured[:, channel] - expected[:, 0]
        gain = pointing / spread[:, None, None]
        cov = state.cov - gain @ pointing.mT
        likelihood = -0.5 * (spread.log() + innovation.square() / spread + math.log(2 * math.pi))
        return GaussianState(state.mean + gain[..., 0] * innovation[:, None], 0.5 * (cov + cov.mT)), likelihood

    def filter(
        self, model: StateModel, actuation: GaussianState, rows: Rows, columns: tuple[str, ...]
    ) -> tuple[GaussianState, Float[Tensor, " vehicle"]]:
        """Filter all usable rows of a window; after a gap or an unused row all but the parameters restarts.

        `actuation`: belief in ``(log T_L, log K_L)`` at the first row. `columns`: the measured signals, one a channel.

        Returns:
            The belief in them after the last row, and the log likelihood ``(vehicle,)``.
        """
        time, usable = rows["time"], rows["usable"]
        steps = time.diff()
        usual = steps.median() if len(steps) else steps.new_tensor(math.inf)
        cut = torch.cat([torch.ones_like(time[:1], dtype=torch.bool), steps > GAP * usual])
        # a masked row may hold any number or NaN
        signals = {name: value for name, value in rows.items() if name not in ("time", "usable")}
        clean = {name: torch.where(usable, value, 0.0) for name, value in signals.items()}
        measured = torch.stack([clean[name] for name in columns], -1)
        dts = torch.cat([steps, steps.new_zeros(1)])
        state, total = actuation, usable.new_zeros(len(usable), dtype=torch.float64)
        before = torch.zeros_like(usable[:, 0])
        for k in range(len(time)):
            row = Observation(
                clean["accel_cmd"][:, k], clean.get("accel", clean["accel_cmd"])[:, k], measured[:, k], dts[k]
            )
            on = usable[:, k]
            begins = on & (~before | bool(cut[k]))
            if k == 0 or bool(begins.any()):
                fresh = model.start(GaussianState(state.mean[:, -2:], state.cov[:, -2:, -2:]), row)
                state = fresh if k == 0 else _where(begins, fresh, state)
            everywhere = bool(on.all())
            for channel in range(len(columns)):
                corrected, term = self.correct(model, state, row, channel)
                state = corrected if everywhere else _where(on, corrected, state)
                total = total + (term if everywhere else torch.where(on, term, 0.0))
            if k + 1 < len(time):
                later = self.predict(model, state, row)
                state = later if everywhere else _where(on, later, state)
            before = on
        return GaussianState(state.mean[:, -2:], state.cov[:, -2:, -2:]), total

    def _learn(self, rows: Rows, index: Tensor) -> tuple[Summary, Tensor]:
        actuation = GaussianState(self._memory["mean"][index], self._memory["cov"][index])
        if isinstance(self.form, LatentForm):
            columns = self.form.measured
            model: StateModel = LatentState(columns, self.noise, self.drift, len(index), self.device)
            level = torch.tensor([self.noise[name] for name in self.form.names[2:]], dtype=torch.float64).log()
            noise_z = level.to(self.device).expand(len(index), -1)
            noise_var = torch.zeros_like(noise_z)
        else:
            columns = ("jerk",)
            columns_of_sums = (rows[name] for name in ("accel", "accel_cmd", "jerk", "usable"))
            statistics = JerkStatistics.from_samples(*columns_of_sums).with_least_noise()
            sigma = statistics.least_squares()[2].clamp_min(1e-12)
            model = JerkState(sigma, self.drift)
            noise_z, noise_var = sigma.log().unsqueeze(-1), (0.5 / statistics.n.clamp_min(1.0)).unsqueeze(-1)
        found, likelihood = self.filter(model, actuation, rows, columns)
        converged = _plausible(found) & likelihood.isfinite()
        mean, cov = _where(converged, found, self._first)
        self._remember(index, mean=mean, cov=cov)
        whole = torch.diag_embed(torch.cat([torch.zeros_like(mean), noise_var], -1))
        whole[:, :2, :2] = cov
        mean_z = torch.cat([mean, noise_z], -1)
        return Summary.log_normal(mean_z, whole, self.kept, self.generator), converged


def _plausible(actuation: GaussianState) -> Tensor:
    """Where mean and covariance are plausible for a vehicle, ``(vehicle,)`` bool."""
    low, high = (
        torch.tensor(x, dtype=torch.float64).log().to(actuation.mean.device) for x in zip(*PLAUSIBLE, strict=True)
    )
    inside = ((actuation.mean > low) & (actuation.mean < high)).all(-1)
    sound = torch.linalg.cholesky_ex(actuation.cov.nan_to_num())[1] == 0
    return inside & sound & actuation.cov.isfinite().flatten(1).all(-1)


def _where(on: Tensor, state: GaussianState, other: GaussianState) -> GaussianState:
    mean = torch.where(on[:, None], state.mean, other.mean)
    return GaussianState(mean, torch.where(on[:, None, None], state.cov, other.cov))


class JointEKF(JointKalman):
    """One tangent a row: cheap, and overconfident where the belief is wide against the model's curvature."""

    def through(
        self, function: Callable[[Tensor], Tensor], slope: Callable[[Tensor], Tensor], state: GaussianState
    ) -> tuple[Tensor, Tensor, Tensor]:
        tangent = slope(state.mean)
        across = state.cov @ tangent.mT
        return function(state.mean), tangent @ across, across


class JointUKF(JointKalman):
    """Second order in the mean and no derivatives, at ``2d`` runs of the model a row."""

    def through(
        self, function: Callable[[Tensor], Tensor], slope: Callable[[Tensor], Tensor], state: GaussianState
    ) -> tuple[Tensor, Tensor, Tensor]:
        points = sigma_points(state)
        values = function(points)
        mean, count = values.mean(0), len(points)
        off, away = (values - mean).movedim(0, -1), (points - state.mean).movedim(0, -1)
        return mean, off @ off.mT / count, away @ off.mT / count


def sigma_points(state: GaussianState) -> Float[Tensor, "point vehicle d"]:
    """``(2d, vehicle, d)``; not a number where the covariance has no Cholesky factor: the filter has diverged."""
    root, failed = torch.linalg.cholesky_ex(state.cov)
    root = torch.where((failed == 0)[:, None, None], root, torch.nan)
    reach = math.sqrt(state.mean.shape[-1]) * root.movedim(-1, 0)
    return torch.cat([state.mean + reach, state.mean - reach])
