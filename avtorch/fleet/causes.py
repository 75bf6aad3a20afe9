"""Causes over the fleet: which are the model's, and which are single cars'.

A car has a cause where more than half of its diagnosed drives name it. Of `have` cars among `diagnosed`, the share of
all such cars has the belief Beta(have + 1/2, diagnosed - have + 1/2), from Jeffreys' prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

COMMON, SINGLE = 2 / 3, 1 / 3
"""The model's: the 90 % interval of the share of cars is above the first. Single cars': below the second."""

VERDICTS = ("the model's", "single cars'", "not decided")

Diagnosed = Mapping[str, Any]
"""A drive's `named` causes, and those `alike`, which its log cannot tell from them."""


def car_causes(drives: Sequence[Diagnosed]) -> tuple[list[str], list[str]]:
    """The causes that a car has by most of its drives, and those that it may have instead of them."""
    return _mostly(drives, "named"), _mostly(drives, "alike")


def _mostly(drives: Sequence[Diagnosed], key: str) -> list[str]:
    names = {name for drive in drives for name in drive[key]}
    return sorted(name for name in names if 2 * sum(name in drive[key] for drive in drives) > len(drives))


def fleet_causes(cars: Mapping[str, tuple[Sequence[str], Sequence[str]]]) -> list[dict[str, Any]]:
    """The causes that some car has, the most common first: how many cars, the share's interval, and whose it is.

    `cars`: of each diagnosed car what `car_causes` returns. A cause is single cars' only if those that may have it in
    place of another are few as well.
    """
    count = len(cars)
    found = []
    for name in sorted({n for named, _ in cars.values() for n in named}):
        have = [car for car, (named, _) in cars.items() if name in named]
        may = sum(name in {*named, *alike} for named, alike in cars.values())
        share, most = _share(len(have), count), _share(may, count)
        verdict = "not decided"
        if share["q05"] > COMMON:
            verdict = "the model's"
        elif most["q95"] < SINGLE:
            verdict = "single cars'"
        one: dict[str, Any] = {"name": name, "cars": len(have), "may": may, "diagnosed": count, "share": share}
        found.append(one | {"verdict": verdict, "of": have if verdict == "single cars'" else None})
    return sorted(found, key=lambda one: (-one["cars"], one["name"]))


def _share(have: int, count: int) -> dict[str, float]:
    from scipy.special import betaincinv

    a, b = have + 0.5, count - have + 0.5
    return {"mean": a / (a + b), "q05": float(betaincinv(a, b, 0.05)), "q95": float(betaincinv(a, b, 0.95))}
