"""Damaged resume files and stream states: refused in one printable line, or what was saved.

Damage under an intact checksum is tried as well: the seal is no signature, so content is checked for itself.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from avtorch.inference import BeliefStream, SamplerSettings

from .mutations import Raw, fuzzed, mutated, other_number, outcome

SETTINGS = SamplerSettings(chains=8, draws=16, burn_in=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def new_stream() -> BeliefStream:
    return BeliefStream(vehicles=1, settings=SETTINGS, kept=8, seed=4)


@cache
def whole() -> dict[str, bytes]:
    """The state of a stream in the middle of its first window."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        stream, time = new_stream(), torch.arange(90, dtype=torch.float64) / 100
        wave = torch.sin(3 * time)[None]
        stream.feed(time, {"accel": wave, "accel_cmd": wave, "jerk": wave})
        stream.save(folder / "stream")
        return {path.name: path.read_bytes() for path in folder.iterdir()}


@st.composite
def damaged(draw: st.DrawFn, name: str) -> tuple[Raw, bool]:
    """Bytes, and whether their checksum is right, whatever happened to what is below it."""
    good = whole()[name]
    rest = good.partition(b"\n")[2]
    if not draw(st.booleans()):
        return draw(mutated([good]) | other_number(good)), False
    rest = draw(mutated([rest]))
    return Raw(hashlib.sha256(rest).hexdigest().encode() + b"\n" + rest), True


@fuzzed("states")
@given(damage=damaged("stream"))
def test_damaged_stream(folder: Path, damage: tuple[bytes, bool]) -> None:
    raw, resealed = damage
    (folder / "stream.pt").write_bytes(raw)
    stream = new_stream()
    loaded = outcome(lambda: stream.load(folder / "stream.pt") or True)
    assert loaded is None or resealed or raw == whole()["stream"]
    if loaded:  # a checksum of its own lies inside: what is accepted is what was saved
        good = new_stream()
        (folder / "whole.pt").write_bytes(whole()["stream"])
        good.load(folder / "whole.pt")
        assert stream.state_dict()["sha256"] == good.state_dict()["sha256"]
