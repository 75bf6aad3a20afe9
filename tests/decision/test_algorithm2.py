"""Algorithm 2, branch by branch, and the paper's own settings tested both ways."""

import pytest
import torch

from avtorch.decision.algorithm2 import PAPER_GAINS, PAPER_TIME_GAP, algorithm2
from avtorch.decision.settings import Setting
from avtorch.errors import InputError

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
