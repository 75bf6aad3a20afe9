"""The report: complete, self-contained, and safe against markup in a log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from avtorch.errors import InputError
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.report import write_report
from avtorch.report.diagnosis import report_html
from tests.report.conftest import HOSTILE
from tests.report.tree import read


@pytest.mark.slow
def test_it_is_whole_and_needs_no_network(found: Diagnosis, tmp_path: Path) -> None:
    path = write_report(found, tmp_path, quality=["2 rows masked"])
    text = path.read_text(encoding="utf-8")
    read(text)
    assert path.stat().st_size < 1e6
    for words in ("sensor_bias", "How far the gap shrinks", "What to set", "2 rows masked", "floor"):
        assert words in text
    assert report_html(found, quality=["2 rows masked"]) == text


def without_pictures(found: Diagnosis, **other: Any) -> Diagnosis:
    """An answer that holds as little as one may, whose page is made at once."""
    few = {"traces": None, "shrinkage": None, "setting": None, "where": (), "budget": None}
    return replace(found, **few | other)


def test_a_hostile_name_is_text(found: Diagnosis) -> None:
    text = report_html(without_pictures(found), quality=[HOSTILE])
    assert "<script>alert" not in text
    assert "{{ 7 * 7 }}" in text
    assert "&lt;script&gt;" in text


def test_the_fit_is_told_in_per_cent(found: Diagnosis, page_text: str) -> None:
    traces = found.traces
    assert traces is not None
    before, after = (traces.fit(x)[0] for x in (traces.before, traces.after))
    text = " ".join(page_text.split())
    name = {"accel": "acceleration"}.get(traces.channels[0], traces.channels[0])
    assert f"0 % no better than the mean): {name} {before:.0f} % without what was named, {after:.0f} % with it" in text


def test_answers_with_fewer_entries(found: Diagnosis) -> None:
    text = report_html(without_pictures(found, notes=("<b>note</b>",), complete=False))
    read(text)
    assert "Provisional" in text
    assert "<b>note" not in text
    assert "How far" not in text


@pytest.mark.slow
def test_a_place_that_cannot_be_written(found: Diagnosis, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_report(found, tmp_path / "file")


def test_a_name_steers_no_browser_and_no_terminal(found: Diagnosis) -> None:
    steer = "lap\x1b[2J\u202egpj\x9b\udc80.csv"
    named = without_pictures(found, log=replace(found.log, name=steer))
    text = report_html(named, quality=[f"columns ignored: {steer}"])
    assert text.count(r"lap\x1b[2J\u202egpj\x9b\udc80.csv") >= 2
    assert text.replace("\n", "").isprintable()
