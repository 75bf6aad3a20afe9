"""What a search tried, and what it did not."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.observability import is_observable

Pairs = Literal["all", "some", "none", "lost"]


@dataclass(frozen=True)
class Scope:
    """What a search tried: names of single effects `scored` and `not_scored`, and which `pairs`.

    `not_scored`: effects excluded by the budget or by the user. `pairs`: "all" that screening selected, "some" before
    the budget ended, "none", or "lost": none, as the likelihood could no longer give the answer.
    """

    scored: tuple[str, ...] = ()
    not_scored: tuple[str, ...] = ()
    pairs: Pairs = "all"

    @classmethod
    def of(
        cls,
        effects: Sequence[type[Effect]],
        tried: Collection[str],
        channels: Collection[str],
        pairs: Pairs,
    ) -> Self:
        """The scope of a search among `effects`, limited to those observable in `channels`; `tried`: by name."""
        own = {e.name: e for e in effects}
        kinds = own | {n: e for n, e in EFFECTS.items() if n not in own}
        names = [n for n, e in kinds.items() if is_observable(e, channels)]
        return cls(tuple(n for n in names if n in tried), tuple(n for n in names if n not in tried), pairs)

    @property
    def whole(self) -> bool:
        """Whether every hypothesis was tried."""
        return not self.not_scored and self.pairs in ("all", "lost")

    def to_dict(self) -> dict[str, Any]:
        return {"effects": list(self.not_scored), "pairs": self.pairs}
