"""Regions: the shares are those of the conditions themselves, and the four ways stand to each other as they must."""

from __future__ import annotations

import pytest
import torch

from avtorch.paper import Leaders, regions
from avtorch.paper.regions import CASES, FORMS, Regions
from avtorch.vehicle.stability import region, string_stable

pytestmark = pytest.mark.slow  # all tests need the experiment itself


@pytest.fixture(scope="module")
def found() -> Regions:
    return regions(Leaders.read(), seeds=2, seed=3)


def test_the_plane_is_that_of_the_stability_package(found: Regions) -> None:
    for i, case in enumerate(CASES):
        for form in ("print", "rigorous"):
            plane = region(
                ("k_v", found.k_v),
                ("k_a", found.k_a),
                T_L=case.lag,
                K_L=case.gain,
                time_gap=case.time_gap,
                form=form,
            )
            assert torch.equal(found.local[i][form], plane.local)
            assert torch.equal(found.string[i][form], plane.local & plane.string)


def test_rigorous_lies_within_exact(found: Regions) -> None:
    for shares, string in zip(found.shares, found.string, strict=True):
        assert float(shares["rigorous"][0]) <= float(shares["exact"][0])
        assert not bool((string["rigorous"] & ~string["exact"]).any())


def test_posterior_is_the_verdict_at_the_believed_vehicle(found: Regions) -> None:
    """A belief this narrow (T_L within 1 %) agrees with the point verdict but for the region's edge."""
    case = CASES[0]
    k = torch.stack(
        [torch.full((61, 61), 1.5, dtype=torch.float64), *torch.meshgrid(found.k_v, found.k_a, indexing="xy")], -1
    )
    point = string_stable(case.believed, 1.0, case.time_gap, k)
    assert float((point == found.string[0]["posterior"]).double().mean()) > 0.97


def test_rows(found: Regions) -> None:
    rows = found.rows
    assert len(rows) == 2 * len(FORMS) + 3
    assert all(row.verdict == "same" for row in rows[:8])
    ratio = found.shares[1]["print"] / found.shares[0]["print"]
    assert rows[0].ours == pytest.approx(float(ratio))
    assert all((row.interval is not None) == ("posterior" in row.setting) for row in rows)
    assert "US06 drives ahead" in next(row for row in rows if "posterior" in row.setting).why
