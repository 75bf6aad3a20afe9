"""All from one call: names, order, answer, and equality by seed."""

from __future__ import annotations

import pytest

from avtorch.errors import InputError
from avtorch.paper import EXPERIMENTS, reproduce


@pytest.mark.slow
def test_equal_by_seed_and_only_by_seed() -> None:
    told: list[tuple[float, float]] = []
    first, again, other = (
        reproduce(["gains"], seeds=2, seed=seed, progress=lambda done, of: told.append((done, of))).answer()
        for seed in (4, 4, 5)
    )
    assert first == again
    assert first["rows"] != other["rows"]
    assert told[-1][0] == told[-1][1]
    assert first["schema"] == "avtorch.paper/1"
    assert first["leaders"] == {"US06": "US06, the embedded drive cycle, from its start"}
    assert {row["verdict"] for row in first["rows"]} <= {"same", "better", "not reproduced"}
    assert all(row["why"].endswith(".") for row in first["rows"])


@pytest.mark.slow
def test_belief_and_action_are_equal_by_seed() -> None:
    first, again = (reproduce(["platoon"], seeds=2, seed=9) for _ in range(2))
    assert list(first.found) == ["platoon"]
    assert first.answer() == again.answer()


def test_refusals() -> None:
    with pytest.raises(InputError, match=f"needs some of {', '.join(EXPERIMENTS)}"):
        reproduce(["gain"])
    with pytest.raises(InputError, match="seeds: found 1, needs 2 or more"):
        reproduce(["gains"], seeds=1)
