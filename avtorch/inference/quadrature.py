"""Posteriors of up to three parameters by integration over a grid: the exact reference of the samplers.

The trapezoid rule on a smooth density that has died out at both ends converges faster than any power of the spacing
(Trefethen and Weideman 2014), so a grid of one node per third of an SD is exact to round-off on a normal. The grid lies
in coordinates whitened at the mode, then at the moments found, and extends over all of the mass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.inference.arviz_export import parameter_table
from avtorch.inference.density import Density
from avtorch.inference.map import Mode, find_mode

#: Initial half width of the grid in SDs, the growth of a side that still has mass, and how often it may grow.
REACH, GROWTH, ROUNDS = 7.0, 1.3, 12
#: A side reaches too short if the marginal on its face is above the first share of its peak, and too far beyond the
#: nodes that are above the second.
FACE, NOTHING = 1e-7, 1e-9
#: Least nodes an axis from which moments are worth moving to.
COARSE = 21
#: Evaluations of the density at once, over nodes and windows.
BLOCK = 2**20


@dataclass(frozen=True, repr=False)
class Quadrature(Displayed):
    """Posterior of every window, from one-dimensional marginals that a grid over the other parameters gave.

    Attributes:
        names: parameter names, in the order of the last dimension.
        mean, sd: of the positive parameters, in their own units, ``(window, parameter)``.
        log_evidence: log integral of the density, ``(window,)``; normalised if likelihood and prior are.
        error: ``(window,)``; what changes if every second node of every axis is left out: the largest of the shift of
            a mean in SDs, the relative change of an SD and the change of the log evidence. As the rule converges
            faster than any power of the spacing, a small value bounds the error of the full grid with much to spare
            (but for the tails cut off at the faces, some 1e-7 of the mass).
        edge: ``(window,)``; the largest marginal density on a face of the grid, as a share of its peak.
        converged: ``(window,)`` bool; false where ``error`` exceeds the tolerance or mass reaches the edge.
        nodes: log parameters at the nodes of each marginal, ``(window, parameter, node)``, evenly spaced.
        mass: probability of each node, sums to one, ``(window, parameter, node)``.

    Example:
        >>> from avtorch.inference import integrate
        >>> from avtorch.validation import synthetic_windows
        >>> exact = integrate(synthetic_windows(2, seed=1).density, nodes=25)
        >>> tuple(exact.mean.shape), exact.converged.all().item()
        ((2, 3), True)
        >>> [round(x, 3) for x in exact.cdf(exact.quantile(0.9))[0].tolist()]
        [0.9, 0.9, 0.9]
    """

    names: tuple[str, ...]
    mean: Float[Tensor, "window parameter"]
    sd: Float[Tensor, "window parameter"]
    log_evidence: Float[Tensor, " window"]
    error: Float[Tensor, " window"]
    edge: Float[Tensor, " window"]
    converged: Bool[Tensor, " window"]
    nodes: Float[Tensor, "window parameter node"]
    mass: Float[Tensor, "window parameter node"]

    def overview(self) -> Card:
        """Its size, whether it converged, and the parameters of the first windows."""
        windows = len(self.converged)
        title = f"Quadrature of {', '.join(self.names)}: {windows} window{'' if windows == 1 else 's'}"
        line = f"{int(self.converged.sum())} of {windows} converged; largest error {float(self.error.max()):.2g}."
        return Card(title, (line,), self.summary(), most=2 * len(self.names))

    def summary(self) -> Frame:
        """A row a window and parameter: mean, sd and the 5 and 95 % quantiles."""
        stats = {"mean": self.mean, "sd": self.sd, "q05": self.quantile(0.05), "q95": self.quantile(0.95)}
        return parameter_table("window", self.names, stats)

    def cdf(self, values: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        """Posterior probability of a parameter below ``values`` ``(..., window, parameter)``, in their own units.

        It integrates the band-limited interpolant of the marginal, as accurate as the grid itself.
        """
        # imported here, because few commands integrate and scipy.special takes a tenth of a second
        from scipy.special import sici

        spacing = self.nodes[..., 1:2] - self.nodes[..., :1]
        distance = torch.pi * (values.log().unsqueeze(-1) - self.nodes) / spacing
        sine_integral = torch.from_numpy(sici(distance.cpu().numpy())[0]).to(distance.device)
        return (self.mass * (0.5 + sine_integral / torch.pi)).sum(-1)

    def quantile(self, q: float) -> Float[Tensor, "window parameter"]:
        """Posterior quantiles ``(window, parameter)``, by bisection of :meth:`cdf`.

        Raises `InputError` for ``q`` outside (0, 1).
        """
        if not 0 < q < 1:
            raise InputError(f"q: {q} is not in (0, 1)")
        low, high = self.nodes[..., 0], self.nodes[..., -1]
        for _ in range(45):  # a grid's width over 2^45 is below round-off of the CDF
            middle = 0.5 * (low + high)
            below = self.cdf(middle.exp()) < q
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return (0.5 * (low + high)).exp()


def integrate(density: Density, *, mode: Mode | None = None, nodes: int = 49, tolerance: float = 0.03) -> Quadrature:
    """Integrate the posterior of every window by the trapezoid rule on a tensor grid.

    The grid is re-centred and rescaled to the moments found, and its sides trimmed and grown, until it lies where the
    mass is, so that a skewed posterior is covered. Each parameter then gets a grid whose first axis is its own, so that
    its marginal falls on the nodes.

    Args:
        density: over ``z = log(parameter)``, at most three parameters.
        mode: its mode and curvature, if known.
        nodes: nodes an axis, odd; the cost is ``parameters * nodes**parameters`` evaluations a window.
        tolerance: largest :attr:`Quadrature.error` that passes; the full grid's own error is about its square.

    Raises `InputError` for a density of more than three parameters, or ``nodes`` even or below 9.

    Example:
        >>> from avtorch.inference import integrate
        >>> from avtorch.validation import synthetic_windows
        >>> exact = integrate(synthetic_windows(1, seed=1).density)
        >>> exact.names, exact.converged.item()
        (('T_L', 'K_L', 'sigma'), True)
    """
    d = len(density.names)
    if d > 3:
        raise InputError(f"density: {d} parameters, but a grid is affordable for at most 3")
    if nodes < 9 or nodes % 2 == 0:
        raise InputError(f"nodes: {nodes} is not an odd number of at least 9")
    mode = find_mode(density) if mode is None else mode
    place = _Place.at(mode)
    for _ in range(ROUNDS):  # moments need fewer nodes
        found = _integrate(density, place, max(COARSE, nodes // 2 | 1), mode.log_prob)
        if found.covers_mass():
            break
        place = place.moved(found)
    marginals, log_evidence, edge = [], [], []
    for i in range(d):
        own = place.led_by(i)
        found = _integrate(density, own, nodes, mode.log_prob)
        for _ in range(ROUNDS):  # another order of the axes has other faces
            if not bool(found.short().any()):
                break
            own = own.grown(found)
            found = _integrate(density, own, nodes, mode.log_prob)
        marginals.append((own.first_axis(nodes), found.marginals[:, 0], found.coarse))
        log_evidence.append(mode.log_prob + (found.total * own.cell(nodes)).log())
        edge.append(found.edge().flatten(1).amax(1))
    z = torch.stack([m[0] for m in marginals], 1)
    mass = torch.stack([m[1] / m[1].sum(-1, keepdim=True) for m in marginals], 1)
    coarse = torch.stack([m[2] for m in marginals], 1)
    mean, sd = _moments(z, mass)
    coarse_mean, coarse_sd = _moments(z[..., ::2], coarse / coarse.sum(-1, keepdim=True))
    evidence = torch.stack(log_evidence, -1)
    lost = (2**d * coarse.sum(-1) / torch.stack([m[1].sum(-1) for m in marginals], 1)).log()
    changes = torch.cat([(coarse_mean - mean) / sd, coarse_sd / sd - 1, lost, evidence - evidence[:, :1]], -1)
    error = changes.abs().nan_to_num(nan=torch.inf).amax(-1)
    reached = torch.stack(edge, -1).nan_to_num(nan=torch.inf).amax(-1)
    good = (error <= tolerance) & (reached <= 10 * FACE)
    return Quadrature(density.names, mean, sd, evidence.mean(-1), error, reached, good, z, mass)


def _moments(
    z: Float[Tensor, "window parameter node"], mass: Float[Tensor, "window parameter node"]
) -> tuple[Float[Tensor, "window parameter"], Float[Tensor, "window parameter"]]:
    """Mean and SD of ``exp(z)``, each ``(window, parameter)``."""
    value = z.exp()
    mean = (mass * value).sum(-1)
    return mean, (mass * (value - mean.unsqueeze(-1)).square()).sum(-1).sqrt()


@dataclass(frozen=True)
class _Sums:
    """The result of one pass over a grid of weights ``w = exp(log_prob - reference)``.

    total ``(window,)``; mean and cov of the whitened coordinates; marginals ``(window, axis, node)``; coarse: marginal
    of the first axis on every second node of all axes, ``(window, node // 2 + 1)``.
    """

    total: Float[Tensor, " window"]
    mean: Float[Tensor, "window d"]
    cov: Float[Tensor, "window d d"]
    marginals: Float[Tensor, "window d node"]
    coarse: Float[Tensor, "window half"]

    def edge(self) -> Float[Tensor, "window d 2"]:
        """Marginal at both ends of every axis over its peak, ``(window, axis, 2)``."""
        ends = torch.stack([self.marginals[..., 0], self.marginals[..., -1]], -1)
        return ends / self.marginals.amax(-1, keepdim=True)

    def short(self) -> Bool[Tensor, "window d 2"]:
        """Where a side still has mass, ``(window, axis, 2)`` bool."""
        return self.edge() > FACE

    def covers_mass(self) -> bool:
        """Whether the grid of every window lies where its mass is."""
        eye = torch.eye(self.cov.shape[-1], dtype=self.cov.dtype, device=self.cov.device)
        still = (self.mean.abs() < 0.1).all() & ((self.cov - eye).abs() < 0.2).all()
        return bool(still & ~self.short().any())


@dataclass(frozen=True)
class _Place:
    """Where the grids lie: ``z = center + lower @ x`` with ``x_i`` from ``-reach_i0`` to ``reach_i1``.

    ``lower`` is triangular in the parameters' order ``order``, so the first axis moves only the first of them and
    ``x`` is in SDs. center ``(window, d)``, cov ``(window, d, d)``, reach ``(window, d, 2)``, all in ``order``.
    """

    center: Float[Tensor, "window d"]
    cov: Float[Tensor, "window d d"]
    reach: Float[Tensor, "window d 2"]
    order: tuple[int, ...]

    @classmethod
    def at(cls, mode: Mode) -> _Place:
        d = mode.z.shape[-1]
        return cls(mode.z, mode.covariance, mode.z.new_full((*mode.z.shape, 2), REACH), tuple(range(d)))

    @property
    def lower(self) -> Float[Tensor, "window d d"]:
        return torch.linalg.cholesky(self.cov)

    def led_by(self, i: int) -> _Place:
        """The same with parameter ``i`` first."""
        order = (i, *(j for j in range(len(self.order)) if j != i))
        by = torch.tensor(order, device=self.center.device)
        return _Place(self.center[:, by], self.cov[:, by][:, :, by], self.reach[:, by], order)

    def x(self, nodes: int) -> Float[Tensor, "window d node"]:
        """Coordinates of the nodes of every axis, ``(window, axis, node)``."""
        share = torch.linspace(0, 1, nodes, dtype=self.center.dtype, device=self.center.device)
        return -self.reach[..., :1] + self.reach.sum(-1, keepdim=True) * share

    def first_axis(self, nodes: int) -> Float[Tensor, "window node"]:
        """Log of the first parameter of the order at its nodes, ``(window, node)``."""
        return self.center[:, :1] + self.cov[:, 0, 0].sqrt()[:, None] * self.x(nodes)[:, 0]

    def cell(self, nodes: int) -> Float[Tensor, " window"]:
        """Volume of a cell in ``z``, ``(window,)``."""
        spacing = self.reach.sum(-1) / (nodes - 1)
        return (self.lower.diagonal(dim1=-2, dim2=-1) * spacing).prod(-1)

    def grown(self, sums: _Sums) -> _Place:
        """With longer reach on the sides that still have mass."""
        return replace(self, reach=torch.where(sums.short(), GROWTH * self.reach, self.reach))

    def trimmed(self, sums: _Sums) -> _Place:
        """With each side ending one node beyond the last with mass: this trims the steep side of a skewed posterior."""
        nodes = sums.marginals.shape[-1]
        empty = sums.marginals <= NOTHING * sums.marginals.amax(-1, keepdim=True)
        idle = torch.stack([empty.int().cumprod(-1).sum(-1), empty.flip(-1).int().cumprod(-1).sum(-1)], -1)
        spacing = self.reach.sum(-1, keepdim=True) / (nodes - 1)
        return replace(self, reach=self.reach - spacing * (idle - 1).clamp_min(0))

    def moved(self, sums: _Sums) -> _Place:
        """To the moments found, with the sides trimmed and grown to the mass found."""
        lower = self.lower
        # a window with mass on a single node has no covariance; it stays, and its error will be large
        sound = torch.linalg.eigvalsh(sums.cov.nan_to_num())[:, 0] > 1e-6
        center = self.center + torch.einsum("wij,wj->wi", lower, sums.mean)
        cov = lower @ sums.cov @ lower.mT
        center = torch.where(sound[:, None], center, self.center)
        cov = torch.where(sound[:, None, None], 0.5 * (cov + cov.mT), self.cov)
        return replace(self.trimmed(sums).grown(sums), center=center, cov=cov)


def _integrate(density: Density, place: _Place, nodes: int, reference: Float[Tensor, " window"]) -> _Sums:
    """One pass, slab by slab of the first axis so that the memory stays bounded."""
    windows, d = place.center.shape
    x, lower = place.x(nodes), place.lower
    count = nodes ** (d - 1)
    strides = nodes ** torch.arange(d - 2, -1, -1, device=x.device)
    rest = (
        torch.arange(count, device=x.device)[:, None] // strides % nodes
    )  # the other axes' nodes in a slab, (count, d - 1)
    others = x[:, 1:].gather(-1, rest.T.expand(windows, -1, -1)).permute(2, 0, 1)  # (count, window, d - 1)
    even = (rest % 2 == 0).all(-1)
    back = torch.tensor([place.order.index(j) for j in range(d)], device=x.device)
    slabs = max(1, min(nodes, BLOCK // (count * windows)))
    weights, coarse = [], []
    mean, square = torch.zeros_like(place.center), torch.zeros_like(place.cov)
    shared = x.new_zeros(count, windows)
    for k in range(0, nodes, slabs):
        first = x[:, 0, k : k + slabs].T[:, None, :, None].expand(-1, count, -1, 1)
        points = torch.cat([first, others.expand(len(first), -1, -1, -1)], -1)  # (slab, node, window, d)
        z = place.center + torch.einsum("wij,snwj->snwi", lower, points)
        with torch.no_grad():
            log_prob = density.log_prob(z[..., back])
        # far out a density may overflow to "inf - inf": there is no mass
        w = (log_prob - reference).exp().nan_to_num(nan=0.0)
        weights.append(w.sum(1))
        coarse.append(w[:, even].sum(1))
        shared += w.sum(0)
        mean += torch.einsum("snw,snwi->wi", w, points)
        square += torch.einsum("snwi,snwj->wij", w.unsqueeze(-1) * points, points)
    first_marginal = torch.cat(weights).T
    cube = shared.T.reshape(windows, *[nodes] * (d - 1))
    keep = [tuple(1 + m for m in range(d - 1) if m != j) for j in range(d - 1)]
    marginals = torch.stack([first_marginal, *(cube.sum(dims) if dims else cube for dims in keep)], 1)
    total = first_marginal.sum(-1)
    mean = mean / total[:, None]
    cov = square / total[:, None, None] - mean.unsqueeze(-1) * mean.unsqueeze(-2)
    return _Sums(total, mean, cov, marginals, torch.cat(coarse)[::2].T)
