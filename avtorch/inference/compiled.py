"""The compiled loops (:mod:`avtorch.inference.kernels`): where they apply, and how a density is handed to them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.inference.coordinates import Coordinates
from avtorch.inference.density import Density, ExponentialForm, exponential_form
from avtorch.inference.sampler_settings import SamplerSettings

#: Steps of single chains below which a second thread costs more than it saves, some milliseconds of work.
ALONE = 500_000


@cache
def load_kernels(module: Literal["kernels", "latent_kernels"]) -> ModuleType | None:
    """A module of compiled code, from numba's cache on disk; a machine's first call compiles it and fills the cache.

    None where numba does not compile (NUMBA_DISABLE_JIT), or finds no folder to keep code in (NUMBA_CACHE_DIR): every
    process would compile for seconds.
    """
    import numba

    if numba.config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        return None
    try:
        return import_module(f"avtorch.inference.{module}")
    except RuntimeError:
        return None


def compiled_form(density: Density, settings: SamplerSettings) -> ExponentialForm | None:
    """The density as the compiled walk takes it; None where density or settings are for the eager one."""
    others = (settings.batch, settings.schedule, settings.optimizer)
    if settings.walk == "eager" or any(other is not None for other in others):
        return None
    form = exponential_form(density)
    here = form is not None and form.coupling.device.type == "cpu"
    return form if here and load_kernels("kernels") is not None else None


def compiled_walk(
    form: ExponentialForm,
    coordinates: Coordinates,
    start: Float[Tensor, "3 window chain"],
    settings: SamplerSettings,
    limit: float,
    generator: torch.Generator | None,
) -> Float[Tensor, "3 window draw chain"]:
    """Draws of ``w`` by the settings' numbers of steps, step and noise: the law of SGLD with a constant step.

    ``limit`` is the largest slope that a step of the burn-in follows. A seed drawn from the generator keys the noise;
    it gives the same draws on one platform whatever the number of threads, and other draws than the eager walk.
    """
    kernels = load_kernels("kernels")
    assert kernels is not None
    _, windows, chains = start.shape
    kept = torch.empty(3, windows, settings.draws, chains, dtype=torch.float64)
    begin, into, potential, key = start.numpy(), kept.numpy(), whitened(form, coordinates), words(generator)

    def go(first: int, last: int) -> None:
        steps = (settings.step, settings.noise == "averaged", settings.burn_in, settings.thinning)
        kernels.walk(first, last, begin, into, *potential, *steps, limit, *key)

    pieces = windows * -(-chains // kernels.LANES)
    work = chains * windows * (settings.burn_in + settings.draws * settings.thinning)
    threads = 1 if work < ALONE else min(torch.get_num_threads(), pieces)
    if threads == 1:
        go(0, pieces)
    else:
        edges = np.linspace(0, pieces, threads + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(go, edges[:-1], edges[1:]))
    return kept


def words(generator: torch.Generator | None) -> tuple[np.uint64, np.uint64]:
    """Two words of 32 bits from one draw of the generator: the key of the noise."""
    low, high = torch.randint(2**32, (2,), generator=generator).tolist()
    return np.uint64(low), np.uint64(high)


def whitened(form: ExponentialForm, coordinates: Coordinates) -> tuple[np.ndarray, ...]:
    """The potential in ``w``, ``z = mode + lower w``, as the kernels take it: one row a window."""
    mode, lower = coordinates.mode.numpy(), coordinates.lower.numpy()
    t, exponents = form.terms, form.exponents.numpy()
    quadratic, raised = t.quadratic.numpy(), lower.transpose(0, 2, 1)
    slope = t.linear.numpy() + (quadratic @ (mode - t.center.numpy())[..., None])[..., 0]
    linear = (raised @ slope[..., None])[..., 0]
    own_linear, own_square = t.own_linear.numpy(), t.own_square.numpy()
    used = np.flatnonzero((own_linear != 0).any(0) | (own_square != 0).any(0))
    own = [lower[:, used], mode[:, used, None], own_linear[:, used, None], own_square[:, used, None]]
    parts = (
        exponents @ lower,
        mode @ exponents.T,
        form.coupling.numpy(),
        linear,
        raised @ quadratic @ lower,
        np.concatenate(own, -1),
    )
    return tuple(np.ascontiguousarray(part) for part in parts)
