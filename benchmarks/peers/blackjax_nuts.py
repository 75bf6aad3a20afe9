"""BlackJAX NUTS, compiled whole: search for the mode (if any), window adaptation and draws are one XLA program.

Settings:
    space: ``"z"``, the log parameters with a dense mass matrix; ``"whitened"``, coordinates whitened by the Laplace
        approximation as avtorch does, with a unit mass matrix and a step ``step`` that is not adapted.
    mode: whether chains start from the Laplace approximation at the mode, whose covariance is the first mass matrix;
        else they start at the prior's centre with the identity, as in Stan.
    adapt: ``"chain"``, each chain adapts for itself, as in Stan; ``"shared"``, one chain adapts for all.
    low_rank: the package's low-rank mass matrix in place of a dense one, also from Stan's start.
    warmup, chains, draws: steps of adaptation, chains side by side, draws a chain.
    burn_in: steps dropped before the draws where chains did not adapt themselves.
"""

from __future__ import annotations

from functools import partial

import blackjax
import jax
import jax.numpy as jnp

from benchmarks.peers.contract import Settings
from benchmarks.peers.jax_density import Compiled, log_density, mode, prior_center


class Runner(Compiled):
    def __init__(self, settings: Settings) -> None:
        s = {"space": "z", "mode": False, "adapt": "chain", "burn_in": 0, "low_rank": False, **settings}
        super().__init__(partial(_whitened if s["space"] == "whitened" else _adapted, s))


def _adapted(s: Settings, key: jax.Array, sums: jax.Array) -> jax.Array:
    """Draws of ``z``, ``(chain, draw, 3)``, with window adaptation."""
    target = partial(log_density, sums=sums)
    center, scale = mode(sums) if s["mode"] else (prior_center(), 0.1 * jnp.eye(3))
    if s["low_rank"]:
        adaptation = blackjax.window_adaptation_low_rank(blackjax.nuts, target, max_rank=2)
    else:
        adaptation = blackjax.window_adaptation(
            blackjax.nuts,
            target,
            is_mass_matrix_diagonal=False,
            initial_inverse_mass_matrix=scale @ scale.T if s["mode"] else None,
            adaptation_info_fn=lambda *_: None,
        )
    key_start, key_adapt, key_walk = jax.random.split(key, 3)
    starts = center + jax.random.normal(key_start, (s["chains"], 3)) @ scale.T

    def adapted(key: jax.Array, start: jax.Array):
        (state, parameters), _ = adaptation.run(key, start, num_steps=s["warmup"])
        return state, parameters["step_size"], parameters["inverse_mass_matrix"]

    def walk(key: jax.Array, state, step_size: jax.Array, inverse_mass: jax.Array) -> jax.Array:
        kernel = blackjax.nuts(target, step_size=step_size, inverse_mass_matrix=inverse_mass)
        return _scan(kernel, key, state, s)

    keys = jax.random.split(key_walk, s["chains"])
    if s["adapt"] == "chain":
        state, step, mass = jax.vmap(adapted)(jax.random.split(key_adapt, s["chains"]), starts)
        return jax.vmap(walk)(keys, state, step, mass)
    state, step, mass = adapted(key_adapt, starts[0])
    if s["mode"]:
        states = jax.vmap(lambda z: blackjax.nuts(target, step, mass).init(z))(starts)
        return jax.vmap(walk, in_axes=(0, 0, None, None))(keys, states, step, mass)
    return jax.vmap(walk, in_axes=(0, None, None, None))(keys, state, step, mass)


def _whitened(s: Settings, key: jax.Array, sums: jax.Array) -> jax.Array:
    """Draws of ``z``, ``(chain, draw, 3)``, in coordinates whitened at the mode, without adaptation."""
    center, scale = mode(sums)
    kernel = blackjax.nuts(lambda w: log_density(center + scale @ w, sums), s["step"], jnp.eye(3))
    key_start, key_walk = jax.random.split(key)
    states = jax.vmap(kernel.init)(jax.random.normal(key_start, (s["chains"], 3)))
    w = jax.vmap(lambda k, state: _scan(kernel, k, state, s))(jax.random.split(key_walk, s["chains"]), states)
    return center + w @ scale.T


def _scan(kernel, key: jax.Array, state, s: Settings) -> jax.Array:
    def step(state, key):
        state, _ = kernel.step(key, state)
        return state, state.position

    return jax.lax.scan(step, state, jax.random.split(key, s["burn_in"] + s["draws"]))[1][s["burn_in"] :]
