"""The aims in speed, each with its figure and its verdict."""

from __future__ import annotations

from typing import Any

from benchmarks.peers.single import Row

#: The factor by which avtorch is to be faster, and the aim in words: for one window, and for many at once.
PEERS_TO_BEAT = (
    ("blackjax-nuts-stan", 20, "faster than BlackJAX NUTS, Stan's warm-up"),
    ("blackjax-nuts", 8, "faster than BlackJAX NUTS, tuned"),
)
PEERS_TO_BEAT_AT_ONCE = (
    ("blackjax-nuts-stan", 100, "cheaper than vmapped BlackJAX NUTS, Stan's warm-up"),
    ("blackjax-nuts", 60, "cheaper than vmapped BlackJAX NUTS, tuned"),
    ("blackjax-nuts-whitened", 3, "cheaper than NUTS given our whitening"),
)
#: How many times the exact sampler's time one window may take.
TIMES_CONJUGATE = 1.5


def aims(one: list[Row], many: list[Row], growth: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """``(aim, figure, met or missed)``; an aim whose rows are not there is left out."""
    single = {row.method: row for row in one if not row.why}
    batch = {row.method: row for row in many if not row.why}
    found: list[tuple[str, str, str]] = []

    def told(aim: str, figure: str, met: bool) -> None:
        found.append((aim, figure, "met" if met else "MISSED"))

    def faster(rows: dict[str, Row], peers: tuple[tuple[str, int, str], ...], windows: str) -> None:
        # to equal ESS: the default settings give more draws than needed, so the row with fewer chains counts where
        # present
        own = rows.get("avtorch-matched", rows["avtorch"])
        for name, factor, words in peers:
            if name in rows:
                times = rows[name].seconds_wanted / own.seconds_wanted
                told(f"{windows}: {factor} times {words}", f"{times:.3g} x", times >= factor)

    if "avtorch" in single:
        faster(single, PEERS_TO_BEAT, "one window")
        if "conjugate" in single:
            own = single.get("avtorch-matched", single["avtorch"])
            times = own.seconds_wanted / single["conjugate"].seconds_wanted
            told(
                f"one window: no slower than conjugate + importance resampling times {TIMES_CONJUGATE}",
                f"{times:.3g} times its time",
                times <= TIMES_CONJUGATE,
            )
        first_s = single["avtorch"].first_s
        told("no ten-second compile for one log: what the first call takes more", f"{first_s:.2f} s", first_s < 10)
    if "avtorch" in batch:
        faster(batch, PEERS_TO_BEAT_AT_ONCE, f"{batch['avtorch'].windows} windows")
    if growth is not None:
        first, last = growth["points"][0], growth["points"][-1]
        ratio = (last["mode_s"] + last["sampling_s"]) / (first["mode_s"] + first["sampling_s"])
        told(
            f"{last['points']:,} points: one pass, and then no more than {first['points']:,} points cost",
            f"{ratio:.2f} x after the pass",
            ratio <= 1.25,
        )
    return found
