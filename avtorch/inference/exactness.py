r"""Do the draws of a walk follow the density? Chains that agree with each other need not agree with the posterior.

A constant step has a law of its own, and chains that all begin at the mode may not have reached the posterior's tails.
The log density is exact and cheap, so it serves as the test: points are drawn from a proposal around the draws, a
mixture of normals with the draws' mean and covariance and 1 to 15 times their SDs, and weighed by ``density /
proposal``. If the ratios are reliable (Pareto-k, :mod:`avtorch.inference.importance`), their weighted moments are the
posterior's, with a Monte Carlo error that is known, and those of the draws are compared with them. If the ratios are
not reliable, the draws do not cover the density, or its shape is too far from normal for this test: then nothing is
claimed.

A mode that no chain has reached is searched for by ascents of the density that start far from the draws.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.inference.chains import rhat_of_halves
from avtorch.inference.coordinates import Coordinates
from avtorch.inference.density import Density, has_selection, matvec, score_of, selected
from avtorch.inference.importance import RELIABLE, pareto_k
from avtorch.inference.map import find_mode

MEAN_TOLERANCE, SD_TOLERANCE, TAIL_TOLERANCE = 0.1, 0.05, 0.003
"""Tolerances: error of a mean in SDs, of an SD as a ratio, of the share of draws beyond TAIL as a probability."""
TAIL = 3.0
"""SDs of the draws, on either side, where the tail begins: a heavy tail shows there long before it affects the SD."""
RESOLUTION = 0.05
"""A claim needs the density's moments to be known this well: standard error of a mean in SDs, of an SD as a ratio."""
ERRORS = 3.0
"""Monte Carlo standard errors of the draws that are allowed where they exceed the tolerance."""
HEAVY = 1.0
"""Upper bound on an SD's error in errors of its mean: 0.7 under a normal, 1 at a kurtosis of 5. Beyond it a few far
draws determine the SD, and missing ones make it too small rather than uncertain."""
CERTAIN = 0.4
"""Pareto-k up to which a small sample of points is enough; between this and RELIABLE a rare point may still matter."""
#: SDs of the proposal's components in the draws' SDs, and their shares; the wide ones find mass that the draws miss.
SCALES, SHARES = (1.0, 1.5, 3.0, 6.0, 15.0), (0.45, 0.27, 0.14, 0.09, 0.05)
#: Factor by which a second test increases the points where the first is inconclusive.
AGAIN = 8
#: Points times windows at once, here, where the processor's cache holds them, and on a graphics card.
BLOCK, CARD_BLOCK = 2**15, 2**22
#: Numbers whose moments are taken at once.
CACHED = 2**17
#: Distances of the starts in SDs of the draws, evenly spaced; these are half of them, the others are mirror images.
RADII = (4.0, 16.0)
STARTS, STEPS = 16, 3
#: Longest step of the climb, in the same SDs.
STRIDE = 10.0
#: Nats below the draws' centre, and SDs away from it, at which an end point is searched for a mode.
DEPTH, FAR = 7.0, 5.0
#: Share of the posterior's mass (by Laplace) from which a mode must not be missed.
MASS = 0.005


@dataclass(frozen=True)
class Exactness:
    """The draws' moments against the exact density's, in the unconstrained coordinates ``z``.

    Three figures a parameter, ``(window, 3, parameter)``: of the mean in SDs, of the SD as a ratio, and of the share
    beyond TAIL of the draws' SDs as a probability.

    Attributes:
        pareto_k: shape of the importance ratios' tail, ``(window,)``; above 0.7 the rest is not reliable.
        off: of the draws less that of the density; of the ratio of SDs, less 1.
        error: its Monte Carlo standard error from the density's side.
        draws_error: the same from the draws' side.
        missed: mass of another mode over that at the draws, ``(window,)``; 0 where none was found.
    """

    pareto_k: Float[Tensor, " window"]
    off: Float[Tensor, "window 3 parameter"]
    error: Float[Tensor, "window 3 parameter"]
    draws_error: Float[Tensor, "window 3 parameter"]
    missed: Float[Tensor, " window"]

    def __iter__(self) -> Iterator[Tensor]:
        return (getattr(self, f.name) for f in fields(self))

    def known(self, resolution: float = RESOLUTION) -> Bool[Tensor, " window"]:
        """Where the density's mean and SD are known well enough to compare with, ``(window,)`` bool."""
        return (self.error[:, :2] <= resolution).flatten(1).all(-1) & (self.pareto_k < RELIABLE)

    @cached_property
    def beyond(self) -> Bool[Tensor, "window 3 parameter"]:
        """Where mean, SD or tail of the draws exceeds tolerance and chance, ``(window, 3, parameter)`` bool.

        A standard error of the density's side is allowed in addition.
        """
        mean, sd, tail = self.draws_error.unbind(1)
        own = torch.stack([mean, torch.minimum(sd, HEAVY * mean), tail], 1)
        tolerance = self.off.new_tensor([MEAN_TOLERANCE, SD_TOLERANCE, TAIL_TOLERANCE])[:, None]
        return ~(self.off.abs() <= torch.maximum(tolerance, ERRORS * own) + self.error)

    @cached_property
    def within(self) -> Bool[Tensor, " window"]:
        """Where no figure is beyond tolerance and chance, ``(window,)`` bool."""
        return ~self.beyond.flatten(1).any(-1)

    @cached_property
    def hopeless(self) -> Bool[Tensor, " window"]:
        """Where the ratios do not even have a mean: the density is far from the draws, ``(window,)`` bool."""
        return self.pareto_k > 1.0

    @cached_property
    def sure(self) -> Bool[Tensor, " window"]:
        """Where more points would hardly change the answer, ``(window,)`` bool."""
        return self.known() & (self.pareto_k < CERTAIN) | self.hopeless

    @cached_property
    def clear(self) -> Bool[Tensor, " window"]:
        """Where the first test already shows that the draws follow the density, ``(window,)`` bool."""
        return self.known(2 * RESOLUTION) & (self.pareto_k < CERTAIN) & self.within

    @cached_property
    def holds(self) -> Bool[Tensor, " window"]:
        """Where the draws are shown to follow the density, ``(window,)`` bool."""
        return (self.clear | self.known() & self.within) & (self.missed == 0)

    def why(self, names: tuple[str, ...]) -> list[str]:
        """What is wrong with each window, ``""`` where the draws follow the density."""
        known, holds = self.known().tolist(), self.holds.tolist()
        return ["" if holds[w] else self._reason(w, known[w], names) for w in range(len(holds))]

    def _reason(self, w: int, known: bool, names: tuple[str, ...]) -> str:
        if float(self.missed[w]) > 0:
            mass = f"{float(self.missed[w]):.3g} times the mass at the draws"
            return f"the density has another mode of {mass}, which no chain has reached"
        if not known:
            k = float(self.pareto_k[w])
            found = f"Pareto-k {k:.2f}, needs {RELIABLE:g} or less" if k >= RELIABLE else "too few effective points"
            return f"importance weights cannot show that the draws follow the density ({found})"
        kind, i = divmod(int(self.beyond[w].flatten().int().argmax()), len(names))
        off = float(self.off[w, kind, i])
        wrong = (
            f"the mean of {names[i]} is wrong by {off:+.2f} SDs",
            f"the SD of {names[i]} is {1 + off:.2f} times the exact one",
            f"the tails of {names[i]} hold {off:+.3f} of probability too much",
        )[kind]
        return f"the draws do not follow the density: in unconstrained coordinates {wrong}"

    def put(
        self, index: Int[Tensor, " chosen"], other: Exactness, where: Bool[Tensor, " chosen"] | None = None
    ) -> Exactness:
        """The same with the windows ``index`` taken from ``other``, or those of them where ``where`` is true."""
        if where is None or bool(where.all()):
            if len(index) == len(self.missed):
                return other
            where = torch.ones_like(index, dtype=torch.bool)
        here, there = index[where], where.nonzero().squeeze(-1)
        return Exactness(*(mine.index_copy(0, here, theirs[there]) for mine, theirs in zip(self, other, strict=True)))

    @classmethod
    def unknown(cls, z: Float[Tensor, "window parameter"]) -> Exactness:
        """NaN throughout, in the shape of ``z`` ``(window, parameter)``: nothing is known of any window."""
        window = torch.full_like(z[:, 0], torch.nan, dtype=torch.float64)
        each = window[:, None, None].expand(-1, 3, z.shape[1])
        return cls(window, each, each, each, window)


def compare_with_exact(density: Density, moments: Moments, total: int) -> Exactness:
    """Compare draws of these moments, ``total`` of each window, with their density.

    The first test takes few points compared with the draws; windows where it is inconclusive get about AGAIN times as
    many, and those still undecided get AGAIN times more. Windows that pass are searched for other modes.
    """
    points = min(1024, max(256, total // 8))
    closer = min(AGAIN * points, max(4 * points, total))
    # few draws mean that the density is expensive
    counts = (closer, AGAIN * closer) if total >= 4096 else (closer,)
    everyone = torch.arange(len(moments.mean), device=moments.mean.device)

    def chosen(where: Tensor) -> Tensor:
        if has_selection(density):
            return everyone[where]
        return everyone if bool(where.any()) else everyone[:0]

    found = weighed(density, moments, points)
    for count in counts:
        # more points do not help where the ratios' tail is clearly heavy
        index = chosen(~(found.clear if count == closer else found.clear | found.sure))
        if len(index):
            found = found.put(index, weighed(selected(density, index), moments.select(index), count))
    index = chosen(found.holds)
    if len(index):
        part = moments.select(index)
        missed = missed_mass(selected(density, index), part.mean, part.lower)
        found = replace(found, missed=found.missed.index_put((index,), missed))
    return found


class Moments(NamedTuple):
    """Moments of draws: ``lower`` ``(window, parameter, parameter)``, the rest ``(window, parameter)``.

    Attributes:
        rhat: nested R-hat.
        mean: in the units of ``z``.
        lower: triangular root of the covariance, NaN where it has none.
        share: of the draws beyond TAIL.
        mean_error, sd_error: standard errors [SD, as a ratio] by the means of independent pieces: chains, cut where
            there are fewer than sixteen.
    """

    rhat: Float[Tensor, "window parameter"]
    mean: Float[Tensor, "window parameter"]
    lower: Float[Tensor, "window parameter parameter"]
    share: Float[Tensor, "window parameter"]
    mean_error: Float[Tensor, "window parameter"]
    sd_error: Float[Tensor, "window parameter"]

    @classmethod
    def of(cls, z: Float[Tensor, "chain draw window parameter"]) -> Moments:
        """Compute them from draws ``(chain, draw, window, parameter)``."""
        size = z.shape[2] if z.is_cuda else max(1, CACHED // z[:, :, 0].numel())
        parts = [cls._of(part) for part in z.split(size, 2)]
        return parts[0] if len(parts) == 1 else cls(*map(torch.cat, zip(*parts, strict=True)))

    @classmethod
    def _of(cls, z: Float[Tensor, "chain draw window parameter"]) -> Moments:
        chains, draws = z.shape[:2]
        # (window, parameter, draw, chain), contiguous as the walk leaves it
        planes = z.permute(2, 3, 1, 0)
        mean = planes.mean((-2, -1))
        centred = planes - mean[..., None, None]
        square, flat = centred.square(), centred.flatten(2)
        covariance = flat @ flat.mT / (flat.shape[-1] - 1)
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        beyond = (square > TAIL**2 * variance[..., None, None]).flatten(2).count_nonzero(-1)
        pieces = 2 if chains >= 16 else 2 * max(1, min(draws // 4, -(-8 // chains)))
        long = draws // pieces
        of_piece = torch.eye(pieces, dtype=z.dtype, device=z.device).repeat_interleave(long, 1)
        sums, squares = (of_piece @ x[..., : pieces * long, :] for x in (centred, square))
        halves = (x.unflatten(2, (2, -1)).sum(3) for x in (sums, squares))
        rhat = rhat_of_halves(*halves, half=long * pieces // 2)
        # many chains are pieces enough; halves of one are not independent
        count, long = (chains, 2 * long) if chains >= 16 else (pieces * chains, long)
        each, each_square = ((x.sum(2) if chains >= 16 else x.flatten(2)).std(-1) / long for x in (sums, squares))
        of_mean, of_sd = each / (variance * count).sqrt(), 0.5 * each_square / variance / count**0.5
        lower, failed = torch.linalg.cholesky_ex(covariance.nan_to_num())
        lower = torch.where((failed == 0)[:, None, None], lower, torch.nan)
        return cls(rhat, mean, lower, beyond.to(z) / flat.shape[-1], of_mean, of_sd)

    def select(self, index: Int[Tensor, " chosen"]) -> Moments:
        """The windows named by ``index``."""
        return self if len(index) == len(self.mean) else Moments(*(x[index] for x in self))


def weighed(density: Density, moments: Moments, points: int) -> Exactness:
    """Compare draws of these moments with their density: one call of its ``log_prob``, or a few for many windows."""
    mean = moments.mean
    base, log_proposal = (x.to(mean.device) for x in proposal(points, mean.shape[-1]))
    size = max(1, (CARD_BLOCK if mean.is_cuda else BLOCK) // points) if has_selection(density) else len(mean)
    parts = torch.arange(len(mean), device=mean.device).split(size)
    found = [_weighed(selected(density, i), moments.select(i), base, log_proposal) for i in parts]
    return Exactness(*map(torch.cat, zip(*found, strict=True)))


def _weighed(density: Density, moments: Moments, base: Tensor, log_proposal: Tensor) -> Exactness:
    _, mean, lower, share, mean_error, sd_error = moments
    away = matvec(lower, base[:, None].expand(-1, len(mean), -1))
    with torch.no_grad():
        log_ratio = log_density(density, away + mean) - log_proposal[:, None]
    log_ratio = log_ratio.masked_fill(~(log_ratio < torch.inf), -torch.inf)
    weight = log_ratio.mT.softmax(-1).nan_to_num()[:, None]
    # (window, parameter, point), as they are in memory, in the draws' SDs about their mean
    y = away.permute(1, 2, 0) / lower.square().sum(-1, keepdim=True).sqrt()
    out = (y.abs() > TAIL).to(y)
    m, tail = y @ weight.mT, out @ weight.mT
    off = y - m
    square = off.square()
    variance = (square @ weight.mT).clamp_min(1e-300)
    # point and mirror image count as one: their errors cancel in part
    pairs = ((weight * x).unflatten(-1, (2, -1)).sum(-2) for x in (off, square - variance, out - tail))
    m_error, v_error, tail_error = (x.square().sum(-1).sqrt() for x in pairs)
    m, tail, variance = m[..., 0], tail[..., 0], variance[..., 0]
    spread = variance.sqrt()
    # binomial error of the tail's share, for the mean's effective number of independent draws
    of_tail = (torch.maximum(share, tail) * mean_error.square()).sqrt()
    return Exactness(
        pareto_k(log_ratio),
        off=torch.stack([-m / spread, 1 / spread - 1, share - tail], 1),
        error=torch.stack([m_error / spread, 0.5 * v_error / variance, tail_error], 1),
        draws_error=torch.stack([mean_error, sd_error, of_tail], 1),
        missed=torch.zeros(len(mean), dtype=mean.dtype, device=mean.device),
    )


def log_density(density: Density, z: Float[Tensor, "point window parameter"]) -> Float[Tensor, "point window"]:
    """``log_prob`` of ``z`` ``(point, window, parameter)``, minus infinity where the density raises.

    Far out, a user's function may pass numbers that torch's distributions refuse by raising.
    """
    try:
        value = density.log_prob(z)
        return value.masked_fill(value.isnan(), -torch.inf)
    except ValueError:
        if len(z) == 1:
            return z.new_full(z.shape[:2], -torch.inf)
        half = len(z) // 2
        return torch.cat([log_density(density, z[:half]), log_density(density, z[half:])])


@lru_cache(maxsize=32)
def proposal(points: int, d: int) -> tuple[Float[Tensor, "point d"], Float[Tensor, " point"]]:
    """Points ``(point, d)`` of a scale mixture of standard normals, mirrored, and their log density ``(point,)``.

    They are the same for every window and every run, independent of the sampler's random numbers.
    """
    half = points // 2
    edges = (torch.arange(half, dtype=torch.float64) + 0.5) / half
    kind = torch.bucketize(edges, torch.tensor(SHARES[:-1], dtype=torch.float64).cumsum(0))
    scales = torch.tensor(SCALES, dtype=torch.float64)
    normal = torch.randn(half, d, dtype=torch.float64, generator=torch.Generator().manual_seed(d))
    x = normal * scales[kind, None]
    x = torch.cat([x, -x])
    square = x.square().sum(-1, keepdim=True)
    share = torch.tensor(SHARES, dtype=torch.float64).log()
    parts = share - 0.5 * square / scales.square() - d * scales.log() - 0.5 * d * math.log(2 * math.pi)
    # the memory order in which the sums over points run
    return x.mT.contiguous().mT, parts.logsumexp(-1)


def missed_mass(
    density: Density, mean: Float[Tensor, "window parameter"], lower: Float[Tensor, "window parameter parameter"]
) -> Float[Tensor, " window"]:
    """Mass of the heaviest mode found far from the draws, over that at the draws, ``(window,)``; 0 where none was.

    `mean`, `lower`: the draws' mean ``(window, parameter)`` and triangular root of their covariance.
    """
    missed = mean.new_zeros(len(mean))
    try:
        w, height = _climbed(density, mean, lower)
    except ValueError:  # a user's function that raises this far out: no search ends there
        return missed
    high = (w.square().sum(-1) > FAR**2) & (height > -DEPTH)
    index = high.any(0).nonzero().squeeze(-1)
    if not len(index) or not (has_selection(density) or len(mean) == 1):
        return missed
    best = height.masked_fill(~high, -torch.inf).argmax(0)[index]
    chosen = selected(density, index)
    other = find_mode(chosen, start=matvec(lower[index], w[best, index]) + mean[index])
    with torch.no_grad():
        centre = chosen.log_prob(mean[index])
    away = torch.linalg.solve_triangular(lower[index], (other.z - mean[index])[..., None], upper=False)[..., 0]
    roots = (root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1) for root in (other.scale, lower[index]))
    # a skewed posterior's own mode lies near its draws; the density at their centre replaces it
    ratio = (other.log_prob - centre + next(roots) - next(roots)).exp()
    there = other.converged & (away.norm(dim=-1) > FAR) & (ratio > MASS)
    return missed.index_put((index,), torch.where(there, ratio, 0.0))


def _climbed(density: Density, mean: Tensor, lower: Tensor) -> tuple[Tensor, Tensor]:
    """Where ascents from all starts end, in the draws' SDs about their mean, and the log density there less that at the
    mean."""
    at = Coordinates(mean, lower)
    w = starts(mean.shape[-1]).to(mean.device)[:, None].expand(-1, len(mean), -1)
    for _ in range(STEPS):
        slope = at.pull_back(score_of(density, at.z(w)))
        w = w + slope * (STRIDE / slope.square().sum(-1, keepdim=True).sqrt_()).clamp_max_(1.0)
    w = w.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    with torch.no_grad():
        height = density.log_prob(torch.cat([mean[None], at.z(w)]))
    return w, height[1:] - height[:1]


@lru_cache(maxsize=32)
def starts(d: int) -> Float[Tensor, "start d"]:
    """``(start, d)``: directions at random but always the same, and their mirror images, at rising radii."""
    half = STARTS // 2
    direction = torch.randn(half, d, dtype=torch.float64, generator=torch.Generator().manual_seed(100 + d))
    radius = torch.linspace(math.log(RADII[0]), math.log(RADII[1]), half, dtype=torch.float64).exp()
    direction = direction / direction.norm(dim=-1, keepdim=True) * radius[:, None]
    return torch.cat([direction, -direction])
