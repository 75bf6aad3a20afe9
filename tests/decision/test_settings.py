"""The setting: verdicts through the effective actuation, strategies distinguished, bad values refused."""

import pytest
import torch

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
