"""Sealed files: read back as written, and refused in one line whatever else lies there."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io import Damaged, fingerprint, read_sealed_bytes, write_sealed

SCHEMA = "avtorch.test/1"
OF = {"logs": ["drive.csv"], "pairs": True}
CONTENT = b"{\n\x00\xff"


def test_content_comes_back_to_the_bit(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "state.json"
    write_sealed(path, CONTENT, schema=SCHEMA, of=OF)
    assert read_sealed_bytes(path, schema=SCHEMA) == (OF, CONTENT)


def test_every_byte_counts(tmp_path: Path) -> None:
    """Each byte changed; and left out, doubled, or the last one that is left: none of it is read."""
    path = tmp_path / "state"
    write_sealed(path, b"some bytes\n", schema=SCHEMA, of={"a": 1})
    whole = path.read_bytes()
    for i, byte in enumerate(whole):
        more = [whole[:i] + whole[i + 1 :], whole[:i] + whole[i : i + 1] + whole[i:], whole[:i]]
        for other in (whole[:i] + bytes([byte ^ 1]) + whole[i + 1 :], more[i % 3]):
            path.write_bytes(other)
            with pytest.raises(Damaged, match=r"^\S+state: .*; remove it, or use another folder$"):
                read_sealed_bytes(path, schema=SCHEMA)


def forged(body: bytes) -> bytes:
    """A file with a right checksum over a `body` that the writer would not write."""
    return hashlib.sha256(body).hexdigest().encode() + b"\n" + body


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"}",
        b'{"schema": "avtorch.test/1", "of": {}, "more": 2}\n1',
        b'{"schema": "avtorch.test/1", "of": []}\n1',
        b"[" * 100_000 + b"]" * 100_000,
        b'"\xff"',
        b"9" * 100_000,
    ],
    ids=lambda body: body[-40:].decode("latin-1"),
)
def test_a_right_checksum_over_nonsense_helps_nothing(tmp_path: Path, body: bytes) -> None:
    path = tmp_path / "state"
    path.write_bytes(forged(body))
    with pytest.raises(Damaged):
        read_sealed_bytes(path, schema=SCHEMA)


def test_another_schema_and_too_much_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "state"
    write_sealed(path, CONTENT, schema="avtorch.other/1", of={})
    with pytest.raises(Damaged, match=r"holds avtorch\.other/1, needs avtorch\.test/1"):
        read_sealed_bytes(path, schema=SCHEMA)
    with pytest.raises(Damaged, match="is larger than"):
        read_sealed_bytes(path, schema="avtorch.other/1", most=100)
    path.write_text(json.dumps({"fits": []}))
    with pytest.raises(Damaged, match="changed by hand or of an earlier avtorch: its checksum is wrong; do this"):
        read_sealed_bytes(path, schema=SCHEMA, remedy="do this")


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    """A FIFO would keep its reader waiting, no regular file would never end, a symlink leads elsewhere."""
    real = tmp_path / "real"
    write_sealed(real, CONTENT, schema=SCHEMA, of={})
    before = real.read_bytes()
    link, fifo, folder = tmp_path / "link", tmp_path / "fifo", tmp_path / "folder"
    link.symlink_to(real)
    os.mkfifo(fifo)
    folder.mkdir()
    for path, kind in (
        (link, "a symbolic link"),
        (fifo, "no regular file"),
        (folder, "a directory"),
        (Path("/dev/zero"), "no regular file"),
    ):
        with pytest.raises(InputError, match=f"{path.name}: is {kind}") as caught:
            read_sealed_bytes(path, schema=SCHEMA)
        assert not isinstance(caught.value, Damaged)
    assert real.read_bytes() == before
    with pytest.raises(InputError, match="missing: no such file; remove it"):
        read_sealed_bytes(tmp_path / "missing", schema=SCHEMA)
    for path in (tmp_path / ("x" * 300), tmp_path / "zero\0byte", real / "inside"):
        with pytest.raises(InputError, match="cannot be read"):
            read_sealed_bytes(path, schema=SCHEMA)


@pytest.mark.parametrize("call", ["fsync", "replace", "chmod"])
def test_a_failed_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    path = tmp_path / "state"
    write_sealed(path, b"1", schema=SCHEMA, of={})
    before = path.read_bytes()

    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, call, full)
    with pytest.raises(InputError, match="state: cannot be written"):
        write_sealed(path, b"2", schema=SCHEMA, of={})
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["state"]
    # what JSON cannot hold is refused before anything is written
    with pytest.raises(InputError, match="finite"):
        write_sealed(path, b"2", schema=SCHEMA, of={"T_L": float("nan")})
    assert path.read_bytes() == before


def test_fingerprints_are_equal_for_equal_values_only(fresh_seed: int) -> None:
    rng = random.Random(fresh_seed)
    x = np.array([rng.random() for _ in range(8)])
    assert fingerprint(x, [1, None]) == fingerprint(x.copy(), (1, None))
    assert fingerprint({"a": 1, "b": x}) == fingerprint({"b": x, "a": 1})
    near = x.copy()
    near[3] = np.nextafter(near[3], 2)
    different = [
        *(x, near, x.reshape(2, 4), x[:7], x.astype(np.float32), x.tolist(), [x], {"x": x}),
        *(1, 1.0, True, "1", b"1", None, "None", [], {}, [1, 2], ["12"], ["1", "2"], [[1], 2], [1, [2]]),
        *(0.0, -0.0, int, float, np.float64(3.0), np.int64(3), slice(1, 2), slice(1, 3), slice(1, 2, 1)),
    ]
    assert len({fingerprint(value) for value in different}) == len(different)
    for value in (object(), np.array([object()]), {1, 2}, [lambda: 0]):
        with pytest.raises(TypeError):
            fingerprint(value)
