"""Agreement of held-out blocks: what chance reaches, and what a single block is worth."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.gap.budget.held_out_evidence import FALSE_ALARMS, Evidence, agreement


def test_blocks_that_agree_are_stronger_than_one_that_shouts() -> None:
    size = np.full(12, 10.0)
    alike = agreement(size * 1.0, size)
    loud = agreement(np.where(np.arange(12) == 3, 120.0, 0.0), size)
    assert alike[0] > 5 * abs(loud[0])
    # an effect that shows in a single block has no degrees of freedom to speak of, however much it gains
    single = agreement(np.where(np.arange(12) == 3, 120.0, 0.0), np.where(np.arange(12) == 3, 120.0, 1e-3))
    assert single[1] == pytest.approx(1.0, abs=0.01)
    assert Evidence(60.0, *single).strength(10) < Evidence(60.0, *alike).strength(10)


def test_nothing_to_see_is_no_evidence() -> None:
    assert agreement(np.zeros(8), np.zeros(8))[0] == 0.0
    assert Evidence(0.0, 0.0, 5.0).strength() < 0


def test_more_effects_tried_ask_for_more() -> None:
    strengths = [Evidence(12.0, 4.0, 10.0).strength(tried) for tried in (1, 5, 20)]
    assert strengths == sorted(strengths, reverse=True)
    assert strengths[0] > strengths[-1]


@pytest.mark.statistical
def test_wrong_effects_enter_no_more_often_than_said(rotating_seed: int) -> None:
    """The best of twenty scores of pure noise over blocks of unequal size."""
    rng = np.random.default_rng(rotating_seed)
    trials, tried, blocks = 400, 20, 16
    entered = 0
    for _ in range(trials):
        size = rng.gamma(2.0, 1.0, (tried, blocks))
        score = rng.normal(0.0, np.sqrt(size))
        # nats as large as can be, so that agreement alone decides
        entered += any(Evidence(1e6, *agreement(s, q)).strength(tried) > 0 for s, q in zip(score, size, strict=True))
    # 4.9 standard errors of a share of FALSE_ALARMS in so many trials; the law is approximate in its degrees of freedom
    assert entered / trials < FALSE_ALARMS + 4.9 * np.sqrt(FALSE_ALARMS * (1 - FALSE_ALARMS) / trials)
