"""Ranks and exact probabilities of a validation's draws: what its pictures and the tables behind them show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.inference import Posterior, Quadrature
from avtorch.plots.chosen_windows import ChosenWindows, place
from avtorch.plots.ranks import pooled_rank_counts
from avtorch.validation.diagnostics import sampling_diagnostics
from avtorch.validation.uniformity import ecdf_band
from avtorch.validation.validate import Validation

#: Points of an ECDF of PIT values, and windows whose ECDF is drawn at most.
POINTS, MOST = 100, 200
#: Groups that SGLD's chains are joined into for their ranks, and their bins.
GROUPS, BINS = 4, 10


@dataclass(frozen=True)
class PooledRanks:
    """Of one window and parameter, by group: counts of ranks ``(bin,)`` and the effective sample size."""

    counts: dict[str, IntArray]
    effective: dict[str, float]


@dataclass(frozen=True)
class PitEcdfs:
    """Exact probabilities below a method's draws, for the numbers of its converged `windows`.

    `less_uniform` ``(parameter, window, POINTS + 1)``: the ECDF less the uniform one, from 0 on; `inside`
    ``(parameter, window)``: whether it stays in its own 95 % band; `band`: a parameter's band at the median effective
    sample size, lower and upper bound ``(POINTS,)``, empty without a window.
    """

    method: str
    windows: Tensor
    less_uniform: FloatArray
    inside: BoolArray
    band: Sequence[tuple[FloatArray, FloatArray]]


def groups_of(found: Validation) -> int:
    """Groups of SGLD's chains."""
    return min(GROUPS, found.sgld.draws.shape[0])


def ranks_of(chosen: ChosenWindows, row: int) -> list[PooledRanks]:
    """Of the `row`-th chosen window, one a parameter: groups of SGLD's chains, NUTS and exact draws in their pool."""
    found, window, groups = chosen.validation, chosen.windows[row], groups_of(chosen.validation)
    compared = place(found.compared, window.number)
    assert compared is not None
    reference = None if window.nuts is None else sampling_diagnostics(found.nuts).ess_bulk[window.nuts]
    ranks = []
    for i, name in enumerate(found.names):
        drawn = _grouped(found.sgld[name][..., window.number], groups)
        worth = {label: _ess(found.agreement.ess_bulk[compared, i]) / groups for label in drawn}
        if window.nuts is not None and reference is not None:
            drawn["NUTS"] = found.nuts[name][..., window.nuts].numpy()
            worth["NUTS"] = _ess(reference[i])
        if chosen.exact is not None:
            drawn["exact"] = chosen.exact[name][..., row].numpy()
        ranks.append(PooledRanks(pooled_rank_counts(drawn, bins=BINS), worth))
    return ranks


def ecdfs_of(found: Validation) -> list[PitEcdfs]:
    """Of SGLD and, where it was run, of NUTS; needs quadrature."""
    exact = found.quadrature
    assert exact is not None
    arms = [("SGLD", found.sgld, torch.arange(len(exact.mean)), found.agreement.ess_bulk)]
    if len(found.nuts_index):
        arms.append(("NUTS", found.nuts, found.nuts_index, sampling_diagnostics(found.nuts).ess_bulk))
    ecdfs = []
    for method, posterior, index, worth in arms:
        sound = (posterior.converged & exact.converged[index]).nonzero().squeeze(-1)
        taken = sound[torch.linspace(0, len(sound) - 1, min(MOST, len(sound))).long()]
        curves = _pit_ecdf(posterior, exact, taken, index[taken])
        names = range(len(found.names))
        bands = [[_band(_ess(worth[w, i])) for w in taken] for i in names]
        inside = [[_inside(*pair) for pair in zip(curves[i], bands[i], strict=True)] for i in names]
        less = np.pad(curves, ((0, 0), (0, 0), (1, 0))) - np.linspace(0, 1, POINTS + 1)
        middle = [_band(float(worth[taken, i].nanmedian())) for i in names] if len(taken) else []
        ecdfs.append(PitEcdfs(method, index[taken], less, np.array(inside, dtype=bool), middle))
    return ecdfs


def _grouped(chains: Tensor, groups: int) -> dict[str, np.ndarray]:
    """Draws ``(chain, draw)`` in groups of neighbouring chains, named by their first and last."""
    named, first = {}, 1
    for part in chains.tensor_split(groups):
        last = first + len(part) - 1
        named[f"SGLD {first}–{last}" if last > first else f"SGLD {first}"] = part.numpy()
        first = last + 1
    return named


def _ess(value: Tensor) -> float:
    """An effective sample size as a number: chains that stand still have none."""
    return max(4.0, float(value)) if bool(value.isfinite()) else 4.0


def _band(effective: float) -> tuple[np.ndarray, np.ndarray]:
    """Simultaneous band of an ECDF at `POINTS` points; sizes are rounded by up to 5 %, so that few bands are made."""
    rounded = int(np.exp(0.1 * np.round(10 * np.log(effective))))
    low, high = ecdf_band(rounded, POINTS - 1)
    return low.numpy(), high.numpy()


def _inside(curve: np.ndarray, band: tuple[np.ndarray, np.ndarray]) -> bool:
    return bool(((curve >= band[0] - 1e-12) & (curve <= band[1] + 1e-12)).all())


def _pit_ecdf(posterior: Posterior, quadrature: Quadrature, own: Tensor, exact: Tensor) -> np.ndarray:
    """ECDF of the exact probability below each draw, ``(parameter, window, POINTS)``.

    ``own`` are the windows among those of the draws, ``exact`` the same among those of the quadrature.
    """
    share = torch.linspace(0, 1, 401, dtype=quadrature.nodes.dtype)
    grid = torch.lerp(quadrature.nodes[..., :1], quadrature.nodes[..., -1:], share).exp()
    below = quadrature.cdf(grid.movedim(-1, 0)).movedim(0, -1)[exact].clamp(0, 1).numpy()
    levels = np.arange(1, POINTS) / POINTS
    # between nodes a thirtieth of an SD apart a straight line is off by less than 1e-4
    pairs = zip(below.reshape(-1, 401), grid[exact].reshape(-1, 401).numpy(), strict=True)
    edges = torch.from_numpy(np.array([np.interp(levels, *pair) for pair in pairs]))
    edges = edges.reshape(*below.shape[:2], POINTS - 1)
    drawn = posterior.flat[:, own].permute(1, 2, 0).contiguous()
    found = torch.searchsorted(drawn.sort(-1).values, edges, right=True) / drawn.shape[-1]
    return torch.cat([found, torch.ones_like(found[..., :1])], -1).transpose(0, 1).numpy()
