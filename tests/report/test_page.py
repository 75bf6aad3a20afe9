"""The report: complete, self-contained, and safe against markup in a log."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

import avtorch
from avtorch.blindtest import draw_case
from avtorch.errors import InputError
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.remedy import setting_for
from avtorch.report import report_html, write_report

HOSTILE = '<script>alert(1)</script>"&{{ 7 * 7 }}.csv'


class _Whole(HTMLParser):
    """Every element that is opened is closed, in order."""

    VOID = frozenset({"meta", "br", "img", "link", "hr"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.ids += [value or "" for name, value in attrs if name == "id"]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def _read(text: str) -> _Whole:
    page = _Whole()
    page.feed(text)
    page.close()
    assert page.open == []
    return page


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    case = draw_case(
        0,
        20,
        mix={"none": 0.0, "single": 1.0, "pair": 0.0, "outside": 0.0},
        effects=["sensor_bias"],
        tiers=["easy"],
        seconds=60.0,
        manoeuvre="steps",
    )
    log = replace(case.log(), name=HOSTILE)
    told = avtorch.diagnose(log, effects=["sensor_bias", "constant_resistance"], pairs=False)
    setting = setting_for(told, log.accel_cmd)
    return replace(told, setting=None if setting is None else setting.to_dict())


def test_it_is_whole_and_needs_no_network(found: Diagnosis, tmp_path: Path) -> None:
    path = write_report(found, tmp_path, quality=["2 rows masked"])
    text = path.read_text(encoding="utf-8")
    page = _read(text)
    assert len(page.ids) == len(set(page.ids))
    assert "script" not in page.tags
    assert not re.search(r'(src|href)="(?!#)', text)
    assert not re.search(r"url\((?!#)", text)
    assert path.stat().st_size < 3e6
    for words in ("sensor_bias", "How far the gap shrinks", "What to set", "2 rows masked", "floor"):
        assert words in text
    assert report_html(found, quality=["2 rows masked"]) == text


@pytest.mark.slow
def test_a_hostile_name_is_text(found: Diagnosis) -> None:
    text = report_html(found, quality=[HOSTILE])
    assert "<script" not in text
    assert "{{ 7 * 7 }}" in text
    assert "&lt;script&gt;" in text


def test_answers_with_fewer_entries(found: Diagnosis) -> None:
    bare = replace(found, traces=None, shrinkage=None, setting=None, where=(), notes=("<b>note</b>",), complete=False)
    text = report_html(bare)
    _read(text)
    assert "Provisional" in text
    assert "<b>note" not in text
    assert "How far" not in text


def test_a_place_that_cannot_be_written(found: Diagnosis, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_report(found, tmp_path / "file")


def test_a_name_steers_no_browser_and_no_terminal(found: Diagnosis) -> None:
    steer = "lap\x1b[2J\u202egpj\x9b\udc80.csv"
    text = report_html(replace(found, log=replace(found.log, name=steer)), quality=[f"columns ignored: {steer}"])
    assert text.count(r"lap\x1b[2J\u202egpj\x9b\udc80.csv") >= 2
    assert text.replace("\n", "").isprintable()
