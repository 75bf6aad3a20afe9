"""Settings: verdicts through the effective actuation, the strategies of Algorithm 2, and the grid that is on offer."""

import itertools
import math

import pytest
import torch

from avtorch.decision.algorithm2 import PAPER_GAINS, PAPER_TIME_GAP, algorithm2
from avtorch.decision.grid import GAINS_GRID, Grid, intrusiveness
from avtorch.decision.settings import DesignBounds, Setting
from avtorch.errors import InputError
from avtorch.vehicle import stability
from avtorch.vehicle.controllers import LinearController
from avtorch.vehicle.lower_level import LowerLevel


def test_verdicts_use_the_effective_actuation_of_every_draw(fresh_seed):
    generator = torch.Generator().manual_seed(fresh_seed)
    T = 0.2 + 2.0 * torch.rand(3, 50, generator=generator, dtype=torch.float64)
    K = 0.3 + torch.rand(3, 50, generator=generator, dtype=torch.float64)
    setting = Setting(
        T_hat=torch.tensor([0.3, 1.5, 1.0]),
        K_hat=torch.tensor([1.0, 0.5, 0.8]),
        time_gap=torch.tensor([1.0, 1.6, 2.5]),
        gains=torch.tensor([[1.5, 1.5, -0.8], [3.0, 3.0, -1.8], [1.5, 2.0, -0.8]]),
    )
    local, string = setting.p_locally_and_string_stable(T, K)
    assert torch.equal(string, setting.p_string_stable(T, K))
    for i in range(3):
        one = setting.as_dict(i)
        T_e, K_e = LowerLevel(one["T_hat"], one["K_hat"]).effective(T[i], K[i])
        expected = stability.string_stable(T_e, K_e, one["time_gap_s"], one["gains"]).double().mean()
        assert float(string[i]) == float(expected)
        expected = stability.local_stable(T_e, K_e, one["time_gap_s"], one["gains"]).double().mean()
        assert float(local[i]) == float(expected)
        gain = stability.peak_gain(T_e[0], K_e[0], one["time_gap_s"], one["gains"])
        assert float(setting.peak_gain(T[:, 0], K[:, 0])[i]) == float(gain)


def test_candidates_are_one_more_dimension():
    setting = Setting(time_gap=torch.tensor([[1.0, 2.5], [1.0, 2.5]]))
    T, K = torch.full((2, 1, 7), 1.5), torch.full((2, 1, 7), 0.5)
    assert setting.p_string_stable(T, K).tolist() == [[0.0, 1.0], [0.0, 1.0]]


def test_reference_values_of_the_specification():
    truth = (torch.tensor([1.5]), torch.tensor([0.5]))
    assert float(Setting().peak_gain(*truth)) == pytest.approx(2.2445, abs=5e-5)
    assert float(Setting(time_gap=2.0).peak_gain(*truth)) == pytest.approx(1.0767, abs=5e-5)
    assert float(Setting(gains=(3.0, 3.0, -1.8)).peak_gain(*truth)) == pytest.approx(1.4789, abs=5e-5)
    assert float(Setting(T_hat=1.5, K_hat=0.5).peak_gain(*truth)) == 1.0
    assert float(Setting(T_hat=1.5, K_hat=0.5).amplification()) == pytest.approx(10.0)


def test_strategies_are_distinguished():
    default = Setting(scenarios=5)
    changed = Setting(
        T_hat=torch.tensor([0.3, 1.5, 0.3, 0.3, 1.5]),
        # The fourth scenario models and aims at the same new actuation: the commands are those of the default.
        T_d=torch.tensor([0.3, 0.3, 0.3, 0.3, 0.3]),
        K_hat=torch.tensor([1.0, 0.5, 1.0, 0.7, 0.5]),
        K_d=torch.tensor([1.0, 1.0, 1.0, 0.7, 1.0]),
        time_gap=torch.tensor([1.0, 1.0, 1.6, 1.0, 2.5]),
        gains=torch.tensor([[1.5, 1.5, -0.8]] * 4 + [[1.5, 3.0, -0.8]], dtype=torch.float64),
    )
    assert changed.strategies(default) == [set(), {1}, {2}, set(), {1, 2, 3}]
    assert changed.strategies(changed) == [set()] * 5


def test_indexing_and_retargeting():
    a, b = Setting(scenarios=3), Setting(T_hat=1.5, time_gap=2.5, gains=(3.0, 3.0, -1.8), scenarios=3)
    assert b[torch.tensor([1])].as_dict()["T_hat"] == 1.5
    assert b[torch.tensor([1])].shape == (1,)
    moved = b.retarget(LinearController(a.gains, a.time_gap), at=10.0)
    assert moved.time_gap_at(10.0).tolist() == [1.0] * 3
    assert moved.time_gap_at(60.0).tolist() == [2.5] * 3
    assert b.lower_level(accel_min=-3.0, accel_max=2.0).accel_max == 2.0


def test_design_bounds_hold_their_coverage(fresh_seed):
    generator = torch.Generator().manual_seed(fresh_seed)
    z = torch.randn(2, 2, 4000, generator=generator, dtype=torch.float64)
    T, K = 1.5 * torch.exp(0.1 * z[0]), 0.5 * torch.exp(0.05 * (z[0] * 0.9 + 0.4 * z[1]))
    box = DesignBounds.of_belief(T, K, coverage=0.9)
    inside = (
        (box.T_L[0][:, None] <= T)
        & (box.T_L[1][:, None] >= T)
        & (box.K_L[0][:, None] <= K)
        & (box.K_L[1][:, None] >= K)
    )
    # Four tails of a quarter of a tenth each, counted on the draws themselves: only ties of a draw remain.
    assert bool((inside.double().mean(dim=1) >= 0.9 - 4 / 4000).all())
    assert not bool(stability.string_sufficient(box.T_L, box.K_L, 1.0, (1.5, 1.5, -0.8)).any())
    with pytest.raises(InputError, match="coverage"):
        DesignBounds.of_belief(T, K, coverage=1.0)


def test_the_robust_design_is_rechecked_over_the_posteriors_box():
    one = torch.ones(1, dtype=torch.float64)
    handbook = DesignBounds((0.1 * one, 0.4 * one), (0.7 * one, one))
    for form in ("print", "rigorous"):
        local, string = handbook.recheck(1.0, (1.5, 1.5, -0.8), form=form)
        assert local.holds.tolist() == string.holds.tolist() == [True]
    z = torch.randn(2, 1, 2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    T, K = 1.5 * torch.exp(0.03 * z[0]), 0.5 * torch.exp(0.02 * z[1])
    after = DesignBounds.of_belief(T, K)
    # Eq. 3 is only sufficient, and its first line falls with the gap: it refuses what the exact verdict passes
    for gap in (1.0, 2.5):
        local, string = after.recheck(gap, (1.5, 1.5, -0.8), form="print")
        assert local.holds.tolist() == [True]
        assert string.holds.tolist() == [False]
    assert float(Setting(time_gap=2.5).p_string_stable(T, K)) == 1.0
    passes = after.recheck(1.6, (1.5, 4.0, -5.0))
    assert all(bool(c.holds) for c in passes)
    assert float(Setting(time_gap=1.6, gains=(1.5, 4.0, -5.0)).p_string_stable(T, K)) == 1.0


@pytest.mark.parametrize(
    "bad",
    [
        {"T_hat": 0.0},
        {"K_hat": -1.0},
        {"T_d": float("nan")},
        {"K_d": float("inf")},
        {"time_gap": torch.tensor([1.0, -1.0])},
        {"gains": (1.5, 1.5)},
        {"gains": (1.5, float("nan"), -0.8)},
        {"T_hat": torch.ones(2), "K_hat": torch.ones(3)},
    ],
)
def test_bad_values_are_refused(bad):
    with pytest.raises(InputError):
        Setting(**bad)


# Algorithm 2, branch by branch, and the paper's own settings tested both ways.
# Inside the boundary; outside and stable; outside and unstable by T; outside and unstable by K.
T = torch.tensor([0.4, 0.55, 1.5, 0.3], dtype=torch.float64)
K = torch.tensor([0.9, 1.0, 0.5, 0.4], dtype=torch.float64)


def test_branches_with_a_longer_time_gap():
    taken = algorithm2(T, K, Setting(scenarios=4), choose="time_gap", check="exact")
    assert taken.outside.tolist() == [False, True, True, True]
    assert taken.stable.tolist() == [True, True, False, False]
    assert taken.lower_level_updated.tolist() == [False, True, True, True]
    assert taken.time_gap_increased.tolist() == [False, False, True, True]
    assert taken.gains_increased.tolist() == [False] * 4
    assert taken.setting.T_hat.tolist() == [0.3, 0.55, 1.5, 0.3]
    assert taken.setting.K_hat.tolist() == [1.0, 1.0, 0.5, 0.4]
    assert taken.setting.time_gap.tolist() == [1.0, 1.0, PAPER_TIME_GAP, PAPER_TIME_GAP]
    assert taken.setting.strategies(Setting(scenarios=4)) == [set(), {1}, {1, 2}, {1, 2}]


def test_branches_with_larger_gains():
    taken = algorithm2(T, K, Setting(scenarios=4), choose="gains", check="exact")
    assert taken.time_gap_increased.tolist() == [False] * 4
    assert taken.gains_increased.tolist() == [False, False, True, True]
    assert taken.setting.gains[2].tolist() == list(PAPER_GAINS)
    assert taken.setting.gains[1].tolist() == [1.5, 1.5, -0.8]


def test_the_printed_check_is_only_sufficient():
    # B < 0 but B² <= 4 T² C: Eq. 3 fails at a vehicle that is string stable.
    lag, gain = torch.tensor([0.7]), torch.tensor([1.0])
    assert algorithm2(lag, gain, Setting(), check="exact").stable.tolist() == [True]
    assert algorithm2(lag, gain, Setting(), check="print").stable.tolist() == [False]


def test_the_boundary_may_be_given():
    taken = algorithm2(T[2:3], K[2:3], Setting(), accepted=(1.4, 0.55))
    assert taken.outside.tolist() == [False]
    assert algorithm2(T[2:3], K[2:3], Setting(), accepted=(1.4, 0.55), change=(0.05, 0.15)).outside.tolist() == [True]


def test_papers_settings_at_its_estimate_both_ways():
    estimate, truth = (torch.tensor([1.33]), torch.tensor([0.64])), (torch.tensor([1.5]), torch.tensor([0.5]))
    gap = algorithm2(*estimate, Setting(), choose="time_gap").setting
    gains = algorithm2(*estimate, Setting(), choose="gains").setting
    # With the lower-level update the paper prescribes both reach string stability at the truth ...
    assert float(gap.peak_gain(*truth)) == 1.0
    assert float(gains.peak_gain(*truth)) == 1.0
    # ... without it neither does (SPEC section 2).
    assert float(gap.replace(T_hat=0.3, K_hat=1.0).peak_gain(*truth)) == pytest.approx(1.0767, abs=5e-5)
    assert float(gains.replace(T_hat=0.3, K_hat=1.0).peak_gain(*truth)) == pytest.approx(1.4789, abs=5e-5)


def test_bad_choices_are_refused():
    with pytest.raises(InputError, match="new_time_gap"):
        algorithm2(T, K, Setting(time_gap=2.5, gains=(1.5, 1.5, 0.9), scenarios=4), new_time_gap=2.0, check="exact")
    with pytest.raises(InputError, match="new_gains"):
        algorithm2(T, K, Setting(scenarios=4), choose="gains", new_gains=(3.0, 1.0, -1.8))
    with pytest.raises(InputError, match="choose"):
        algorithm2(T, K, Setting(scenarios=4), choose="both")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="check"):
        algorithm2(T, K, Setting(scenarios=4), check="guess")  # type: ignore[arg-type]


# The grid of settings: what is on offer, and that the stated costs are the costs.
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
