"""The tutorial does what it says: its commands run in its order, and print what it shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from avtorch.cli import main
from tests.shown_output import matches

PAGE = Path(__file__).resolve().parents[1] / "docs" / "tutorial.md"


@pytest.mark.slow
def test_commands_print_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    names: dict = {"__name__": "tutorial"}
    compared, printed = 0, ""
    for kind, block in re.findall(r"^```(python|sh|text)\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.S | re.M):
        if kind == "text":
            assert matches(printed, block), f"shown:\n{block}\nprinted:\n{printed}"
            compared += 1
            continue
        if kind == "python":
            exec(compile(block, PAGE.name, "exec", dont_inherit=True), names)
        for line in block.splitlines() if kind == "sh" else ():
            program, *tokens = shlex.split(line)
            # what `make_drives.py` holds has run: it is the block above its command
            assert program == "avtorch" or line == "python make_drives.py"
            assert program != "avtorch" or main(tokens) == 0, line
        printed = capsys.readouterr().out
        if "now, " in printed:
            assert "1.18 now, 1.02 as advised" in printed  # as the sentence below that block says
    assert compared == 5
