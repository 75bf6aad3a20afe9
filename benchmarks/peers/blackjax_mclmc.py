"""BlackJAX's microcanonical Langevin samplers (Robnik and others 2023), as the package comes.

Settings:
    kind: ``"low-rank"``, `mclmc_lrd_warmup`: a pilot, a low-rank mass matrix, step and trajectory length, then one
        chain that is not adjusted. ``"laps"``: late-adjusted parallel sampling, one draw of each of many chains.
        Neither warm-up is one XLA program: lengths and step sizes leave it as Python numbers, so most of it compiles
        anew for every window.
    pilot, samples, warmup, draws: steps of the pilot, its draws, steps of the warm-up, draws.
    chains: chains side by side (``"laps"``); ``burn_in``, ``adjusted``: gradients without and with adjustment.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.laps import laps
from blackjax.mcmc import mclmc

from benchmarks.peers.contract import Answer, Settings
from benchmarks.peers.jax_density import OnSums, log_density, prior_center
from benchmarks.peers.problem import Windows


class Runner(OnSums):
    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._walk = jax.jit(partial(_walk, settings))

    def run(self, windows: Windows, seed: int) -> Answer:
        sampler = partial(_laps, self._settings)
        if self._settings["kind"] == "low-rank":
            sampler = partial(_low_rank, self._settings, self._walk)
        keys = jax.random.split(jax.random.key(seed), len(windows))
        draws = [np.asarray(sampler(key, sums)) for key, sums in zip(keys, windows.sums(), strict=True)]
        return Answer(np.exp(np.stack(draws, -2)))


def _low_rank(s: Settings, walk: Callable[..., jax.Array], key: jax.Array, sums: jax.Array) -> jax.Array:
    """Draws of ``z``, ``(1, draw, 3)``."""
    key_warm, key_walk = jax.random.split(key)
    found = blackjax.mclmc_lrd_warmup(
        partial(log_density, sums=jnp.asarray(sums)),
        prior_center(),
        key_warm,
        k=2,
        pilot_num_warmup=s["pilot"],
        pilot_num_samples=s["samples"],
        lrd_num_steps=s["warmup"],
    )
    return walk(key_walk, sums, found.inverse_mass_matrix, found.L, found.step_size)


def _walk(s: Settings, key: jax.Array, sums: jax.Array, mass, length: jax.Array, size: jax.Array) -> jax.Array:
    """Draws of ``z``, ``(1, draw, 3)``, after as many steps as the pilot's that are dropped."""
    target, kernel = partial(log_density, sums=sums), mclmc.build_kernel()

    def step(state, key):
        state, _ = kernel(key, state, target, mass, length, size)
        return state, state.position

    key_start, key_walk = jax.random.split(key)
    state = mclmc.init(prior_center(), target, key_start)
    _, draws = jax.lax.scan(step, state, jax.random.split(key_walk, s["pilot"] + s["draws"]))
    return draws[None, s["pilot"] :]


def _laps(s: Settings, key: jax.Array, sums: jax.Array) -> jax.Array:
    """Draws of ``z``, ``(chain, 1, 3)``."""
    result = laps(
        partial(log_density, sums=jnp.asarray(sums)),
        lambda key: prior_center() + jax.random.normal(key, (3,)) * 0.1,
        3,
        s["burn_in"],
        s["adjusted"],
        s["chains"],
        jax.sharding.Mesh(jax.devices()[:1], "chains"),
        key,
        diagnostics=False,
    )
    return result[-1].position[:, None]
