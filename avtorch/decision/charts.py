r"""Control charts on standardised innovations, designed for a stated in-control average run length (ARL).

In control the innovations are independent standard normal. One two-sided chart alarms

- **Shewhart** when :math:`|z_t| > L`;
- **EWMA** when :math:`|e_t| > L \sqrt{w/(2-w)}`, with :math:`e_t = (1-w) e_{t-1} + w z_t` and :math:`e_0 = 0`;
- **CUSUM** when :math:`\max(c^+_t, c^-_t) > L`, with :math:`c^\pm_t = \max(0, c^\pm_{t-1} \pm z_t - r)`, likewise.

All limits are computed. The ARL of Shewhart is exact; those of EWMA and CUSUM solve the renewal (Fredholm) equation of
the chart's Markov chain, the continuous limit of Brook & Evans (1972), on Gauss-Legendre nodes; the limit for a
wanted ARL is then found by bracketing. A chart starts again from zero after its alarm, so alarms in control come an
ARL apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from avtorch.errors import InputError

ChartKind = Literal["shewhart", "ewma", "cusum"]
CHARTS: tuple[ChartKind, ...] = ("shewhart", "ewma", "cusum")

WEIGHT = 0.2
"""EWMA's weight of the last window."""
ALLOWANCE = 0.5
"""CUSUM's allowance, half the shift it is best at [standard deviations]."""

_NODES = 80  # the kernel is a smooth normal density: the ARL has settled to about ten digits by then


def shewhart_arl(limit: float) -> float:
    """Exact in-control ARL [windows] of the two-sided Shewhart chart."""
    return 1.0 / math.erfc(limit / math.sqrt(2.0))


def ewma_arl(limit: float, weight: float) -> float:
    """In-control ARL [windows] of the two-sided EWMA chart from zero; `limit` in steady-state standard deviations."""
    edge = limit * math.sqrt(weight / (2.0 - weight))
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes, weights = nodes * edge, weights * edge

    def kernel(start: np.ndarray) -> np.ndarray:
        return _density((nodes - (1.0 - weight) * start[:, None]) / weight) / weight * weights

    inside = np.linalg.solve(np.eye(_NODES) - kernel(nodes), np.ones(_NODES))
    return float(1.0 + kernel(np.zeros(1))[0] @ inside)


def cusum_arl(limit: float, reference: float) -> float:
    """In-control ARL [windows] of the two-sided CUSUM chart from zero.

    The two arms alarm at the same rate, and the rates of the arms add (Kemp): the ARL is half that of one arm.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes, weights = (nodes + 1.0) * limit / 2.0, weights * limit / 2.0
    # Unknowns: the ARL from zero, where the chart has an atom, then from each node.
    states = np.concatenate([[0.0], nodes])
    kernel = np.empty((_NODES + 1, _NODES + 1))
    kernel[:, 0] = torch.special.ndtr(torch.from_numpy(reference - states)).numpy()
    kernel[:, 1:] = _density(nodes + reference - states[:, None]) * weights
    return float(np.linalg.solve(np.eye(_NODES + 1) - kernel, np.ones(_NODES + 1))[0] / 2.0)


@lru_cache(maxsize=256)
def chart_limit(kind: ChartKind, arl: float) -> float:
    """Limit of a two-sided chart whose in-control average run length is `arl` [windows].

    Raises `InputError` for an ARL of one window or less, or one that the chart cannot have.
    """
    if not (math.isfinite(arl) and arl > 1.0):
        raise InputError(f"arl: found {arl}, need a finite number of windows above 1")
    if kind == "shewhart":
        return -float(torch.special.ndtri(torch.tensor(0.5 / arl, dtype=torch.float64)))
    if kind == "ewma":
        return _solve(lambda limit: ewma_arl(limit, WEIGHT), arl)
    return _solve(lambda limit: cusum_arl(limit, ALLOWANCE), arl)


@dataclass
class Chart:
    """Two-sided charts run side by side, one per scenario and per innovation component.

    Rates of alarms add, so with `components` innovations each chart is designed for `components * arl`: the scenario
    as a whole then alarms once per `arl` windows in control (exactly for Shewhart up to 1/arl, closely for the
    others, whose run lengths are nearly geometric). `last_statistic` is what the last step compared with `edge`, kept
    before the restart of a chart that alarmed.
    """

    kind: ChartKind
    scenarios: int
    arl: float = 500.0
    components: int = 2

    def __post_init__(self) -> None:
        self.edge = chart_limit(self.kind, float(self.arl * self.components))
        if self.kind == "ewma":
            self.edge *= math.sqrt(WEIGHT / (2.0 - WEIGHT))
        self._arms = torch.zeros(self.scenarios, self.components, 2, dtype=torch.float64)
        self.last_statistic = torch.zeros(self.scenarios, self.components, dtype=torch.float64)

    def step(self, innovation: Tensor, seen: Tensor) -> Tensor:
        """Feed standardised innovations (scenario, component); returns alarms (scenario,).

        Where `seen` (scenario,) is false the chart does not advance, and no window is counted.
        """
        z = innovation.to(torch.float64)
        if self.kind == "shewhart":
            arms = torch.stack([z, -z], dim=-1)
        elif self.kind == "ewma":
            moved = (1.0 - WEIGHT) * self._arms[..., 0] + WEIGHT * z
            arms = torch.stack([moved, -moved], dim=-1)
        else:
            arms = (self._arms + torch.stack([z, -z], dim=-1) - ALLOWANCE).clamp_min(0.0)
        statistic = arms.amax(dim=-1)
        alarm = (statistic > self.edge).any(dim=-1) & seen
        self._arms = torch.where(seen[:, None, None], arms, self._arms)
        self.last_statistic = torch.where(seen[:, None], statistic, self.last_statistic)
        self.restart(alarm)
        return alarm

    def restart(self, where: Tensor) -> None:
        """Reset the scenarios in `where` (scenario,) bool to zero."""
        self._arms = torch.where(where[:, None, None], torch.zeros_like(self._arms), self._arms)

    def state_dict(self) -> dict[str, Any]:
        return {"arms": self._arms.clone(), "last_statistic": self.last_statistic.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._arms = state["arms"].clone()
        self.last_statistic = state["last_statistic"].clone()


def _density(x: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


def _solve(arl_of: Any, arl: float) -> float:
    # ARLs grow steeply with the limit: solve for the logarithm.
    high = 1.0
    while arl_of(high) < arl:
        high *= 1.5
        if high > 60.0:
            raise InputError(f"arl: found {arl}, too long a run for this chart to be designed")
    low = high
    while arl_of(low) > arl and low > 1e-6:
        low /= 2.0
    if low <= 1e-6:
        raise InputError(f"arl: found {arl}, shorter than this chart can have")
    # imported here, because it takes longer than all of this package and few need it
    from scipy.optimize import brentq

    root: Any = brentq(lambda limit: math.log(arl_of(limit) / arl), low, high, xtol=1e-10)
    return float(root)
