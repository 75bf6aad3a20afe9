"""BlackJAX SGLD, many chains, compiled whole; the gradient is that of the whole window, from the sums.

Settings:
    whitened: in coordinates whitened by the Laplace approximation at the mode, with avtorch's rule for skewed windows;
        else in ``z`` with the one step that the steepest direction allows, as BlackJAX has no preconditioner.
    step: ``h`` of ``w + h/2 grad + sqrt(h) noise`` on a unit Gaussian.
    random: JAX's generator; ``"unsafe_rbg"`` is faster than the default ``"threefry2x32"``.
    chains, burn_in, thinning, draws: as in Algorithm 1; chains start at the mode.
"""

from __future__ import annotations

from functools import partial

import blackjax
import jax
import jax.numpy as jnp

from benchmarks.peers.contract import Settings
from benchmarks.peers.jax_density import Compiled, log_density, mode, stiffness


class Runner(Compiled):
    def __init__(self, settings: Settings) -> None:
        super().__init__(partial(_sample, settings), settings["random"])


def _sample(s: Settings, key: jax.Array, sums: jax.Array) -> jax.Array:
    """Draws of ``z``, ``(chain, draw, 3)``."""
    center, scale = mode(sums)
    if s["whitened"]:
        scale = scale / jnp.sqrt(stiffness(center, scale, sums))
    else:
        scale = jnp.linalg.norm(jnp.linalg.inv(scale), 2) ** -1 * jnp.eye(3)
    gradient = jax.vmap(jax.grad(lambda w: log_density(center + scale @ w, sums)))
    sgld = blackjax.sgld(lambda w, _: gradient(w))  # all chains are one position: one key a step

    def move(w: jax.Array, key: jax.Array):
        # its step size is that of w + e grad + sqrt(2 e) noise
        return sgld.step(key, w, 0.0, 0.5 * s["step"]), None

    def collect(w: jax.Array, key: jax.Array):
        w, _ = jax.lax.scan(move, w, jax.random.split(key, s["thinning"]))
        return w, w

    key_burn, key_walk = jax.random.split(key)
    w, _ = jax.lax.scan(move, jnp.zeros((s["chains"], 3)), jax.random.split(key_burn, s["burn_in"]))
    _, w = jax.lax.scan(collect, w, jax.random.split(key_walk, s["draws"]))
    return center + w.transpose(1, 0, 2) @ scale.T
