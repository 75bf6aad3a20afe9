"""The density in JAX, for the peers that run there: from the six sums, with its mode and whitening, all of it traced.

``sums`` is an argument of everything compiled, so a new window of any length compiles nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from avtorch.arrays import FloatArray
from benchmarks.peers.contract import Answer
from benchmarks.peers.problem import LOG_SD, MEDIAN, SIGMA_SCALE, Windows

_LOG_2PI = math.log(2 * math.pi)


def log_density(z: Array, sums: Array) -> Array:
    """Eq. 4 plus prior plus Jacobian at ``z = log(T_L, K_L, sigma)``, ``(3,)``; ``sums``: ``(7,)``."""
    n, jj, aj, uj, aa, au, uu = sums
    b, g = jnp.exp(-z[0]), jnp.exp(z[1] - z[0])
    chi2 = (jj + 2 * b * aj - 2 * g * uj + b * b * aa - 2 * b * g * au + g * g * uu) * jnp.exp(-2 * z[2])
    likelihood = -0.5 * chi2 - n * (z[2] + 0.5 * _LOG_2PI)
    score = (z[:2] - jnp.log(jnp.asarray(MEDIAN))) / jnp.asarray(LOG_SD)
    actuation = -0.5 * (score**2).sum() - jnp.log(jnp.asarray(LOG_SD)).sum() - _LOG_2PI
    noise = -0.5 * jnp.exp(2 * z[2]) / SIGMA_SCALE**2 + z[2] + 0.5 * math.log(2 / math.pi) - math.log(SIGMA_SCALE)
    return likelihood + actuation + noise


def initial(sums: Array) -> Array:
    """Least squares where plausible, else the prior's centre: the start of the search for the mode."""
    n, jj, aj, uj, aa, au, uu = sums
    determinant = aa * uu - au**2
    solvable = determinant > 1e-12 * aa * uu
    safe = jnp.where(solvable, determinant, 1.0)
    b = jnp.where(solvable, (-aj * uu + au * uj) / safe, jnp.nan)
    g = jnp.where(solvable, (aa * uj - au * aj) / safe, jnp.nan)
    lag, gain = 1 / b, g / b
    lag = jnp.where((lag > 0.01) & (lag < 20), lag, MEDIAN[0])
    gain = jnp.where((gain > 0.02) & (gain < 20), gain, MEDIAN[1])
    fitted = jnp.where(solvable, -b * aj + g * uj, 0.0)
    sigma = jnp.sqrt(jnp.maximum(jj - fitted, 0.0) / jnp.maximum(n - 2, 1.0))
    return jnp.log(jnp.stack([lag, gain, jnp.clip(sigma, 1e-6, 1e6)]))


def mode(sums: Array) -> tuple[Array, Array]:
    """Damped Newton to the mode; returns it and a square root of the Laplace covariance, ``(3,)`` and ``(3, 3)``."""

    def expand(z: Array) -> tuple[Array, Array, Array]:
        return -log_density(z, sums), -jax.grad(log_density)(z, sums), -jax.hessian(log_density)(z, sums)

    def direction(gradient: Array, hessian: Array) -> tuple[Array, Array]:
        values, basis = jnp.linalg.eigh(hessian)
        values = jnp.maximum(jnp.abs(values), 1e-6)
        projected = basis.T @ gradient
        step = -basis @ (projected / values)
        return step / jnp.maximum(jnp.abs(step).max(), 1.0), 0.5 * (projected**2 / values).sum()

    def go_on(state: tuple) -> Array:
        k, _, _, _, gradient, hessian = state
        return (k < 60) & (direction(gradient, hessian)[1] > 1e-8)

    def iterate(state: tuple) -> tuple:
        k, z, damping, potential, gradient, hessian = state
        trial = z + damping * direction(gradient, hessian)[0]
        new = expand(trial)
        better = new[0] <= potential
        kept = [jnp.where(better, x, y) for x, y in zip((trial, *new), (z, potential, gradient, hessian), strict=True)]
        return k + 1, kept[0], jnp.where(better, jnp.minimum(2 * damping, 1.0), 0.25 * damping), *kept[1:]

    z = initial(sums)
    _, z, _, _, _, hessian = jax.lax.while_loop(go_on, iterate, (0, z, 1.0, *expand(z)))
    values, basis = jnp.linalg.eigh(hessian)
    return z, basis / jnp.sqrt(jnp.maximum(jnp.abs(values), 1e-6))


_log_densities = jax.jit(jax.vmap(log_density, in_axes=(0, None)))


class OnSums:
    """A runner whose density is the one above."""

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        """For the check against avtorch's own density."""
        return np.asarray(_log_densities(z, windows.sums()[0]))


class Compiled(OnSums):
    """A sampler of one window from a key and its sums to draws of ``z``, ``(chain, draw, 3)``, compiled for one window
    and for many at once; ``random``: JAX's generator."""

    def __init__(self, sampler: Callable[[Array, Array], Array], random: str | None = None) -> None:
        self._random = random
        self._one, self._many = jax.jit(sampler), jax.jit(jax.vmap(sampler))

    def run(self, windows: Windows, seed: int) -> Answer:
        sums, key = windows.sums(), jax.random.key(seed, impl=self._random)
        if len(windows) == 1:
            draws = np.asarray(self._one(key, sums[0]))[None]  # (window, chain, draw, 3)
        else:
            draws = np.asarray(self._many(jax.random.split(key, len(windows)), sums))
        return Answer(np.exp(draws.transpose(1, 2, 0, 3)))


def prior_center() -> Array:
    """A typical ``z`` of the prior, ``(3,)``."""
    return jnp.log(jnp.asarray([*MEDIAN, 0.5 * SIGMA_SCALE]))


def stiffness(center: Array, scale: Array, sums: Array, radius: float = 3.0) -> Array:
    """How much steeper the whitened potential gets ``radius`` SDs out; avtorch divides its step by the same."""
    axes = radius * jnp.eye(3)
    probes = jnp.concatenate([axes, -axes])
    slopes = -jax.vmap(jax.grad(lambda w: log_density(center + scale @ w, sums)))(probes)
    steepest = jnp.nan_to_num((slopes * probes).sum(-1) / radius**2, posinf=1e6).max()
    return jnp.clip(steepest, 1.0, 1e6)
