"""Eqs. 2 and 3 over boxes: the rigorous forms never pass a bad box, the printed Eq. 2 does."""

from __future__ import annotations

import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import stability

BOXES = 20_000
INSIDE = 40


@pytest.fixture
def boxes(fresh_seed):
    """Random boxes with their gains, and points inside them: corners first, then edges in K, then anywhere."""
    rng = torch.Generator().manual_seed(fresh_seed)
    T, K = torch.rand(2, 2, BOXES, generator=rng, dtype=torch.float64).sort(1).values
    T, K = 0.02 + 2 * T, 0.2 + 1.4 * K
    tau, ks, kv, ka = torch.rand(4, BOXES, generator=rng, dtype=torch.float64)
    gains = torch.stack((0.05 + 3 * ks, 3 * kv, 4 * ka - 3), -1)
    u, w = torch.rand(2, INSIDE, BOXES, generator=rng, dtype=torch.float64)
    u[:4] = torch.tensor([0.0, 0.0, 1.0, 1.0])[:, None]
    w[:4] = torch.tensor([0.0, 1.0, 0.0, 1.0])[:, None]
    u[4:20] = 1.0
    inside = T[0] + u * (T[1] - T[0]), K[0] + w * (K[1] - K[0])
    return (T[0], T[1]), (K[0], K[1]), 0.3 + 2 * tau, gains, inside


def test_rigorous_local_form_is_exact_and_the_print_passes_unstable_boxes(boxes):
    T, K, tau, gains, inside = boxes
    stable = stability.local_stable(*inside, tau, gains)
    rigorous = stability.local_conditions(T, K, tau, gains, form="rigorous").holds
    printed = stability.local_conditions(T, K, tau, gains, form="print").holds
    # Both ways: what passes has no unstable point, what fails has an unstable corner (up to one rounding on the edge).
    assert rigorous.any()
    assert not (rigorous & ~stable.all(0)).any()
    assert torch.equal(rigorous, stable[:4].all(0))
    assert (printed & ~stable.all(0)).any()
    assert not (rigorous & ~printed).any()


def test_a_box_that_the_print_passes_though_it_holds_an_unstable_vehicle():
    # k_a > 0: the strong vehicle (T^u, K^u) is the worst, and the printed condition ignores it.
    T, K, gains = (0.1, 1.0), (0.2, 1.2), [1.0, 0.3, 0.6]
    assert stability.local_conditions(T, K, 1.0, gains, form="print").holds.item()
    assert not stability.local_conditions(T, K, 1.0, gains, form="rigorous").holds.item()
    assert not stability.local_stable(1.0, 1.2, 1.0, gains).item()


def test_rigorous_string_form_never_passes_a_bad_box(boxes):
    T, K, tau, gains, inside = boxes
    rigorous = stability.string_sufficient(T, K, tau, gains, form="rigorous")
    printed = stability.string_sufficient(T, K, tau, gains, form="print")
    stable = stability.string_stable(*inside, tau, gains)
    assert rigorous.any()
    assert not (rigorous & ~stable.all(0)).any()
    # The print's mixed ends, K^l in the square and K^u behind it, are needlessly strict.
    assert (rigorous & ~printed).any()


def test_printed_eq3_alone_passes_a_locally_unstable_vehicle():
    gains = [1.5, 1.5, 4.0]
    assert stability.string_sufficient((0.1, 0.2), (0.9, 1.0), 1.0, gains, form="print").item()
    assert not stability.string_sufficient((0.1, 0.2), (0.9, 1.0), 1.0, gains).item()
    assert not stability.local_stable(0.1, 1.0, 1.0, gains).item()


@pytest.mark.slow
def test_least_B_over_a_box_is_found_at_the_vertex(boxes):
    T, K, tau, gains, inside = boxes
    values = stability.string_conditions(T, K, tau, gains, form="rigorous").values
    B, C = stability.string_margins(*inside, tau, gains)
    rounding = 1e-12 * (1 + B.abs().amax(0))
    assert (values[:, 0] <= B.amin(0) + rounding).all()
    assert (values[:, 1] <= (C / inside[1]).amin(0) + rounding).all()
    # Attained: a fine walk along the edge T^u (where g > 0) comes down to it, a quadratic's distance away.
    walk = torch.linspace(0, 1, 401, dtype=torch.float64)[:, None]
    B, _ = stability.string_margins(T[1], K[0] + walk * (K[1] - K[0]), tau, gains)
    bend = gains[:, 2] ** 2 * ((K[1] - K[0]) / 400) ** 2
    assert (B.amin(0) - values[:, 0] <= bend + rounding).all()
    ends = torch.minimum(B[0], B[-1])
    assert (values[:, 0] < ends - 1e-3).any(), "no vertex lay inside a box: the test would see nothing"


def test_one_point_is_a_box_of_no_size():
    gains = [1.5, 1.5, -0.8]
    point = stability.local_conditions(0.3, 1.0, 1.0, gains)
    box = stability.local_conditions((0.3, 0.3), (1.0, 1.0), 1.0, gains, form="print")
    assert torch.equal(point.values, box.values)
    assert len(point.names) == point.values.shape[-1] == 5
    # Three printed lines of Eq. 3; at one point the first two agree and are B, the last is C / K.
    lines = stability.string_conditions(0.3, 1.0, 1.0, gains, form="print")
    assert lines.values.tolist() == pytest.approx([1.44, 1.44, 1.35])


def test_the_designs_own_box_is_string_stable_and_narrowly_so():
    bounds = {"T_L": (0.1, 0.4), "K_L": (0.7, 1.0), "time_gap": 1.0, "gains": [1.5, 1.5, -0.8]}
    assert stability.local_conditions(**bounds).holds.item()
    # C / K = 0.7 x 4.35 - 3 = 0.045 at K 0.7; the print's B = 1.56^2 - 2 x 0.4 x 3 = 0.0336.
    for form in ("rigorous", "print"):
        assert stability.string_sufficient(**bounds, form=form).item()
        assert not stability.string_sufficient(**bounds | {"K_L": (0.68, 1.0)}, form=form).item()
    assert not stability.string_stable(0.4, 0.68, 1.0, [1.5, 1.5, -0.8]).item()


@pytest.mark.parametrize(
    ("arguments", "form", "says"),
    [
        (((0.4, 0.1), 1.0), "rigorous", "T_L"),
        (((-0.1, 0.1), 1.0), "rigorous", "T_L"),
        ((0.3, (1.0, 0.7)), "print", "K_L"),
        ((0.3, (0.0, 0.7)), "print", "K_L"),
        (((0.1, 0.2, 0.3), 1.0), "print", "T_L"),
        ((0.3, 1.0), "printed", "form"),
    ],
)
def test_bad_boxes_are_refused(arguments, form, says):
    for function in (stability.local_conditions, stability.string_conditions, stability.string_sufficient):
        with pytest.raises(InputError, match=says):
            function(*arguments, 1.0, [1.5, 1.5, -0.8], form=form)
