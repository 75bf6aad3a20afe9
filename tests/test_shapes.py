"""The check of shapes is alive: it refuses what contradicts an annotation, and only that."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.inference import JerkStatistics
from avtorch.inference.estimators.kalman import GaussianState
from avtorch.vehicle import Block
from avtorch.vehicle.stability import local_stable
from tests.shapes import ShapeError, checked


def _total(u: Float[Tensor, "window time"], weight: Float[Tensor, " time"]) -> Float[Tensor, " window"]:
    return (u * weight).sum(-1)


def _turned(x: Float[Tensor, "window time"]) -> Float[Tensor, "time window"]:
    return x


def test_one_name_is_one_length_within_a_call() -> None:
    total = checked(_total)
    assert total(torch.ones(2, 3), torch.ones(3)).tolist() == [3.0, 3.0]
    with pytest.raises(ShapeError, match=r"_total, weight: found \(torch.Size\(\[1\]\)"):
        total(torch.ones(2, 3), torch.ones(1))
    with pytest.raises(ShapeError, match="weight"):  # integers are no floats
        total(torch.ones(2, 3), torch.ones(3, dtype=torch.int64))


def test_what_is_returned_is_checked_and_what_has_passed_once_is_not_what_else_may_pass() -> None:
    turned = checked(_turned)
    turned(torch.ones(2, 2))
    turned(torch.ones(2, 2))
    with pytest.raises(ShapeError, match="return"):
        turned(torch.ones(3, 2))


def test_a_function_that_names_no_shape_is_left_as_it_is() -> None:
    assert checked(math.hypot) is math.hypot


def test_what_a_function_refuses_it_refuses_in_its_own_words() -> None:
    with pytest.raises(InputError, match="shapes do not broadcast"):
        local_stable(torch.ones(3), torch.ones(2), 1.0, (1.0, 1.0, 0.0))


def test_vehicle_is_under_the_check() -> None:
    row = torch.zeros(1, 5, dtype=torch.float64)
    Block(row[0], *[row] * 8, row > 0)
    with pytest.raises(ShapeError, match=r"Block\.__init__, accel_cmd"):
        Block(row[0, :4], *[row] * 8, row > 0)


def test_inference_is_under_the_check() -> None:
    sums = torch.ones(2, dtype=torch.float64)
    JerkStatistics(*[sums] * 7)
    with pytest.raises(ShapeError, match=r"JerkStatistics\.__init__, uu"):
        JerkStatistics(*[sums] * 6, torch.ones(3, dtype=torch.float64))


def test_the_fields_of_a_named_tuple_are_under_the_check() -> None:
    mean = torch.ones(2, 3, dtype=torch.float64)
    GaussianState(mean, torch.ones(2, 3, 3, dtype=torch.float64))
    with pytest.raises(ShapeError, match="cov"):
        GaussianState(mean, mean)


ROOT = Path(__file__).resolve().parents[1] / "avtorch"
ANY_SHAPE = {
    "stream.BeliefStream.feed": "time and masks of a stream, (time,) or one number; refused in its own words",
    "arguments.tensor": "takes any shape",
    "arguments.checked": "takes any shape",
    "linear_loop.LinearLoop.full": "what broadcasts to its own shape",
    "linear_loop.as_tensor": "takes any shape",
    "nuts.PositiveNormal.log_prob": "the shapes of torch.distributions",
    "nuts.PositiveNormal.sample": "the shapes of torch.distributions",
}


def bare(path: Path) -> Iterator[str]:
    """Public functions and classes that name a tensor or an array of floats without its shape."""
    found = {"Tensor", "torch.Tensor", "FloatArray", "Tensor | None", "FloatArray | None"}

    def names(body: list[ast.stmt], place: str) -> Iterator[str]:
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                own = [
                    x for x in node.body if isinstance(x, ast.AnnAssign) and not ast.unparse(x.target).startswith("_")
                ]
                if any(ast.unparse(x.annotation) in found for x in own):
                    yield f"{place}.{node.name}"
                yield from names(node.body, f"{place}.{node.name}")
            elif isinstance(node, ast.FunctionDef) and (node.name.startswith("__") or not node.name.startswith("_")):
                given = [x.annotation for x in (*node.args.args, *node.args.kwonlyargs)]
                if any(x is not None and ast.unparse(x) in found for x in (*given, node.returns)):
                    yield f"{place}.{node.name}"

    return names(ast.parse(path.read_text(encoding="utf-8")).body, path.stem)


def test_what_is_public_names_its_shapes() -> None:
    rooms = [ROOT / name for name in ("vehicle", "inference")]
    files = [path for room in rooms for path in sorted(room.rglob("*.py"))]
    assert len(files) > 40
    assert {name for path in files for name in bare(path)} == set(ANY_SHAPE)
