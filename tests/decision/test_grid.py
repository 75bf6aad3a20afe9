"""The grid of settings: what is on offer, and that the stated costs are the costs."""

import itertools
import math

import pytest
import torch

from avtorch.decision.grid import GAINS_GRID, Grid, intrusiveness
from avtorch.decision.settings import Setting
from avtorch.errors import InputError


def offered(grid, *, T=1.5, K=0.5, default=None, current=None, wrong=True):
    default = Setting() if default is None else default
    found = grid.candidates(
        torch.tensor([T], dtype=torch.float64),
        torch.tensor([K], dtype=torch.float64),
        current=default if current is None else current,
        default=default,
        model_wrong=torch.tensor([wrong]),
    )
    keep = torch.isfinite(found.cost[0])
    return found.setting[0][keep], found.cost[0][keep]


def test_everything_stated_is_on_offer_once():
    setting, _ = offered(Grid())
    # Lower level: kept, or one of four targets; three gaps; the default's gains are one of the grid's.
    assert setting.shape[0] == 5 * 3 * len(GAINS_GRID)
    rows = {
        tuple(round(x, 9) for x in (*s[:5], *s[5]))
        for s in zip(*(getattr(setting, n).tolist() for n in vars(setting)), strict=True)
    }
    assert len(rows) == setting.shape[0]
    targets = sorted({round(x, 6) for x in setting.T_d.tolist()})
    assert targets[0] == pytest.approx(0.3)
    assert targets[-1] == pytest.approx(1.5)
    steps = [b / a for a, b in itertools.pairwise(targets)]
    assert steps == pytest.approx([steps[0]] * 3, rel=1e-4)


def test_no_gap_shorter_than_the_default_and_no_doubled_update_of_a_fast_car():
    setting, _ = offered(Grid(), T=0.2, K=1.0, default=Setting(time_gap=1.6))
    assert sorted(set(setting.time_gap.tolist())) == [1.6, 2.5]
    assert setting.shape[0] == 2 * 2 * len(GAINS_GRID)
    setting, _ = offered(Grid(), default=Setting(time_gap=1.2))
    assert sorted(set(setting.time_gap.tolist())) == [1.2, 1.6, 2.5]


@pytest.mark.parametrize(("allowed", "count"), [({1}, 5), ({2}, 3), ({3}, len(GAINS_GRID)), (set(), 1)])
def test_only_what_is_allowed(allowed, count):
    setting, _ = offered(Grid(allowed=frozenset(allowed)))
    assert setting.shape[0] == count
    assert set().union(*setting.strategies(Setting(scenarios=count))) == allowed


def test_the_stated_costs():
    def cost(stale=False, **setting):
        return float(intrusiveness(Setting(**setting), Setting(), torch.tensor([stale])))

    assert cost() == 0.0
    assert cost(stale=True) == 3.0
    assert cost(time_gap=1.6) == pytest.approx(3.3)
    assert cost(time_gap=2.5) == pytest.approx(6.0)
    assert cost(gains=(1.5, 3.0, -0.8)) == pytest.approx(3.0)
    assert cost(T_hat=1.5, K_hat=0.5) == pytest.approx(1.0 + 0.5 * math.log2(10.0))
    assert cost(T_hat=0.15, K_hat=1.0) == pytest.approx(1.0)  # less effort than the default is no merit
    both = cost(time_gap=1.6, gains=(1.5, 3.0, -0.8))
    assert both == pytest.approx(3.3 + 3.0 + 2.0)
    assert both > cost(time_gap=2.5)
    # Strategy 1 alone is less intrusive than any change of the upper level; both of a kind cost the sum.
    assert cost(T_hat=1.5, K_hat=0.5) < cost(time_gap=1.6, stale=True)
    assert cost(T_hat=1.5, K_hat=0.5, time_gap=1.6) == pytest.approx(cost(T_hat=1.5, K_hat=0.5) + 3.3)


def test_keeping_a_wrong_model_has_its_price_and_a_right_one_has_none():
    for wrong, price in ((True, 3.0), (False, 0.0)):
        setting, cost = offered(Grid(), wrong=wrong)
        kept = [i for i, s in enumerate(setting.strategies(Setting(scenarios=setting.shape[0]))) if s == set()]
        assert len(kept) == 1
        assert float(cost[kept[0]]) == price


def test_what_is_in_force_comes_first_and_anything_else_costs_the_switch():
    current = Setting(T_hat=1.0, K_hat=0.8, time_gap=2.0, gains=(2.0, 2.0, -1.0))
    setting, cost = offered(Grid(allowed=frozenset()), current=current, wrong=False)
    assert setting.as_dict(0) == current.as_dict()
    # Gap and gains may go back to the default; the lower level stays.
    assert setting.shape[0] == 4
    price = intrusiveness(setting, Setting(), torch.zeros(4, dtype=torch.bool))
    assert (cost - price).tolist() == pytest.approx([0.0, 1.0, 1.0, 1.0])


def test_gains_that_follow_from_the_gap_are_no_strategy():
    grid = Grid(gains_of_gap=lambda gap: (1.0, 2.0 / gap, -0.5))
    default = Setting(gains=(1.0, 2.0, -0.5))
    setting, cost = offered(grid, default=default)
    assert setting.shape[0] == 5 * 3
    torch.testing.assert_close(setting.gains[:, 1], 2.0 / setting.time_gap)
    only_gap = (setting.T_hat == 0.3) & (setting.time_gap == 1.6)
    assert cost[only_gap].tolist() == pytest.approx([3.0 + 3.3 + 1.0])


@pytest.mark.parametrize(
    "bad", [{"allowed": frozenset({5})}, {"time_gaps": (0.0,)}, {"targets": (2.0,)}, {"gains": ((1.0, 2.0),)}]
)
def test_impossible_grids_are_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        Grid(**bad)
