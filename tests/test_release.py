"""What a release says of itself is one thing, wherever it is said."""

from __future__ import annotations

import re
import tomllib
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


def test_the_source_archive_holds_what_its_readme_links_to() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    held = {path.strip("/") for path in project["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]}
    links = re.findall(r"\]\(([^)#:]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert {link.split("/")[0] for link in links} <= held
    assert all((ROOT / path).exists() for path in held)
