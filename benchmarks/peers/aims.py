"""The aims in speed, each with its figure and its verdict."""

from __future__ import annotations

from typing import Any

from benchmarks.peers.single import Row

#: For one window: the factor by which avtorch is to be faster. Peers in two forms are compared in both.
PEERS_TO_BEAT = (
    ("blackjax-nuts-stan", 10),
    ("blackjax-nuts", 10),
    ("blackjax-sgld", 2),
    ("blackjax-sgld-plain", 2),
)


def aims(one: list[Row], many: list[Row], growth: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """``(aim, figure, met or missed)``; an aim whose rows are not there is left out."""
    single = {row.method: row for row in one if not row.why}
    batch = {row.method: row for row in many if not row.why}
    found: list[tuple[str, str, str]] = []

    def at_least(aim: str, value: float, wanted: float) -> None:
        found.append((aim, f"{value:.3g} x", "met" if value >= wanted else "MISSED"))

    own = single.get("avtorch")
    if own is not None:
        # to equal ESS: the default settings give more draws than needed, so the row with fewer chains counts where
        # present
        matched = single.get("avtorch-matched", own)
        for name, factor in PEERS_TO_BEAT:
            if name in single:
                peer = single[name]
                aim = f"one window: {factor} times faster than {peer.title}"
                at_least(aim, peer.seconds_wanted / matched.seconds_wanted, factor)
        if "conjugate" in single:
            limit = single["conjugate"]
            at_least(
                "one window: ESS per second at least half of conjugate + importance resampling",
                (own.bulk / own.seconds) / (limit.bulk / limit.seconds),
                0.5,
            )
        aim = "no ten-second compile for one log: what the first call takes more"
        found.append((aim, f"{own.first_s:.2f} s", "met" if own.first_s < 10 else "MISSED"))
    own = batch.get("avtorch")
    if own is not None:
        matched = batch.get("avtorch-matched", own)
        for name in ("blackjax-nuts-stan", "blackjax-nuts"):
            if name in batch:
                aim = f"{own.windows} windows: 100 times cheaper a window than vmapped {batch[name].title}"
                at_least(aim, batch[name].seconds_wanted / matched.seconds_wanted, 100)
        if "conjugate" in batch:
            limit = batch["conjugate"]
            aim = f"{own.windows} windows: ESS per second at least half of conjugate + importance resampling"
            at_least(aim, (own.bulk / own.seconds) / (limit.bulk / limit.seconds), 0.5)
    if growth is not None:
        first, last = growth["points"][0], growth["points"][-1]
        ratio = (last["mode_s"] + last["sampling_s"]) / (first["mode_s"] + first["sampling_s"])
        found.append(
            (
                f"{last['points']:,} points: one pass, and then no more than {first['points']:,} points cost",
                f"{ratio:.2f} x after the pass",
                "met" if ratio <= 1.25 else "MISSED",
            )
        )
    return found
