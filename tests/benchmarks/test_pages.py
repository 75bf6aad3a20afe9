"""The pages on detectors and options: their commands and options exist, and their pictures and links."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("page", ["detectors", "options"])
def test_commands_and_options_exist(
    page: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    assert set(re.findall(r"python -m ([\w.]+)", text)) == {f"benchmarks.{page}"}
    monkeypatch.setattr(sys, "argv", [page, "--help"])
    with pytest.raises(SystemExit) as end:
        importlib.import_module(f"benchmarks.{page}.__main__").main()
    assert end.value.code == 0
    known = set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out))
    assert set(re.findall(r"(?<![-\w])--[a-z][a-z-]*", text)) <= known
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (DOCS / target).exists(), target
