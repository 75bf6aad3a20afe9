"""A row of the reproduction: the paper's claim, our result, and a verdict by a rule that is stated once.

Rules, in order; an interval is the 90 % one:

- `error`: the paper's one error against the median over runs. *better*: the interval of the median lies below it;
  *same*: the interval holds it; else *not reproduced*.
- `sign`: the paper claims that a quantity lies above (or below) a value. *same*: so does the whole interval.
- `share`: the paper claims that something happens. *same*: it does in at least 95 % of runs (or of the units counted).
- `within`: the paper's claim holds where the figure lies between two bounds. *same*: it does.

*better* also holds for a setting that achieves what the printed setting of the same strategy does not (`strategies`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

ClaimVerdict = Literal["same", "better", "not reproduced"]

MOST = 0.95
"""An event that the paper claims must happen in this share of runs."""

_RESAMPLED = 1000


@dataclass(frozen=True)
class ClaimRow:
    """`paper` and `ours` are numbers or a few words; `interval` is 90 %, None where nothing is random."""

    name: str
    setting: str
    quantity: str
    paper: float | str
    ours: float | str
    interval: tuple[float, float] | None
    verdict: ClaimVerdict
    why: str

    def as_dict(self) -> dict[str, Any]:
        out = asdict(self)
        return out | {"interval": None if self.interval is None else list(self.interval)}


def error(paper: float, interval: tuple[float, float]) -> ClaimVerdict:
    """The rule `error`."""
    if interval[1] < paper:
        return "better"
    return "same" if interval[0] <= paper else "not reproduced"


def sign(found: float | tuple[float, float], *, above: float | None = None, below: float | None = None) -> ClaimVerdict:
    """The rule `sign`; `found` is an interval, or a number where nothing is random."""
    low, high = found if isinstance(found, tuple) else (found, found)
    return "same" if (above is None or low > above) and (below is None or high < below) else "not reproduced"


def share(value: float, least: float = MOST) -> ClaimVerdict:
    """The rule `share`."""
    return "same" if value >= least - 1e-9 else "not reproduced"


def within(value: float, low: float, high: float) -> ClaimVerdict:
    """The rule `within`."""
    return "same" if low <= value <= high else "not reproduced"


def middle(values: Tensor, dim: int = -1) -> Tensor:
    """The median over `dim`; of an even number of runs the mean of the two in the middle."""
    return torch.quantile(values.double(), 0.5, dim=dim)


def spread(values: Tensor) -> tuple[float, float]:
    """The central 90 % of the runs, `values` (run,)."""
    low, high = torch.quantile(values.double(), torch.tensor([0.05, 0.95], dtype=torch.float64)).tolist()
    return low, high


def bootstrap_runs(runs: int, seed: int, times: int = _RESAMPLED) -> Tensor:
    """Runs drawn with replacement, (times, run): the bootstrap behind every interval of a median or share.

    Whole runs are drawn, because everything within a run shares its noise.
    """
    return torch.randint(runs, (times, runs), generator=torch.Generator().manual_seed(seed))


def median_interval(values: Tensor, seed: int) -> tuple[float, float]:
    """90 % interval of the median of `values` (run,)."""
    return spread(middle(values[bootstrap_runs(len(values), seed)]))


def number_list(numbers: Sequence[float]) -> str:
    """`0.1, 0.2 and 0.3`."""
    texts = [f"{x:g}" for x in numbers]
    return texts[0] if len(texts) == 1 else ", ".join(texts[:-1]) + " and " + texts[-1]
