"""The compiled loops (:mod:`avtorch.inference.kernels`): where they apply, and how a density is handed to them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.inference.coordinates import Coordinates
from avtorch.inference.density import Density
from avtorch.inference.exponential_form import ExponentialForm, form_of
from avtorch.inference.sampler_settings import SamplerSettings

#: Steps of single chains below which a second thread costs more than it saves, some milliseconds of work.
ALONE = 500_000


@dataclass(frozen=True)
class Unavailable:
    """Why something is not compiled."""

    why: str


@cache
def load_kernels(module: Literal["kernels", "latent_kernels"]) -> ModuleType | Unavailable:
    """A module of compiled code, from numba's cache on disk; a machine's first call compiles it and fills the cache."""
    import numba

    if numba.config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        return Unavailable("numba does not compile here: NUMBA_DISABLE_JIT is set")
    try:
        return import_module(f"avtorch.inference.{module}")
    except RuntimeError as fault:  # numba found no folder to write to; without one every process would compile anew
        return Unavailable(
            f"compiled code cannot be kept: {fault}; set NUMBA_CACHE_DIR to a folder that can be written"
        )


@dataclass(frozen=True)
class Compiled:
    """A density whose walk the kernels can do.

    The law of the walk is that of :class:`~avtorch.inference.sgld.SGLD` with a constant step.

    A seed drawn from the generator keys the noise; it gives the same draws on one platform whatever the number of
    threads, and other draws than the eager walk.
    """

    kernels: ModuleType
    form: ExponentialForm

    def draws(
        self,
        coordinates: Coordinates,
        start: Float[Tensor, "chain window 3"],
        settings: SamplerSettings,
        limit: float,
        generator: torch.Generator | None,
    ) -> Float[Tensor, "draw chain window 3"]:
        """Draws of ``w`` by the settings' numbers of steps, step and noise.

        ``limit`` is the largest slope that a step of the burn-in follows.
        """
        chains, windows, d = start.shape
        begin = start.permute(2, 1, 0).contiguous().numpy()
        kept, potential = np.empty((d, windows, settings.draws, chains)), whitened(self.form, coordinates)
        key = words(generator)

        def go(first: int, last: int) -> None:
            steps = (settings.step, settings.noise == "averaged", settings.burn_in, settings.thinning)
            self.kernels.walk(first, last, begin, kept, *potential, *steps, limit, *key)

        pieces = windows * -(-chains // self.kernels.LANES)
        work = chains * windows * (settings.burn_in + settings.draws * settings.thinning)
        share(go, pieces, threads=1 if work < ALONE else torch.get_num_threads())
        return torch.from_numpy(kept).permute(2, 3, 1, 0)


def words(generator: torch.Generator | None) -> tuple[np.uint64, np.uint64]:
    """Two words of 32 bits from one draw of the generator: the key of the noise."""
    low, high = torch.randint(2**32, (2,), generator=generator).tolist()
    return np.uint64(low), np.uint64(high)


def share(go: Callable[[int, int], None], pieces: int, threads: int) -> None:
    """``go(first, last)`` over all pieces, by so many threads."""
    if threads < 2 or pieces < 2:
        go(0, pieces)
        return
    edges = np.linspace(0, pieces, min(threads, pieces) + 1).astype(int).tolist()
    with ThreadPoolExecutor(len(edges) - 1) as pool:
        list(pool.map(go, edges[:-1], edges[1:]))


def whitened(form: ExponentialForm, coordinates: Coordinates) -> tuple[np.ndarray, ...]:
    """The potential in ``w``, ``z = mode + lower w``, as the kernels take it: one row a window."""
    mode, lower = coordinates.mode.numpy(), coordinates.lower.numpy()
    t, exponents = form.terms, form.exponents.numpy()
    quadratic, raised = t.quadratic.numpy(), lower.transpose(0, 2, 1)
    slope = t.linear.numpy() + (quadratic @ mode[..., None])[..., 0]
    linear = (raised @ slope[..., None])[..., 0]
    own_linear, own_square = t.own_linear.numpy(), t.own_square.numpy()
    used = np.flatnonzero((own_linear != 0).any(0) | (own_square != 0).any(0))
    own = [lower[:, used], mode[:, used, None], own_linear[:, used, None], own_square[:, used, None]]
    parts = (
        exponents @ lower,
        mode @ exponents.T + form.offsets.numpy(),
        form.coupling.numpy(),
        linear,
        raised @ quadratic @ lower,
        np.concatenate(own, -1),
    )
    return tuple(np.ascontiguousarray(part) for part in parts)


def chosen(density: Density, settings: SamplerSettings) -> Compiled | None:
    """The compiled loops for a walk by these settings; ``None`` for the eager walk.

    Raises `InputError` where the settings ask for compiled loops that cannot be had.
    """
    if settings.walk == "eager":
        return None
    other = [name for name in ("batch", "schedule", "optimizer") if getattr(settings, name) is not None]
    found = Unavailable(f"it has no {other[0]}; leave {other[0]} at None") if other else compiled(density)
    if isinstance(found, Compiled):
        return found
    if settings.walk == "compiled":
        raise InputError(f"walk: 'compiled' cannot be had: {found.why}")
    return None


def compiled(density: Density) -> Compiled | Unavailable:
    """The compiled walk of a density, or why there is none."""
    kernels = load_kernels("kernels")
    if isinstance(kernels, Unavailable):
        return kernels
    form, name = form_of(density), type(density).__name__
    if form is None:
        return Unavailable(f"{name}, with its prior, has no closed form that the kernels know")
    if form.coupling.device.type != "cpu":
        return Unavailable(f"{name} is on {form.coupling.device.type}; the kernels are for the processor")
    return Compiled(kernels, form)
