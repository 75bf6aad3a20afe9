"""The ratio of two simulators' errors, with the spread that it has between blocks of the drives.

Let `s_b` and `t_b` be the shares of block `b` in the squared errors S and T of the two. The logarithm of the ratio of
the root mean squares, log(T / S) / 2, moves by `(t_b - s_b) / 2` with the weight of block `b`. Over n blocks it thus
has the variance

    n / (n - 1) Σ_b ((t_b - s_b) / 2)²

(the linearised jackknife), and Student's t of n - 1 degrees. Channels count alike: their logarithms are averaged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.drive_record import FEWEST_BLOCKS, Record, blocks_of
from avtorch.gap.quantity import Quantity
from avtorch.gap.rollout_errors import HORIZON_S, block_squares, reached

_LEAST = 1e-9  # m/s² or m/s: an error, so that simulators without any have a ratio


@dataclass(frozen=True, eq=False)
class LogRatio:
    """Logarithm of a ratio: `mean`, and what each block adds to it, `by_block` (block,), in the sum zero.

    Example:
        >>> import numpy as np
        >>> from avtorch.external.scored_blocks import LogRatio
        >>> told = LogRatio(-0.1, 0.02 * np.array([-1, 1, -1, 1, -1, 1]))
        >>> round(told.sd, 3), round(told.p_below(1.0), 3), round(told.ratio.mean, 2)
        (0.054, 0.939, 0.9)
    """

    mean: float
    by_block: FloatArray

    def __add__(self, other: LogRatio) -> LogRatio:
        return LogRatio(self.mean + other.mean, self.by_block + other.by_block)

    def __sub__(self, other: LogRatio) -> LogRatio:
        return self + -1.0 * other

    def __rmul__(self, factor: float) -> LogRatio:
        return LogRatio(factor * self.mean, factor * self.by_block)

    @property
    def sd(self) -> float:
        """Standard deviation, by the spread between blocks."""
        n = len(self.by_block)
        return float(np.sqrt(n / (n - 1) * (self.by_block**2).sum()))

    @property
    def ratio(self) -> Quantity:
        """The ratio itself."""
        sure = float(student.ppf(0.95, len(self.by_block) - 1))  # pyright: ignore[reportUnknownMemberType]
        return Quantity.of_logarithm(self.mean, self.sd**2, sure)

    def p_below(self, limit: float) -> float:
        """Probability that the ratio is below `limit`."""
        away = float(np.log(limit)) - self.mean
        if self.sd == 0:
            return float(away > 0)
        return float(student.cdf(away / self.sd, len(self.by_block) - 1))  # pyright: ignore[reportUnknownMemberType]


@dataclass(frozen=True, eq=False)
class ScoredBlocks:
    """`blocks` of a record, by which rollouts of `horizon_s` [s] are scored.

    Example:
        >>> import numpy as np
        >>> from avtorch import Leader, simulate
        >>> from avtorch.external.scored_blocks import ScoredBlocks
        >>> from avtorch.gap.drive_record import Record
        >>> record = Record.of(simulate(Leader.default(start=30.0, duration=60.0, dt=0.05)).log())
        >>> scored = ScoredBlocks.of(record)
        >>> errors = np.random.default_rng(0).normal(size=record.measured.shape)
        >>> one, two = (scored.squares(x, 0.3) for x in (errors, 2 * errors))
        >>> round(scored.log_ratio(one, two).ratio.mean, 6)
        2.0
    """

    record: Record = field(repr=False)
    blocks: tuple[slice, ...]
    horizon_s: float

    @classmethod
    def of(cls, record: Record) -> ScoredBlocks:
        """Those of a record. Raises `InputError` for less than five."""
        blocks = tuple(blocks_of(record, fewest=FEWEST_BLOCKS))
        if len(blocks) < FEWEST_BLOCKS:
            raise InputError(
                f"logs: found {len(blocks)} blocks of 4 s of usable driving, needs {FEWEST_BLOCKS} or more"
            )
        return cls(record, blocks, reached(record, HORIZON_S))

    def squares(self, errors: FloatArray, lag: float) -> dict[str, FloatArray]:
        """Squared errors by metric (block,), of a long rollout's `errors` (channel, counted, group); `lag` [s] of its
        actuator."""
        least = _LEAST**2 * self._rows
        return {
            name: np.maximum(x, least)
            for name, x in block_squares(self.record, errors, self.blocks, lag, self.horizon_s).items()
        }

    def log_ratio(self, one: Mapping[str, FloatArray], two: Mapping[str, FloatArray]) -> LogRatio:
        """Of the errors of `two` to those of `one`, squares (block,) by metric; the mean over the metrics."""
        mean = float(np.mean([np.log(two[m].sum() / one[m].sum()) / 2 for m in one]))
        return LogRatio(mean, np.mean([(two[m] / two[m].sum() - one[m] / one[m].sum()) / 2 for m in one], 0))

    def error(self, squares: FloatArray) -> Quantity:
        """Root mean square of errors, squares (block,)."""
        rows = self._rows
        share = (squares / squares.sum() - rows / rows.sum()) / 2
        return LogRatio(float(np.log(squares.sum() / rows.sum())) / 2, share).ratio

    @property
    def _rows(self) -> FloatArray:
        return np.array([(b.stop - b.start) * self.record.group for b in self.blocks], dtype=float)
