"""The tables of a fleet's page: what its cars have in common, whose each cause is, the ranking, and what failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

from avtorch.report.table import Table

Answer = Mapping[str, Any]
"""The object of `fleet.json`."""

COLUMNS = (
    "car",
    "rank",
    "why",
    "P(string stable)",
    "T_L [s]",
    "K_L",
    "own past",
    "siblings",
    "simulator lacks",
    "logs",
)
"""Of the ranking."""

NUMERIC = ("rank", "P(string stable)", "logs")

FAILED = 100
"""Logs without an answer that the page names; all of them are in fleet.json."""

APART = 0.05
"""Expected share of false ones among the cars that are said to differ from their siblings, as in fleet.json."""

_UNITS = {"T_L": " s", "K_L": ""}


def ranking_row(car: Answer) -> tuple[str, ...]:
    """The cells of a car, by `COLUMNS`."""
    stable, gap = car["p_string_stable"], car["gap"]
    lacks = "" if gap is None else ", ".join(gap["verdict"])
    return (
        car["car"],
        str(car["rank"]),
        car["reason"],
        "" if stable is None else f"{stable['now']:.3f}",
        *("" if car[name] is None else _interval(car[name], "mean") for name in ("T_L", "K_L")),
        _change(car["change"]),
        _siblings(car["siblings"]),
        lacks,
        str(len(car["logs"])),
    )


def report_of(car: Answer) -> str:
    """The address of the car's latest report, relative to the page; empty where none was written."""
    there = [log["report"] for log in car["logs"] if log.get("report")]
    return quote(there[-1]) if there else ""


def _change(change: Mapping[str, Any] | None) -> str:
    if change is None:
        return ""
    name, most = max(change.items(), key=lambda item: item[1]["in_sd"])
    return f"{name} {most['difference']:+.2f}{_UNITS[name]} ({most['in_sd']:.1f} SD)"


def _siblings(beside: Mapping[str, Any] | None) -> str:
    if beside is None:
        return ""
    name = min(_UNITS, key=lambda n: beside[n]["tail"])
    tail = f"tail {_small(beside[name]['tail'])}"
    return tail if beside["q_value"] > APART else f"{name} {beside[name]['ratio']:.2f} times theirs, {tail}"


def _small(p: float) -> str:
    return "<1e-12" if p < 1e-12 else f"{p:.2g}"


def _interval(q: Mapping[str, float], middle: str) -> str:
    centre, low, high = (f"{q[key]:.2f}" for key in (middle, "q05", "q95"))
    return f"{centre} ({low} to {high})"


def population_table(answer: Answer) -> Table | None:
    """What the cars have in common; None where they are too few."""
    common = answer["population"]
    if common is None:
        return None
    columns = ("quantity", "typical car (90 %)", "cars differ by (90 %)", "drives of a car differ by (90 %)")
    rows = tuple(
        (
            {"T_L": "T_L [s]", "K_L": "K_L"}[name],
            _interval(common[name]["typical"], "median"),
            _percent(common[name]["between"]),
            "not told apart: no car has two drives"
            if common[name]["within"] is None
            else _percent(common[name]["within"]),
        )
        for name in _UNITS
    )
    return Table("The model's cars", columns, rows)


def _percent(q: Mapping[str, float]) -> str:
    middle, low, high = (f"{100 * q[key]:.3g}" for key in ("median", "q05", "q95"))
    return f"{middle} % ({low} to {high})"


def cause_table(answer: Answer) -> Table | None:
    """Whose each cause is; None where no diagnosis names one."""
    columns = ("cause", "whose", "cars that have it", "cars that may have it", "share of cars (90 %)", "which cars")
    rows = tuple(
        (
            one["name"],
            one["verdict"],
            f"{one['cars']} of {one['diagnosed']}",
            f"{one['may']} of {one['diagnosed']}",
            "{:.0f} % ({:.0f} to {:.0f})".format(*(100 * one["share"][key] for key in ("mean", "q05", "q95"))),
            _some(one["of"] or ()),
        )
        for one in answer["causes"]
    )
    marked = {i for i, one in enumerate(answer["causes"]) if one["verdict"] == "the model's"}
    return Table("Causes over the fleet", columns, rows, marked=marked) if rows else None


def size_table(answer: Answer) -> Table | None:
    """How large causes are in the cars that have them; None where too few cars tell."""
    columns = ("cause", "parameter", "typical car (90 %)", "nine of ten cars", "cars", "drives")
    rows = tuple(
        (
            cause["name"],
            f"{name} [{of['unit']}]",
            "{:.3g} ({:.3g} to {:.3g})".format(*(of["typical"][key] for key in ("median", "q05", "q95"))),
            "{:.3g} to {:.3g}".format(*(of["next_car"][key] for key in ("q05", "q95"))),
            str(of["cars"]),
            str(of["drives"]),
        )
        for cause in answer["causes"]
        for name, of in cause.get("parameters", {}).items()
    )
    return Table("How large causes are", columns, rows, numeric=("cars", "drives")) if rows else None


def _some(cars: Sequence[str], most: int = 5) -> str:
    more = f" and {len(cars) - most} more" if len(cars) > most else ""
    return ", ".join(cars[:most]) + more


def stability_table(answer: Answer) -> Table:
    """Number of cars by P(string stable)."""
    known = [car["p_string_stable"]["now"] for car in answer["cars"] if car["p_string_stable"] is not None]
    edges = sorted({0.0, 0.1, 0.5, 0.9, 0.99, answer["target"]})
    rows = []
    for low, high in zip(edges, [*edges[1:], 1.0], strict=True):
        last = low == edges[-1]
        count = sum(low <= p < high or (last and p >= low) for p in known)
        rows.append((f"{low:g} to {high:g}", str(count)))
    return Table("Cars by P(string stable)", ("P(string stable)", "cars"), tuple(rows), numeric=("cars",))


def failure_table(answer: Answer) -> Table | None:
    """Logs without an answer, the first of them; None where there is none."""
    rows = [
        (log["log"], car["car"], step, why or "")
        for car in answer["cars"]
        for log in car["logs"]
        for step, why in log["errors"].items()
    ]
    return Table("Logs without an answer", ("log", "car", "step", "why"), tuple(rows[:FAILED])) if rows else None
