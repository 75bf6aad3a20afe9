r"""A force map: what a car does with a command beyond K u, as a curve over command and speed.

    F(u, v) = K u + sum_ij h_i(u) g_j(v) f_ij,        f ~ N(0, (z A)^2 C),
    C = 1 + v v' + k(v) + k(u) + k(u) k(v) / 2

h and g are hats on knots, k is the Matern-3/2 kernel of length one standard deviation of what was driven, A the
standard deviation of the acceleration, z a relative size (Rasmussen and Williams 2006, 2 and 4.2). C has no
term linear in u: what is linear is K's. Where nothing was driven the curve goes back to K u. Without its last two terms
C is that of a resistance R(v).

Low rank: with L L' = C and B the hats of all rows, the eigenvectors of L' (B'B / n) L are curves with independent unit
priors, in the order of how much of the drive sees them. Those that hardly any row sees are left out, and with them the
knots that nobody visited.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.priors import FAINT_MAP, MAP_SIZE

RESISTANCES = ("aerodynamic_drag", "viscous_drag", "constant_resistance", "low_speed_creep")
"""Effects that are a curve over the speed."""
CURVES = (*RESISTANCES, "dead_band", "saturation", "brake_throttle_asymmetry", "speed_dependent_gain")
"""Effects that are a map, or make another map of one: beside a map they have no name of their own."""
MAP_SIZES = np.geomspace(FAINT_MAP, 32 * FAINT_MAP, 6)
"""Relative sizes z that are tried [-]: doublings."""
_U_QUANTILES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)  # of what was driven; the outer knots at its ends
_V_QUANTILES = (0.0, 0.1, 0.35, 0.65, 0.9, 1.0)
_APART = 0.1  # standard deviations between knots, least
_SPEED_SPAN_MPS = 2.0  # least distance of the outer knots at which a dependence on speed is a question at all
_SEEN = 1e-4  # mean square of a curve over the driven rows, relative to the most, below which it is left out
_SLACK = 1e-9  # on the diagonal of C, for its root


@dataclass(frozen=True, eq=False)
class ForceMap:
    """Force beyond K u: `table` (u, v) [m/s²] at `knots_u` (u,) [m/s²] and `knots_v` (v,) [m/s], linear between knots
    and held outside; `size` [m/s²], the standard deviation of its prior's scale."""

    knots_u: FloatArray
    knots_v: FloatArray
    table: FloatArray
    size: float

    def __call__(self, command: FloatArray, speed: FloatArray) -> FloatArray:
        """Force (row,) [m/s²] at commands (row,) [m/s²] and speeds (row,) [m/s]."""
        i, p = _place(command, self.knots_u)
        j, q = _place(speed, self.knots_v)
        right, up = np.minimum(i + 1, len(self.knots_u) - 1), np.minimum(j + 1, len(self.knots_v) - 1)
        low = (1 - q) * self.table[i, j] + q * self.table[i, up]
        high = (1 - q) * self.table[right, j] + q * self.table[right, up]
        return (1 - p) * low + p * high


@dataclass(frozen=True, eq=False)
class MapForm:
    """The curves that a force map is made of: `tables` (curve, u, v) and `demands` (curve, row), both in m/s² at a
    coefficient of one.

    A coefficient has the prior N(0, `size`²), of which `size_nats` is the log evidence of all sizes over this one.
    `name`: "F(u, v)", or "R(v)" without a dependence on the command. `scale` [m/s²]: A.
    """

    name: str
    knots_u: FloatArray = field(repr=False)
    knots_v: FloatArray = field(repr=False)
    tables: FloatArray = field(repr=False)
    demands: FloatArray = field(repr=False)
    scale: float
    size: float = MAP_SIZE[0]
    size_nats: float = 0.0

    @property
    def takes_up(self) -> tuple[str, ...]:
        """Effects that are among its curves."""
        return RESISTANCES if self.name == "R(v)" else CURVES

    @property
    def count(self) -> int:
        return len(self.tables)

    def of_size(self, size: float, nats: float = 0.0) -> MapForm:
        """The same form with another prior size."""
        return replace(self, size=size, size_nats=nats)

    def force_map(self, coefficients: FloatArray) -> ForceMap:
        """The map at some coefficients (curve,)."""
        table = np.tensordot(coefficients, self.tables, 1)
        return ForceMap(self.knots_u, self.knots_v, table, self.size * self.scale)

    @cached_property
    def gram(self) -> FloatArray:
        """Mean products (curve, curve) [(m/s²)²] of the demands over the rows."""
        return self.demands @ self.demands.T / self.demands.shape[1]


def size_log_prior() -> FloatArray:
    """Log prior (size,) of each of `MAP_SIZES`: log-normal; a map as faint as `FAINT_MAP` is none."""
    middle, spread = MAP_SIZE
    log = -0.5 * (np.log(MAP_SIZES / middle) / spread) ** 2 - (FAINT_MAP / MAP_SIZES) ** 2
    return log - np.log(np.exp(-0.5 * (np.log(MAP_SIZES / middle) / spread) ** 2).sum())


def map_forms(data: DriveData) -> list[MapForm]:
    """The forms of a map on these drives, the simpler one first. None where the speed is not known."""
    if data.speed is None:
        return []
    u, v = data.command, data.smooth_speed
    rates = np.diff(v)[~data.starts[1:]] / data.dt
    scale = float(rates.std())
    if not (scale > 0 and u.std() > 0):
        return []
    knots_u, knots_v = _knots(u, _U_QUANTILES), _knots(v, _V_QUANTILES)
    if knots_v[-1] - knots_v[0] < _SPEED_SPAN_MPS:
        knots_v = np.array([float(v.mean())])
    hats_u, hats_v = _hats(u, knots_u), _hats(v, knots_v)
    a, b = (_scaled(knots, x) for knots, x in ((knots_u, u), (knots_v, v)))
    of_u, of_v = _matern(a), _matern(b)
    along = 1.0 + np.outer(b, b) + (of_v if len(b) > 1 else 0.0)
    whole = np.ones((len(a), len(a)))
    forms = []
    if len(b) > 1:
        ends = knots_u[[0, -1]]
        forms.append(_form("R(v)", ends[:1], knots_v, along, np.ones((len(u), 1)), hats_v, scale))
    covariance = np.kron(whole, along) + np.kron(of_u, np.ones((len(b), len(b))))
    if len(b) > 1:
        covariance = covariance + 0.5 * np.kron(of_u, of_v)
    forms.append(_form("F(u, v)", knots_u, knots_v, covariance, hats_u, hats_v, scale))
    return [form for form in forms if form.count]


# inside ---------------------------------------------------------------------------------------------------------------
def _form(
    name: str,
    knots_u: FloatArray,
    knots_v: FloatArray,
    covariance: FloatArray,
    hats_u: FloatArray,
    hats_v: FloatArray,
    scale: float,
) -> MapForm:
    """The curves under a prior `covariance` (u v, u v) of values at knots."""
    root = np.linalg.cholesky(covariance + _SLACK * np.trace(covariance) / len(covariance) * np.eye(len(covariance)))
    B = (hats_u[:, :, None] * hats_v[:, None, :]).reshape(len(hats_u), -1)
    seen, turn = np.linalg.eigh(root.T @ (B.T @ B / len(B)) @ root)
    kept = seen > _SEEN * seen.max()
    values = scale * (root @ turn[:, kept][:, ::-1])  # knot, curve
    tables = values.T.reshape(-1, len(knots_u), len(knots_v))
    return MapForm(name, knots_u, knots_v, tables, np.ascontiguousarray((B @ values).T), scale)


def _knots(x: FloatArray, quantiles: tuple[float, ...]) -> FloatArray:
    """Knots (knot,) at quantiles of `x`, both ends among them, with some distance between them."""
    at, least = np.quantile(x, quantiles), _APART * float(x.std())
    kept = [float(at[0])]
    for value in at[1:-1].tolist():
        if value - kept[-1] > least and at[-1] - value > least:
            kept.append(value)
    return np.array([*kept, float(at[-1])]) if at[-1] > at[0] else np.array(kept)


def _scaled(knots: FloatArray, x: FloatArray) -> FloatArray:
    return (knots - np.median(x)) / max(float(x.std()), 1e-9)


def _matern(x: FloatArray) -> FloatArray:
    """Matern-3/2 covariance (knot, knot) of length one."""
    far = np.sqrt(3.0) * np.abs(x[:, None] - x)
    return (1.0 + far) * np.exp(-far)


def _place(x: FloatArray, knots: FloatArray) -> tuple[np.ndarray, FloatArray]:
    """The knot (row,) below each value, and the share (row,) of the way to the next one."""
    if len(knots) == 1:
        return np.zeros(len(x), np.int64), np.zeros(len(x))
    x = np.clip(x, knots[0], knots[-1])
    i = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    return i, (x - knots[i]) / (knots[i + 1] - knots[i])


def _hats(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Piecewise linear weights (row, knot) that sum to one."""
    i, share = _place(x, knots)
    out, rows = np.zeros((len(x), len(knots))), np.arange(len(x))
    out[rows, i] = 1.0 - share
    if len(knots) > 1:
        out[rows, i + 1] += share
    return out
