"""The page of a fleet: which cars to look at first, and what is the model's or one car's. It loads nothing, and all
text from logs is escaped."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from avtorch.errors import InputError, printable, quoted
from avtorch.report.page import Origin, Page, Picture, Section, fragment, picture_of, text_of, written
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

PLAIN = 200
"""Cars that are on the page also where scripts are off."""

SCHEMA = "avtorch.fleet/1"


def fleet_html(answer: Answer, *, origin: Origin | None = None) -> str:
    """The page of a fleet's `answer`, the object of `fleet.json`, as text.

    The first 200 cars are plain HTML; all of them are found, sorted and shown by a script within the page. Links to
    reports are relative: the page belongs into the folder of the fleet. Raises `InputError` for another object.
    """
    if answer.get("schema") != SCHEMA or "population" not in answer:
        raise InputError(f"answer: found {quoted(str(answer.get('schema')))}, needs the object of a fleet.json")
    cars = answer["cars"]
    more = sum(len(log["errors"]) for car in cars for log in car["logs"]) - FAILED
    reports = ("A car's name leads to the report of its latest diagnosed drive.",) if any(map(report_of, cars)) else ()
    page = Page(
        "Fleet",
        f"{many(len(cars), 'car')}, {many(answer['logs'], 'log')}, {answer['failed_logs']} of them failed",
        Section(_headline(answer), _lead(answer)),
        (
            Section(
                "What is the model's, and what is one car's",
                _whose(answer),
                (_picture(answer),),
                tables=(cause_table(answer), size_table(answer), population_table(answer)),
            ),
            Section("The cars, in the order in which to look at them", reports, more=_ranking(answer)),
            Section(
                "Logs without an answer",
                tables=(failure_table(answer),),
                soft=(f"... and {more} more in fleet.json.",) if more > 0 else (),
            ),
            Section("Method and limits", items=_method(answer)),
        ),
        "amber" if answer["reasons"].get("below target") else "green",
        text_of("fleet.js"),
    )
    return page.html(origin)


def write_fleet_page(answer: Answer, folder: str | PathLike[str], *, origin: Origin | None = None) -> Path:
    """Write `fleet.html` into `folder`; returns its path. Raises `InputError` where it cannot be written.

    Example:
        >>> from avtorch import GLVDPlant, Leader, simulate
        >>> from avtorch.fleet import FleetSettings, run_fleet
        >>> from avtorch.report import write_fleet_page
        >>> simulate(Leader.default(start=30.0, duration=20.0, dt=0.05), plant=GLVDPlant(0.4, 0.9)).log().write("a.csv")
        >>> answer = run_fleet("a.csv", "out", settings=FleetSettings(steps=("check",)), workers=1)
        >>> write_fleet_page(answer, "out").name
        'fleet.html'
    """
    return written(fleet_html(answer, origin=origin), folder, "fleet.html")


def _ranking(answer: Answer) -> Markup:
    """The table of the first cars, and all of them for the script, as JSON in which nothing can end its element."""
    cars = answer["cars"]
    cells = [[*map(printable, ranking_row(car)), report_of(car)] for car in cars]
    data = json.dumps({"columns": COLUMNS, "numeric": NUMERIC, "rows": cells}, separators=(",", ":"))
    for letter in "&<>":
        data = data.replace(letter, f"\\u{ord(letter):04x}")
    rest = f"The first {PLAIN} of {len(cars)} cars; the others need scripts, or fleet.json."
    return fragment(
        "fleet.html",
        table=ranking_table(cars[:PLAIN], links=True),
        kinds=[reason for reason, count in answer["reasons"].items() if count],
        rest=rest if len(cars) > PLAIN else "",
        data=Markup(data),
    )


def many(count: int, word: str) -> str:
    return f"{count} {word}{'s' if count != 1 else ''}"


def _headline(answer: Answer) -> str:
    known = sum(car["p_string_stable"] is not None for car in answer["cars"])
    below, target = answer["reasons"].get("below target", 0), f"P(string stable) of {answer['target']:g}"
    if not known:
        return "No car was estimated"
    of = f"{known} estimated cars" if known < len(answer["cars"]) else many(known, "car")
    if not below:
        return f"No car is below the target, a {target}; {of}"
    return f"{below} of {of} {'is' if below == 1 else 'are'} below the target, a {target}"


def _lead(answer: Answer) -> list[str]:
    found = [", ".join(f"{reason}: {count}" for reason, count in answer["reasons"].items() if count) + "."]
    first = [car for car in answer["cars"] if car["reason"] not in ("sound", "no answer")][:1]
    if first:
        found.append(f"Look first at {first[0]['car']}: {first[0]['reason']}.")
    return [*found, *answer["notes"]]


def _whose(answer: Answer) -> list[str]:
    found = []
    causes, common = answer["causes"], answer["population"]
    for verdict, words in (
        ("the model's", "Of the model, in nearly all cars: {}."),
        ("single cars'", "Of single cars: {}."),
        ("not decided", "Not decided, too few cars or neither few nor nearly all: {}."),
    ):
        names = [one["name"] for one in causes if one["verdict"] == verdict]
        if names:
            found.append(words.format(", ".join(names)))
    if not causes:
        found.append("No diagnosis names a cause." if "diagnose" in answer["steps"] else "The logs were not diagnosed.")
    if common is None:
        found.append("Cars are not compared with each other: three estimated cars or more are needed.")
        return found
    apart = sum(car["siblings"] is not None and car["siblings"]["q_value"] <= APART for car in answer["cars"])
    found.append(
        f"{many(apart, 'car') if apart else 'No car'} of {common['cars']} "
        f"{'differs' if apart <= 1 else 'differ'} from the others in T_L or K_L by more than cars of this model do."
    )
    return found


def _picture(answer: Answer) -> Picture | None:
    cars = answer["cars"]
    known = [car for car in cars if car["T_L"] is not None and car["K_L"] is not None]
    if not known or any(car["p_string_stable"] is None for car in known):
        return None
    # draws, and needs matplotlib
    from avtorch.plots.fleet import FEW, fleet_figure

    each, ranks = (", each with its 90 % intervals", "; numbers are ranks") if len(known) <= FEW else ("", "")
    caption = (
        f"First: cars by lag and gain{each}; red: below the target, orange: unlike its siblings or its own past, "
        f"blue: the others{ranks}. Second: the share of cars up to each P(string stable)."
    )
    return picture_of("fleet", fleet_figure(answer), stability_table(answer), caption=caption)


def _method(answer: Answer) -> list[str]:
    found = [
        f"Order of the cars: P(string stable) after the latest drive below {answer['target']:g}, lowest first; a log "
        "without an answer; T_L or K_L three standard deviations or more off the car's earlier drives; unlike its "
        "siblings; a cause named by its diagnosis.",
        "A car has a cause where more than half of its diagnosed drives name it; it may have it where they name one "
        "that their logs cannot tell from it. Whose it is follows from the 90 % interval of the share of all cars that "
        "have it (Jeffreys' prior): above 2/3 it is the model's; it is single cars' where that of the cars that may "
        "have it is below 1/3. Errors of the diagnoses themselves are not counted in.",
    ]
    if any(one.get("parameters") for one in answer["causes"]):
        found.append(
            "Sizes of a cause are pooled over the drives that name it, of cars that have it, in the coordinate of its "
            "prior. Drives in which it is too small to be named do not count, so that a typical car's is rather too "
            "large than too small. What belongs to a drive and not to a car, as a road does, is not pooled."
        )
    common: Any = answer["population"]
    if common is not None:
        spread = " The spread between cars includes that between drives." if common["T_L"]["within"] is None else ""
        found.append(
            "Logarithms of T_L and K_L are partially pooled: drives vary about their car, cars about their model, both "
            f"normally; the spreads are integrated over a grid.{spread}"
        )
        found.append(
            "A car is unlike its siblings where its drives lie in the tails of what the other cars alone predict, at "
            "an expected share of 5 % false ones among those named. Its tail is that probability, on both sides."
        )
    return found


# tables -----------------------------------------------------------------------------------------------------------
def ranking_row(car: Answer) -> tuple[str, ...]:
    """The cells of a car, by `COLUMNS`."""
    stable, gap = car["p_string_stable"], car["gap"]
    lacks = "" if gap is None else ", ".join(gap["verdict"])
    return (
        car["car"],
        str(car["rank"]),
        car["reason"],
        "" if stable is None else f"{stable['now']:.3f}",
        *("" if car[name] is None else _interval(car[name]) for name in ("T_L", "K_L")),
        _change(car["change"]),
        _siblings(car["siblings"]),
        lacks,
        str(len(car["logs"])),
    )


def ranking_table(cars: Sequence[Answer], *, links: bool = False) -> Table:
    """A row a car; with `links` its name leads to its report, where there is one."""
    rows = []
    for car in cars:
        name, *others = ranking_row(car)
        link = report_of(car) if links else ""
        rows.append((Markup('<a href="{}">{}</a>').format(link, printable(name)) if link else name, *others))
    return Table("Ranking of the cars", COLUMNS, tuple(rows), numeric=NUMERIC)


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
    p = beside[name]["tail"]
    tail = "tail <1e-12" if p < 1e-12 else f"tail {p:.2g}"
    return tail if beside["q_value"] > APART else f"{name} {beside[name]['ratio']:.2f} times theirs, {tail}"


def _interval(q: Mapping[str, float], form: str = ".2f") -> str:
    """A mean, or else a median, and its 90 %; by a `form` that ends with % in per cent."""
    scale, unit = (100, " %") if form.endswith("%") else (1, "")
    centre = q["mean"] if "mean" in q else q["median"]
    middle, low, high = (format(scale * x, form.rstrip("%")) for x in (centre, q["q05"], q["q95"]))
    return f"{middle}{unit} ({low} to {high})"


def population_table(answer: Answer) -> Table:
    """What the cars have in common."""
    common = answer["population"] or {}
    columns = ("quantity", "typical car (90 %)", "cars differ by (90 %)", "drives of a car differ by (90 %)")
    rows = tuple(
        (
            {"T_L": "T_L [s]", "K_L": "K_L"}[name],
            _interval(common[name]["typical"]),
            _interval(common[name]["between"], ".3g%"),
            "not told apart: no car has two drives"
            if common[name]["within"] is None
            else _interval(common[name]["within"], ".3g%"),
        )
        for name in _UNITS
        if name in common
    )
    return Table("The model's cars", columns, rows)


def cause_table(answer: Answer) -> Table:
    """Whose each cause is."""
    columns = ("cause", "whose", "cars that have it", "cars that may have it", "share of cars (90 %)", "which cars")
    rows = tuple(
        (
            one["name"],
            one["verdict"],
            f"{one['cars']} of {one['diagnosed']}",
            f"{one['may']} of {one['diagnosed']}",
            _interval(one["share"], ".0f%"),
            _some(one["of"] or ()),
        )
        for one in answer["causes"]
    )
    marked = {i for i, one in enumerate(answer["causes"]) if one["verdict"] == "the model's"}
    return Table("Causes over the fleet", columns, rows, marked=marked)


def size_table(answer: Answer) -> Table:
    """How large causes are in the cars that have them, where enough cars tell."""
    columns = ("cause", "parameter", "typical car (90 %)", "nine of ten cars", "cars", "drives")
    rows = tuple(
        (
            cause["name"],
            f"{name} [{of['unit']}]",
            _interval(of["typical"], ".3g"),
            "{:.3g} to {:.3g}".format(*(of["next_car"][key] for key in ("q05", "q95"))),
            str(of["cars"]),
            str(of["drives"]),
        )
        for cause in answer["causes"]
        for name, of in cause.get("parameters", {}).items()
    )
    return Table("How large causes are", columns, rows, numeric=("cars", "drives"))


def _some(cars: Sequence[str]) -> str:
    more = f" and {len(cars) - 5} more" if len(cars) > 5 else ""
    return ", ".join(cars[:5]) + more


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


def failure_table(answer: Answer) -> Table:
    """Logs without an answer, the first of them."""
    rows = [
        (log["log"], car["car"], step, why or "")
        for car in answer["cars"]
        for log in car["logs"]
        for step, why in log["errors"].items()
    ]
    return Table("Logs without an answer", ("log", "car", "step", "why"), tuple(rows[:FAILED]))
