"""NumPyro NUTS on a NumPyro model, compiled whole: adaptation and draws are one XLA program with the sums as argument.

``numpyro.infer.MCMC`` compiles its start again for every window, some seconds each; here ``lax.scan`` runs its kernel.

Settings:
    chains, warmup, draws: a chain; chains run side by side, and each adapts for itself.
    mode: whether chains start around the mode, found by Newton's method in the program; else at the prior's centre.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import NUTS
from numpyro.infer.util import potential_energy

from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.jax_density import mode, prior_center
from benchmarks.peers.problem import LOG_SD, MEDIAN, NAMES, SIGMA_SCALE, FloatArray, Windows


def model(sums: jax.Array) -> None:
    """Priors as statements, Eq. 4 from the sums as a factor."""
    lag = numpyro.sample("T_L", dist.LogNormal(np.log(MEDIAN[0]), LOG_SD[0]))
    gain = numpyro.sample("K_L", dist.LogNormal(np.log(MEDIAN[1]), LOG_SD[1]))
    sigma = numpyro.sample("sigma", dist.HalfNormal(SIGMA_SCALE))
    n, jj, aj, uj, aa, au, uu = sums
    b, g = 1 / lag, gain / lag
    chi2 = (jj + 2 * b * aj - 2 * g * uj + b * b * aa - 2 * b * g * au + g * g * uu) / sigma**2
    numpyro.factor("jerk", -0.5 * chi2 - n * (jnp.log(sigma) + 0.5 * np.log(2 * np.pi)))


def potential(z: jax.Array, sums: jax.Array) -> jax.Array:
    """What NumPyro makes of the model, at its own unconstrained parameters, the logarithms ``(3,)``."""
    return potential_energy(model, (sums,), {}, dict(zip(NAMES, z, strict=True)))


class Runner:
    def __init__(self, settings: Settings) -> None:
        self._one = jax.jit(partial(_sample, settings))
        self._density = jax.jit(jax.vmap(lambda z, sums: -potential(z, sums), in_axes=(0, None)))

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray:
        return np.asarray(self._density(z, windows.sums()[0]))

    def run(self, windows: Windows, seed: int) -> Answer:
        draws = np.asarray(self._one(jax.random.key(seed), windows.sums()[0]))
        return Answer(np.exp(draws)[:, :, None])


def _sample(s: Settings, key: jax.Array, sums: jax.Array) -> jax.Array:
    """Draws of ``z``, ``(chain, draw, 3)``."""
    center, scale = mode(sums) if s["mode"] else (prior_center(), 0.1 * jnp.eye(3))

    def chain(key: jax.Array) -> jax.Array:
        key_start, key_walk = jax.random.split(key)
        kernel = NUTS(potential_fn=lambda z: potential(z, sums), dense_mass=True)
        start = center + scale @ jax.random.normal(key_start, (3,))
        state = kernel.init(key_walk, s["warmup"], start, (), {})

        def step(state, _):
            state = kernel.sample(state, (), {})
            return state, state.z

        return jax.lax.scan(step, state, None, length=s["warmup"] + s["draws"])[1][s["warmup"] :]

    return jax.vmap(chain)(jax.random.split(key, s["chains"]))
