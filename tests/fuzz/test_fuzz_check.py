"""Tables of any content: `check` proposes something or refuses in one line, and what it proposes can be read back."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import avtorch
from avtorch.io.mapping import read_mapping

from .mutations import fuzzed, outcome

NAMES = st.sampled_from(
    ["time", "t", "Zeit [s]", "speed", "v (km/h)", "accel", "ax_g", "accel_cmd", "u", "engaged", "gap", "", "x", "A"]
) | st.text(max_size=8)
COURSES = st.sampled_from(["rising", "constant", "noise", "wave", "bits", "empty", "text", "few", "huge", "falling"])


def column(course: str, rows: int, rng: np.random.Generator) -> list[str]:
    numbers = {
        "rising": np.arange(rows) * 0.05,
        "falling": -np.arange(rows) * 0.05,
        "constant": np.full(rows, 3.0),
        "noise": rng.normal(size=rows),
        "wave": 10 + 2 * np.sin(np.arange(rows) * rng.uniform(0.01, 0.1)),
        "bits": rng.integers(0, 2, rows).astype(float),
        "huge": rng.normal(size=rows) * 1e300,
        "few": rng.normal(size=rows),
    }.get(course)
    if numbers is None:
        return ["" if course == "empty" else "word"] * rows
    return ["" if course == "few" and i % 7 else repr(float(x)) for i, x in enumerate(numbers)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("check")


@pytest.mark.slow
@fuzzed("check")
@given(
    columns=st.lists(st.tuples(NAMES, COURSES), min_size=1, max_size=7),
    rows=st.sampled_from([1, 2, 3, 30, 400]),
    separator=st.sampled_from([",", ";", "\t"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_table_is_checked_or_refused(
    folder: Path, columns: list[tuple[str, str]], rows: int, separator: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    cells = [column(course, rows, rng) for _, course in columns]
    names = ['"' + name.replace('"', '""') + '"' for name, _ in columns]
    path = folder / "drive.csv"
    lines = [separator.join(row) for row in [names, *zip(*cells, strict=True)]]
    path.write_text("\n".join(lines), encoding="utf-8", errors="replace", newline="")
    found = outcome(lambda: avtorch.check(path))
    if found is None:
        return
    assert all(note.isprintable() for note in found.notes)
    assert found.log is not None or found.fault is not None  # one that holds too little has both
    assert found.proposal is not None
    written = found.proposal.toml("drive.csv")
    assert tomllib.loads(written).get("map", {}) == found.proposal.map
    beside = path.with_suffix(".toml")
    beside.write_text(written, encoding="utf-8")
    try:
        assert read_mapping(path).unit == found.proposal.unit
    finally:
        beside.unlink()
