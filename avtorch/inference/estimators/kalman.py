"""Joint Kalman filters: state and parameters in one normal belief, row by row, all vehicles at once."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.inference.belief import Summary
from avtorch.inference.estimators.jerk_state import JerkState
from avtorch.inference.estimators.latent_state import LatentState
from avtorch.inference.estimators.state_model import GaussianState, Observation, StateModel
from avtorch.inference.estimators.windowed import WindowedEstimator
from avtorch.inference.form import Form, JerkForm, Rows
from avtorch.inference.jerk import JerkStatistics
from avtorch.inference.latent import NOISE_PRIOR
from avtorch.inference.latent_form import LatentForm
from avtorch.inference.latent_window import GAP

PLAUSIBLE = ((0.01, 20.0), (0.02, 20.0))
"""Bounds of ``T_L`` [s] and ``K_L``; a filter that leaves them has diverged, and restarts from the prior."""


class JointKalman(WindowedEstimator):
    """A filter over the state and ``(log T_L, log K_L)``; subclasses pass a normal through the non-linear model.

    The parameters follow a random walk of ``drift`` over the rows used. A filter needs its noise levels. In the jerk
    form the level is the SD of the window's residual under least squares, which becomes the belief's ``sigma``; in the
    latent form it is ``noise``, which the belief repeats without spread. A window in which the filter diverges does not
    count as converged: the belief is carried over and the filter begins anew.

    Args:
        drift: SD of the walk of both logarithms per square root of a second.
        noise: levels by name for the latent form, in the units of ``NOISE_PRIOR``, whose medians are the default.

    Raises:
        InputError: for a form without a state model, a ``drift`` below 0, or noise that the form does not have.
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
        prior = self.actuation_prior
        self._memory = {
            "mean": prior.median.log().expand(self.vehicles, 2).clone(),
            "cov": torch.diag(prior.log_sd.square()).expand(self.vehicles, 2, 2).clone(),
        }

    @abstractmethod
    def predict(self, model: StateModel, state: GaussianState, row: Observation) -> GaussianState:
        """The state at the next row."""

    @abstractmethod
    def correct(
        self, model: StateModel, state: GaussianState, row: Observation, channel: int
    ) -> tuple[GaussianState, Float[Tensor, " vehicle"]]:
        """The state after one channel's reading, and the log likelihood of the reading, ``(vehicle,)``."""

    def filter(
        self, model: StateModel, actuation: GaussianState, rows: Rows, columns: tuple[str, ...]
    ) -> tuple[GaussianState, Float[Tensor, " vehicle"]]:
        """Filter all usable rows of a window; after a gap or an unused row all but the parameters restarts.

        Args:
            actuation: belief in ``(log T_L, log K_L)`` at the first row.
            columns: the measured signals, one a channel.

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
        prior_mean, prior_cov = self.actuation_prior.median.log(), torch.diag(self.actuation_prior.log_sd.square())
        mean = torch.where(converged[:, None], found.mean, prior_mean)
        cov = torch.where(converged[:, None, None], found.cov, prior_cov)
        self._memory = {
            "mean": self._memory["mean"].index_put((index,), mean),
            "cov": self._memory["cov"].index_put((index,), cov),
        }
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
