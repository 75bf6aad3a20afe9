"""The page of a fleet: which cars to look at first, and what is the model's or one car's. It loads nothing, and all
text from logs is escaped."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from avtorch.errors import InputError, printable, quoted
from avtorch.io import atomic
from avtorch.report.fleet_entries import (
    APART,
    COLUMNS,
    FAILED,
    NUMERIC,
    Answer,
    cause_table,
    failure_table,
    population_table,
    ranking_row,
    report_of,
    size_table,
    stability_table,
)
from avtorch.report.house import page_of, text_of
from avtorch.report.origin import Origin

if TYPE_CHECKING:
    from avtorch.report.picture import Picture

PLAIN = 200
"""Cars that are on the page also where scripts are off."""

SCHEMA = "avtorch.fleet/1"


def fleet_html(answer: Answer, *, origin: Origin | None = None) -> str:
    """The page of a fleet's `answer`, the object of `fleet.json`, as text.

    The first 200 cars are plain HTML; all of them are found, sorted and shown by a script within the page. Links to
    reports are relative: the page belongs into the folder of the fleet. Raises `InputError` for another object.

    Example:
        >>> from avtorch.report import fleet_html
        >>> car = {"rank": 1, "car": "red", "reason": "sound", "p_string_stable": {"now": 0.99, "lowest": 0.97}}
        >>> car |= dict.fromkeys(("T_L", "K_L", "change", "siblings", "gap")) | {"logs": []}
        >>> answer = {"schema": "avtorch.fleet/1", "target": 0.9, "logs": 1, "failed_logs": 0, "cars": [car]}
        >>> answer |= {"notes": [], "reasons": {"sound": 1}, "population": None, "causes": [], "steps": ["estimate"]}
        >>> "No car is below the target" in fleet_html(answer)
        True
    """
    if answer.get("schema") != SCHEMA or "population" not in answer:
        raise InputError(f"answer: found {quoted(str(answer.get('schema')))}, needs the object of a fleet.json")
    cars = answer["cars"]
    rows = [(ranking_row(car), report_of(car)) for car in cars]
    failures = failure_table(answer)
    failed = sum(len(log["errors"]) for car in cars for log in car["logs"])
    rest = (
        f"The first {PLAIN} of {len(cars)} cars; the others need scripts, or fleet.json." if len(cars) > PLAIN else ""
    )
    return page_of(
        "fleet.html",
        origin=origin,
        script=text_of("fleet.js"),
        more_style=Markup(text_of("fleet.css")),
        headline=_headline(answer),
        tone="amber" if answer["reasons"].get("below target") else "green",
        counted=f"{_many(len(cars), 'car')}, {_many(answer['logs'], 'log')}, {answer['failed_logs']} of them failed",
        lead=_lead(answer),
        whose=_whose(answer),
        causes=cause_table(answer),
        sizes=size_table(answer),
        population=population_table(answer),
        picture=_picture(answer),
        any_report=any(link for _, link in rows),
        rest=rest,
        kinds=[reason for reason, count in answer["reasons"].items() if count],
        columns=COLUMNS,
        numeric=NUMERIC,
        first=rows[:PLAIN],
        failures=failures,
        more_failures=max(0, failed - FAILED),
        method=_method(answer),
        data=_data(rows),
    )


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
    path = Path(folder) / "fleet.html"
    text = fleet_html(answer, origin=origin)
    with atomic(path) as stream:
        stream.write(text)
    return path


def _data(rows: list[tuple[tuple[str, ...], str]]) -> Markup:
    """For the script, as JSON in which nothing can end the element that holds it."""
    cells = [[*(printable(cell) for cell in row), link] for row, link in rows]
    text = json.dumps({"columns": COLUMNS, "numeric": NUMERIC, "rows": cells}, separators=(",", ":"))
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _many(count: int, word: str) -> str:
    return f"{count} {word}{'s' if count != 1 else ''}"


def _headline(answer: Answer) -> str:
    known = sum(car["p_string_stable"] is not None for car in answer["cars"])
    below, target = answer["reasons"].get("below target", 0), f"P(string stable) of {answer['target']:g}"
    if not known:
        return "No car was estimated"
    of = f"{known} estimated cars" if known < len(answer["cars"]) else _many(known, "car")
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
    for one in causes:
        for name, of in one.get("parameters", {}).items():
            if not of["converged"]:
                found.append(f"How far {one['name']} differs in {name} is not to be relied on: {of['why']}.")
    if not causes:
        found.append("No diagnosis names a cause." if "diagnose" in answer["steps"] else "The logs were not diagnosed.")
    if common is None:
        found.append("Cars are not compared with each other: three estimated cars or more are needed.")
        return found
    apart = sum(car["siblings"] is not None and car["siblings"]["q_value"] <= APART for car in answer["cars"])
    found.append(
        f"{_many(apart, 'car') if apart else 'No car'} of {common['cars']} "
        f"{'differs' if apart <= 1 else 'differ'} from the others in T_L or K_L by more than cars of this model do."
    )
    for name in ("T_L", "K_L"):
        if not common[name]["converged"]:
            found.append(f"The spread of {name} is not to be relied on: {common[name]['why']}.")
    return found


def _picture(answer: Answer) -> Picture | None:
    cars = answer["cars"]
    known = [car for car in cars if car["T_L"] is not None and car["K_L"] is not None]
    if not known or any(car["p_string_stable"] is None for car in known):
        return None
    # these draw, and need matplotlib
    from avtorch.plots.fleet import FEW, fleet_figure
    from avtorch.report.picture import Picture, inline_svg

    ends = {name: [f(car[name]["mean"] for car in known) for f in (min, max)] for name in ("T_L", "K_L")}
    below = sum(car["p_string_stable"]["now"] < answer["target"] for car in known)
    says = (
        f"{_many(len(known), 'car')}: T_L {ends['T_L'][0]:.2f} to {ends['T_L'][1]:.2f} s, "
        f"K_L {ends['K_L'][0]:.2f} to {ends['K_L'][1]:.2f}. Beside it the share of cars up to each P(string stable): "
        f"{below} are below the target of {answer['target']:g}."
    )
    each = "each with its 90 % intervals" if len(known) <= FEW else "a square's area is its number of cars"
    ranks = "; numbers are ranks" if len(known) <= FEW else ""
    caption = (
        f"First: cars by lag and gain, {each}; red: below the target, orange: unlike its siblings or its own past, "
        f"blue: the others{ranks}. Second: the share of cars up to each P(string stable)."
    )
    wide, narrow = (
        inline_svg(f"fleet-{kind}", fleet_figure(answer, narrow=kind == "narrow"), says) for kind in ("wide", "narrow")
    )
    return Picture(wide, narrow, says, caption, (stability_table(answer),))


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
            f"normally; the spreads are sampled by SGLD over {_many(common['sampled_cars'], 'car')}.{spread}"
        )
        found.append(
            "A car is unlike its siblings where its drives lie in the tails of what the other cars alone predict, at "
            "an expected share of 5 % false ones among those named. Its tail is that probability, on both sides."
        )
    return found
