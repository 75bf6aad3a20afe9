"""A stream's saved state: whole or as it was, believed as it was saved or refused, and the stream untouched then."""

from __future__ import annotations

import copy
import errno
import math
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import BeliefStream, SamplerSettings
from tests.faulty_disk import disk, fails

SMALL = SamplerSettings(chains=8, draws=16, burn_in=4)


def new(estimator: str = "sgld", **options: Any) -> BeliefStream:
    more = {"settings": SMALL} if estimator == "sgld" else {}
    return BeliefStream(**{"vehicles": 2, "kept": 20, "seed": 4, "estimator": estimator, **more, **options})


def driven(make_windows: Callable, stream: BeliefStream) -> BeliefStream:
    """Three seconds of it: a window closed, and another open."""
    w = make_windows(1, [1.0, 0.8], T=[0.3, 0.8], rows=300)
    stream.feed(w.time, w.columns)
    return stream


@pytest.fixture(scope="module")
def saved(make_windows: Callable) -> BeliefStream:
    return driven(make_windows, new())


def same(one: Any, other: Any) -> bool:
    """Whether two states are equal to the bit."""
    if isinstance(one, Tensor):
        return isinstance(other, Tensor) and one.dtype == other.dtype and one.equal(other)
    if isinstance(one, dict):
        return isinstance(other, dict) and one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    return type(one) is type(other) and one == other


def test_damaged_files_are_refused_or_load_as_saved(saved: BeliefStream, tmp_path: Path, fresh_seed: int) -> None:
    """Bits flipped, bytes overwritten, ends cut off and pieces moved: 150 of them."""
    path, rng = tmp_path / "state", random.Random(fresh_seed)
    saved.save(path)
    whole, before = path.read_bytes(), saved.state_dict()
    for turn in range(150):
        content = bytearray(whole)
        at, more = sorted(rng.randrange(len(whole)) for _ in range(2))
        match turn % 5:
            case 0:
                content[at] ^= 1 << rng.randrange(8)
            case 1:
                content[at : at + 8] = rng.randbytes(8)
            case 2:
                del content[at:]
            case 3:
                content[at:more] = content[at:more][::-1]
            case 4:
                content += rng.randbytes(1 + turn)
        path.write_bytes(content)
        stream = new(seed=99)
        fresh = stream.state_dict()
        if content == whole:  # a piece of equal bytes turned round
            stream.load(path)
            assert same(stream.state_dict(), before)
            continue
        with pytest.raises(InputError) as caught:
            stream.load(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
        assert same(stream.state_dict(), fresh)


def changed(state: Any, rng: random.Random) -> str:
    """Change one thing somewhere in a state, in place; returns where."""
    place, at = "state", state
    while True:
        key = rng.choice(sorted(at))
        place += f".{key}"
        if not isinstance(at[key], dict):
            break
        at = at[key]
    value = at[key]
    if isinstance(value, Tensor) and value.numel() and rng.random() < 0.7:
        value = at[key] = value.clone()
        flat, i = value.reshape(-1), rng.randrange(value.numel())
        if value.dtype == torch.bool:
            flat[i] = ~flat[i]
        elif value.dtype == torch.uint8:
            flat[i] ^= 1
        else:
            flat[i] = rng.choice([math.nan, math.inf, -1.0, float(flat[i]) * (1 + 1e-9) + 1e-12])
        return place
    wrong: list[Any] = [None, "x", -1, 0.25, [], {}, torch.zeros(3), torch.zeros(2, 2, dtype=torch.float64), math.nan]
    at[key] = rng.choice([x for x in wrong if not same(x, value)])
    return place


@pytest.mark.parametrize("estimator", ["sgld", "rls", "ekf"])
def test_changed_states_are_refused(make_windows: Callable, estimator: str, fresh_seed: int) -> None:
    rng = random.Random(fresh_seed)
    state = driven(make_windows, new(estimator)).state_dict()
    for _ in range(50):
        other = copy.deepcopy(state)
        place = changed(other, rng)
        stream = new(estimator, seed=99)
        fresh = stream.state_dict()
        with pytest.raises(InputError, match=r"^state: ") as caught:
            stream.load_state_dict(other)
        assert "\n" not in str(caught.value), place
        assert same(stream.state_dict(), fresh), place


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_a_full_disk_leaves_the_earlier_state(
    saved: BeliefStream, make_windows: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    path = tmp_path / "state"
    new().save(path)
    before = path.read_bytes()

    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    if call == "write":  # the second half does not fit
        monkeypatch.setattr(os, "fdopen", lambda handle, *a, **k: _Full(handle))
    else:
        monkeypatch.setattr(os, call, full)
    with pytest.raises(InputError, match="No space left on device"):
        saved.save(path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["state"]
    new().load(path)


class _Full:
    """A file on a disk that takes half of what is written."""

    def __init__(self, handle: int) -> None:
        self.handle = handle

    def __enter__(self) -> _Full:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.handle)

    def write(self, content: bytes) -> int:
        os.write(self.handle, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("onwards", [False, True], ids=["one call fails", "all fail from there on"])
def test_a_disk_that_fails_at_the_nth_call(
    saved: BeliefStream, onwards: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The earlier state or the new one, whole, and what was left over is in nobody's way."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    path, earlier = tmp_path / "streams" / "state", new(seed=99)
    for n in range(1, 100):
        earlier.save(path)
        said = None
        with disk(path.parent, fails(n, onwards=onwards)) as calls:
            try:
                saved.save(path)
            except InputError as fault:
                said = str(fault)
        assert said is None or (str(path) in said and "\n" not in said)
        found = new(seed=5)
        found.load(path)
        assert same(found.state_dict(), (earlier if said else saved).state_dict())
        if len(calls) < n:
            assert n > 5
            return
    raise AssertionError("the sweep has no end")


def test_symlinks_folders_and_fifos_are_refused(saved: BeliefStream, tmp_path: Path) -> None:
    path, link, folder, fifo = (tmp_path / name for name in ("state", "link", "folder", "fifo"))
    saved.save(path)
    before = path.read_bytes()
    link.symlink_to(path)
    folder.mkdir()
    os.mkfifo(fifo)
    for place, told in ((link, "a symbolic link"), (folder, "a directory"), (fifo, "no regular file")):
        with pytest.raises(InputError, match=f"{place.name}: is {told}"):
            new().load(place)
    assert path.read_bytes() == before
    assert link.is_symlink()
    with pytest.raises(InputError, match="is no regular file"):
        new().load("/dev/zero")
    with pytest.raises(InputError, match="missing: no such file"):
        new().load(tmp_path / "missing")


def test_a_state_of_an_earlier_avtorch_is_refused(saved: BeliefStream, tmp_path: Path) -> None:
    """Without a checksum it is not known whether it is as it was saved."""
    path = tmp_path / "state"
    torch.save({key: value for key, value in saved.state_dict().items() if key != "sha256"}, path)
    with pytest.raises(InputError, match="of an earlier avtorch"):
        new().load(path)


def test_other_streams_are_refused_by_name(saved: BeliefStream, tmp_path: Path) -> None:
    saved.save(tmp_path / "state")
    for options, told in (
        ({"window": 1.0}, "saved with window '2.0', not 1.0"),
        ({"vehicles": 3}, "saved with vehicles '2', not 3"),
        ({"kept": 30}, "draws"),
        ({"mode": "posterior"}, "mode"),
    ):
        with pytest.raises(InputError, match=told) as caught:
            new(**options).load(tmp_path / "state")
        assert str(caught.value).startswith(f"{tmp_path / 'state'}: ")
    with pytest.raises(InputError, match="saved by the estimator 'sgld', not 'rls'"):
        new("rls").load(tmp_path / "state")
