"""Answers are strict JSON, whole or not there at all."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.io import atomic, write_json

plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda x: st.lists(x, max_size=4) | st.dictionaries(st.text(), x, max_size=4),
    max_leaves=20,
)


# JSON text in UTF-8 cannot hold half of a surrogate pair, and st.text draws none
@settings(max_examples=60, deadline=None)
@given(plain)
def test_what_is_written_is_read(tmp_path_factory, answer):
    path = tmp_path_factory.mktemp("json") / "a.json"
    write_json(path, answer)
    assert json.loads(path.read_text(encoding="utf-8")) == answer


def test_arrays_and_tensors_become_lists(tmp_path):
    write_json(
        tmp_path / "a.json", {"x": np.arange(2), "y": torch.ones(1, 2), "z": np.float64(0.5), "b": np.True_, "t": (1,)}
    )
    got = json.loads((tmp_path / "a.json").read_text())
    assert got == {"x": [0, 1], "y": [[1.0, 1.0]], "z": 0.5, "b": True, "t": [1]}


@pytest.mark.parametrize(
    ("answer", "where"),
    [
        ({"a": [1.0, float("nan")]}, r"\$\.a\[1\]: is nan"),
        ({"a": {"b": float("inf")}}, r"\$\.a\.b: is inf"),
        ({"a": torch.tensor([0.0, float("-inf")])}, r"\$\.a\[1\]: is -inf"),
        ({"a": np.float64("nan")}, r"\$\.a: is nan"),
        ({1: 2}, r"\$: has the key 1"),
        ({"a": {1, 2}}, r"\$\.a: is a set"),
    ],
)
def test_what_is_no_answer_leaves_the_earlier_one(tmp_path, answer, where):
    path = tmp_path / "a.json"
    write_json(path, {"ok": True})
    with pytest.raises(InputError, match=where):
        write_json(path, answer)
    assert json.loads(path.read_text()) == {"ok": True}
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_write_that_fails_midway_leaves_nothing(tmp_path):
    def fail_midway():
        with atomic(tmp_path / "new" / "a.txt") as stream:
            stream.write("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_midway()
    assert os.listdir(tmp_path / "new") == []


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a directory"):
        write_json(tmp_path, {})
    with pytest.raises(InputError, match="cannot be written"):
        write_json(tmp_path / "file" / "a.json", {})


def test_permissions_are_those_of_any_other_file(tmp_path):
    (tmp_path / "plain").write_text("")
    write_json(tmp_path / "a.json", {})
    assert (tmp_path / "a.json").stat().st_mode == (tmp_path / "plain").stat().st_mode
