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
from avtorch.inference.exponential_form import ExponentialForm, has_form, outdated
from avtorch.inference.importance import tail_of
from avtorch.inference.planes import empty_planes, to_planes
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
    """A density whose walk, and whose comparison with draws, the kernels can do.

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
        kept = empty_planes(settings.draws, chains, windows, d)
        begin = np.ascontiguousarray(to_planes(start.detach()).numpy())
        into, potential = to_planes(kept).numpy(), whitened(self.form, coordinates)
        key = words(generator)

        def go(first: int, last: int) -> None:
            steps = (settings.step, settings.noise == "averaged", settings.burn_in, settings.thinning)
            self.kernels.walk(first, last, begin, into, *potential, *steps, limit, *key)

        pieces = windows * -(-chains // self.kernels.LANES)
        work = chains * windows * (settings.burn_in + settings.draws * settings.thinning)
        share(go, pieces, threads=1 if work < ALONE else torch.get_num_threads())
        return kept

    def summarised(
        self, coordinates: Coordinates, w: Float[Tensor, "chain draw window 3"], groups: int, pieces: int, tail: float
    ) -> tuple[Tensor, ...]:
        """Of draws ``w``: nested R-hat ``(window, 3)`` by so many ``groups``, the furthest ``(window, 3)``, and what
        :class:`~avtorch.inference.exactness.Moments` holds of ``z``."""
        chains, _, windows, d = w.shape
        kept = to_planes(w.transpose(0, 1)).numpy()
        lower = np.ascontiguousarray(coordinates.lower.numpy())
        rhat, mean, furthest = np.empty((windows, d)), np.empty((windows, d)), np.empty(windows, np.int64)
        covariance, errors = np.empty((windows, d, d)), np.empty((windows, d, d))

        def go(first: int, last: int) -> None:
            given = (kept, lower, min(groups, chains), pieces, tail, rhat, furthest, mean, covariance, errors)
            self.kernels.summarise(first, last, *given)

        share(go, windows, threads=1 if w.numel() < ALONE else torch.get_num_threads())
        draw, chain = np.divmod(furthest, chains)
        far = kept[:, np.arange(windows), draw, chain].T
        middle = coordinates.z(torch.from_numpy(mean))
        of_draws = torch.from_numpy(errors).unbind(-1)
        return torch.from_numpy(rhat), torch.from_numpy(far), middle, torch.from_numpy(covariance), *of_draws

    def weighed(
        self,
        mean: Float[Tensor, "window 3"],
        lower: Float[Tensor, "window 3 3"],
        base: Float[Tensor, "point 3"],
        log_proposal: Float[Tensor, " point"],
        tail: float,
    ) -> tuple[Tensor, ...]:
        """Pareto-k of the importance ratios at ``mean + lower base``, ``(window,)``; weighted mean, variance and share
        beyond ``tail``, in SDs of ``lower`` about ``mean``, and the errors of these three, each ``(window, 3)``."""
        windows, points = len(mean), np.ascontiguousarray(to_planes(base).numpy())
        log_ratio, found = np.empty((windows, points.shape[1])), np.empty((windows, 3, 6))
        axes = (lower / lower.square().sum(-1, keepdim=True).sqrt()).contiguous().numpy()
        potential = whitened(self.form, Coordinates(mean, lower))

        def go(first: int, last: int) -> None:
            given = (points, log_proposal.numpy(), axes, tail)
            self.kernels.weigh(first, last, found, log_ratio, *given, *potential)

        share(go, windows, threads=1 if log_ratio.size < ALONE else torch.get_num_threads())
        largest, shape = torch.from_numpy(log_ratio).topk(tail_of(points.shape[1]) + 1).values, np.empty(windows)
        self.kernels.pareto_shapes(largest.numpy(), shape)
        return torch.from_numpy(shape), *torch.from_numpy(found).unbind(-1)

    def climbed(
        self, coordinates: Coordinates, starts: Float[Tensor, "start 3"], steps: int, stride: float
    ) -> tuple[Float[Tensor, "start window 3"], Float[Tensor, "start window"]]:
        """Where ascents from ``starts`` end, in ``w``, and the log density there less that at ``w = 0``."""
        windows, lanes = len(coordinates.mode), self.kernels.LANES
        ends, heights, begin = np.empty((windows, 3, lanes)), np.empty((windows, lanes)), np.zeros((3, lanes))
        begin[:, : len(starts)] = starts.numpy().T
        self.kernels.climb(
            0, windows, ends, heights, begin.ravel(), steps, stride, *whitened(self.form, coordinates)
        )  # fmt: skip
        count = len(starts)
        return torch.from_numpy(ends[:, :, :count]).permute(2, 0, 1), torch.from_numpy(heights[:, :count]).T


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
    """The compiled loops of a density, or why there are none."""
    name = type(density).__name__
    if not has_form(density) or outdated(density, "exponential_form"):
        return Unavailable(f"{name} has no closed form that the kernels know")
    kernels = load_kernels("kernels")
    if isinstance(kernels, Unavailable):
        return kernels
    form = density.exponential_form()
    if form is None:
        return Unavailable(f"the prior of {name} has no closed form that the kernels know")
    if form.coupling.device.type != "cpu":
        return Unavailable(f"{name} is on {form.coupling.device.type}; the kernels are for the processor")
    return Compiled(kernels, form)
