"""Cars of one model, partially pooled: what a car's drives say of it, and what the other cars say.

A drive's estimate of a logarithm, such as that of T_L, varies about its car's by the estimate's own standard deviation
and from drive to drive; cars vary about their model's mean:

    y_drive ~ Normal(car, sd_drive² + within²),    car ~ Normal(mean, between²).

`PopulationMargin` is the density of mean and spreads with the cars integrated out: two or three parameters, however
many cars there are (Gelman et al., Bayesian Data Analysis, chapter 5).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.errors import InputError

MEAN_SD = 2.0
"""Prior standard deviation of the mean of a logarithm, about 0: a lag within a factor of 50 about a second."""

SPREAD = 0.2
"""Prior mean of the spreads, whose prior is Gamma(2, 2 / mean): lags of a model's cars differ by a fifth or so, and not
by nothing. It vanishes at 0, where a half-normal leaves a tail in the logarithm that no sampler crosses well."""

_LOG_2PI = math.log(2 * math.pi)


class PopulationMargin:
    """A model's mean and spreads from the drives of its cars, one posterior per quantity.

    Parameters: `mean` of the logarithm over cars, `between`, the SD of cars about it, and `within`, the SD of a car's
    drives about the car (only where some car has two drives or more). Priors: Normal(0, 2²) of the mean and
    Gamma(2, 2 / `spread`) of the spreads. `cars_given` has the cars themselves.

    Args:
        values: `(quantity, drive)`, a drive's estimate of the logarithm.
        sd: `(quantity, drive)`, its standard deviation.
        car: `(drive,)`, the number of the drive's car, from 0.
        spread: prior mean of the spreads.

    Raises `InputError` for other shapes, numbers that are not finite, an sd or spread of 0, fewer than two cars, or
    numbers of cars with a gap.
    """

    def __init__(
        self,
        values: Float[Tensor, "quantity drive"],
        sd: Float[Tensor, "quantity drive"],
        car: Int[Tensor, " drive"],
        *,
        spread: float = SPREAD,
    ) -> None:
        if values.ndim != 2 or sd.shape != values.shape or car.shape != values.shape[1:]:
            found = f"{tuple(values.shape)}, {tuple(sd.shape)} and {tuple(car.shape)}"
            raise InputError(f"values, sd, car: found shapes {found}, need (quantity, drive) twice and (drive,)")
        if not (bool(values.isfinite().all()) and bool(sd.isfinite().all()) and bool((sd > 0).all())):
            raise InputError("values, sd: found a number that is not finite or an sd of 0 or less, need sd above 0")
        known, drives = car.unique(return_counts=True)
        if len(known) < 2 or not torch.equal(known, torch.arange(len(known), device=known.device)):
            raise InputError("car: needs two cars or more, numbered 0, 1, 2 ... without a gap")
        if not (math.isfinite(spread) and spread > 0):
            raise InputError(f"spread: found {spread:g}, needs a number above 0")
        self.values, self.sd, self.car, self.spread = values.double(), sd.double(), car, spread
        self.cars = len(known)
        #: whether drives of one car tell its spread from drive to drive; otherwise that is part of `between`
        self.repeated = bool((drives > 1).any())

    @property
    def windows(self) -> int:
        """Number of quantities, each with a posterior of its own."""
        return len(self.values)

    @property
    def hyper(self) -> tuple[str, ...]:
        """Names of the parameters, beside the cars that were integrated out: mean, between, and within where drives
        repeat."""
        return ("mean", "between", "within") if self.repeated else ("mean", "between")

    @property
    def names(self) -> tuple[str, ...]:
        """As `hyper`."""
        return self.hyper

    def of_cars(
        self, within: Float[Tensor, "*draw quantity"]
    ) -> tuple[Float[Tensor, "*draw quantity car"], Float[Tensor, "*draw quantity car"], Tensor]:
        """What the drives of each car say together: mean, precision, and the log density that is left beside them."""
        variance = self.sd**2 + within.square()[..., None]
        weight = 1 / variance
        precision = self._summed(weight)
        mean = self._summed(self.values * weight) / precision
        off = self.values - mean[..., self.car]
        left = self._summed(-0.5 * (_LOG_2PI + variance.log() + off.square() * weight))
        return mean, precision, left + 0.5 * (_LOG_2PI - precision.log())

    def cars_given(
        self, z: Float[Tensor, "*draw quantity parameter"]
    ) -> tuple[Float[Tensor, "*draw quantity car"], Float[Tensor, "*draw quantity car"]]:
        """Mean and variance of each car given the hyperparameters `z`: normal, in closed form."""
        between, within = self._spreads(z)
        mean, precision, _ = self.of_cars(within)
        share = between.square()[..., None] * precision
        share = share / (1 + share)
        return share * mean + (1 - share) * z[..., :1], share / precision

    def constrain(self, z: Float[Tensor, "*draw parameter"]) -> Float[Tensor, "*draw parameter"]:
        """Spreads in place of their logarithms; the mean is one of the quantity's logarithm already. Shape of `z`."""
        return torch.cat([z[..., :1], z[..., 1:].exp()], -1)

    def log_prob(self, z: Float[Tensor, "*draw quantity parameter"]) -> Float[Tensor, "*draw quantity"]:
        """Log density of `z` `(..., quantity, parameter)`; returns `(..., quantity)`."""
        between, within = self._spreads(z)
        mean, precision, left = self.of_cars(within)
        pooled = _log_normal(mean - z[..., :1], between.square()[..., None] + 1 / precision)
        return self._log_prior(z) + (pooled + left).sum(-1)

    def initial(self) -> Float[Tensor, "quantity parameter"]:
        """`(quantity, parameter)`."""
        spread = self.values.std(1).clamp_min(0.02).log()
        return torch.stack([self.values.mean(1), spread, spread - 0.7][: len(self.hyper)], -1)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " quantity"]) -> PopulationMargin:
        """The quantities named by `index`."""
        return PopulationMargin(self.values[index], self.sd[index], self.car, spread=self.spread)

    def _summed(self, x: Float[Tensor, "*draw quantity drive"]) -> Float[Tensor, "*draw quantity car"]:
        return x.new_zeros(*x.shape[:-1], self.cars).index_add(-1, self.car, x)

    def _spreads(self, z: Tensor) -> tuple[Tensor, Tensor]:
        between = z[..., 1].exp()
        return between, z[..., 2].exp() if self.repeated else torch.zeros_like(between)

    def _log_prior(self, z: Tensor) -> Tensor:
        found = _log_normal(z[..., 0], MEAN_SD**2)
        for i in range(1, len(self.hyper)):
            # Gamma(2, rate), and the Jacobian of the logarithm
            rate = 2 / self.spread
            found = found + 2 * math.log(rate) + 2 * z[..., i] - rate * z[..., i].exp()
        return found


def _log_normal(off: Tensor, variance: Tensor | float) -> Tensor:
    """Log density of a normal, `off` from its mean."""
    variance = torch.as_tensor(variance, dtype=off.dtype, device=off.device)
    return -0.5 * (_LOG_2PI + variance.log() + off.square() / variance)
