"""The filter by blocks against its own recursion, a row at a time."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.state_space import StateSpace


def _filter(states: int, outs: int, count: int, rng: np.random.Generator) -> StateSpace:
    """One that forgets within some hundred rows."""
    A = rng.normal(size=(states, states))
    A *= 0.98 / np.abs(np.linalg.eigvals(A)).max()
    return StateSpace(
        A, rng.normal(size=(states, count)), rng.normal(size=(outs, states)), rng.normal(size=(outs, count))
    )


def _by_rows(of: StateSpace, inputs: FloatArray) -> FloatArray:
    state, out = np.zeros(len(of.A)), []
    for e in inputs.T:
        out.append(of.C @ state + of.D @ e)
        state = of.A @ state + of.B @ e
    return np.stack(out, -1)


@pytest.mark.parametrize("rows", [1, 15, 16, 17, 1000])
@pytest.mark.parametrize(("states", "outs", "count"), [(3, 2, 2), (2, 1, 1), (5, 1, 3)])
def test_blocks_are_the_recursion(states: int, outs: int, count: int, rows: int, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    of = _filter(states, outs, count, rng)
    inputs = rng.normal(size=(2, 3, count, rows))
    got = of(inputs)
    assert got.shape == (2, 3, outs, rows)
    for place in np.ndindex(2, 3):
        expected = _by_rows(of, inputs[place])
        np.testing.assert_allclose(got[place], expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_the_transpose_is_the_transposed_map(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    of = _filter(3, 2, 1, rng)
    inputs, images = rng.normal(size=(1, 200)), rng.normal(size=(2, 200))
    back = of.transpose(images[:, ::-1])[:, ::-1]
    assert float((of(inputs) * images).sum()) == pytest.approx(float((inputs * back).sum()), rel=1e-9)
