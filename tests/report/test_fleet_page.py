"""The page of a fleet: complete, small, self-contained, and safe against markup in names."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from pathlib import Path

import pytest

from avtorch.errors import InputError
from avtorch.report import Origin, write_fleet_page
from avtorch.report.fleet import PLAIN, fleet_html
from tests.report.conftest import HOSTILE
from tests.report.fleets import answer_of
from tests.report.tree import Element, read


@pytest.fixture(scope="module")
def text() -> str:
    return fleet_html(answer_of(10), origin=Origin("avtorch fleet logs --out out"))


@pytest.fixture(scope="module")
def page(text: str) -> Element:
    return read(text)


def ranking(page: Element) -> list[Element]:
    (table,) = (t for t in page.all("table") if t.attributes.get("id") == "ranking")
    return list(next(table.all("tbody")).all("tr"))


def test_it_says_which_cars_whose_causes_and_what_failed(text: str, page: Element) -> None:
    assert next(page.all("h1")).text() == "9 of 10 cars are below the target, a P(string stable) of 0.9"
    titles = [heading.text() for heading in page.all("h2")]
    assert titles[:3] == [
        "What is the model's, and what is one car's",
        "The cars, in the order in which to look at them",
        "Logs without an answer",
    ]
    for words in ("Of the model, in nearly all cars: late.", "Of single cars: steep.", "1 car of 10 differs"):
        assert words in text
    assert "T_L 1.80 times theirs, tail 1e-05" in text
    assert text.count("times theirs") == 2, "of the car that is unlike its siblings alone, in HTML and for the script"
    assert "avtorch fleet logs --out out" in text
    (sizes,) = (t for t in page.all("table") if next(t.all("caption")).text() == "How large causes are")
    (row,) = next(sizes.all("tbody")).all("tr")
    assert [cell.text() for cell in row.inside] == [
        *("late", "delay_s [s]", "0.35 (0.3 to 0.4)", "0.25 to 0.45", "10", "20")
    ]
    assert len(ranking(page)) == 10
    (table,) = (t for t in page.all("table") if t.attributes.get("id") == "ranking")
    titles = [th.text() for th in next(table.all("thead")).all("th")]
    first = [cell.text() for cell in ranking(page)[0].inside]
    shown = dict(zip(titles, first, strict=True))
    assert (shown["car"], shown["rank"], shown["why"], shown["simulator lacks"]) == (
        "car 1",
        "1",
        "below target",
        "late",
    )
    (svg,) = page.all("svg")
    assert "P(string stable)" in svg.attributes["aria-label"]


def test_a_hostile_name_is_text_in_html_and_in_the_data(text: str, page: Element) -> None:
    scripts = list(page.all("script"))
    assert len(scripts) == 2
    data = json.loads(scripts[0].text())
    assert data["rows"][1][0] == HOSTILE
    assert "<" not in scripts[0].text()
    assert next(ranking(page)[1].all("th")).text() == HOSTILE
    assert "innerHTML" not in scripts[1].text()


def test_the_policy_lets_its_own_script_run_and_no_other(page: Element) -> None:
    policy = next(x for x in page.all("meta") if x.attributes.get("http-equiv") == "Content-Security-Policy")
    script = "".join(list(page.all("script"))[1].words)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    expected = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert policy.attributes["content"] == expected


def test_links_are_the_reports_and_fleet_json(page: Element) -> None:
    assert [a.attributes["href"] for a in page.all("a")] == ["reports/a%20b/drive-0/report.html", "fleet.json"]
    assert not list(page.all("link", "img", "iframe", "object", "embed"))
    for element in page.all():
        assert "src" not in element.attributes


@pytest.mark.slow
def test_of_many_cars_the_first_are_plain_and_all_are_in_the_data() -> None:
    text = fleet_html(answer_of(10_000))
    assert len(text.encode()) < 3e6
    page = read(text)
    assert len(ranking(page)) == PLAIN
    data = json.loads(next(page.all("script")).text())
    assert [len(data["rows"]), data["rows"][-1][0]] == [10_000, "car 10000"]
    assert f"The first {PLAIN} of 10000 cars" in text
    assert len(re.findall("<use ", text)) < 6000, "cars are binned in the picture"


def test_a_fleet_that_was_only_checked(tmp_path: Path) -> None:
    answer = answer_of(4, causes=False) | {"population": None, "steps": ["check"], "reasons": {"no answer": 4}}
    for car in answer["cars"]:
        car |= {"reason": "no answer"} | dict.fromkeys(("p_string_stable", "T_L", "K_L", "change", "siblings", "gap"))
    text = write_fleet_page(answer, tmp_path).read_text(encoding="utf-8")
    assert "No car was estimated" in text
    assert "The logs were not diagnosed." in text
    assert "<svg" not in text


def test_a_rounded_probability_does_not_pass_for_the_target() -> None:
    answer = answer_of(10)
    answer["cars"][0]["p_string_stable"]["now"] = 0.8964
    assert ">0.896<" in fleet_html(answer)


@pytest.mark.parametrize("wrong", [{}, {"schema": "avtorch.diagnosis/1"}, {"schema": "avtorch.fleet/1"}])
def test_another_object_is_refused(wrong: dict[str, str]) -> None:
    with pytest.raises(InputError, match=r"needs the object of a fleet.json"):
        fleet_html(wrong)
