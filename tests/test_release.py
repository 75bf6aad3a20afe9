"""What a release says of itself is one thing, wherever it is said."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

import avtorch

ROOT = Path(__file__).resolve().parents[1]


def test_the_citation_names_this_version_and_its_paper() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == avtorch.__version__
    assert cited["license"] == "MIT"
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()
    assert cited["references"][0]["title"].split(":")[0] in (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")


def test_the_version_is_semantic() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?", avtorch.__version__)
