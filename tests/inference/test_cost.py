"""What a window costs: many vehicles side by side must not cost what they would one by one."""

from __future__ import annotations

import time

import pytest
import torch

from avtorch.inference import JerkDensity, JerkStatistics, SamplerSettings, SequentialInference


def cost(statistics: JerkStatistics) -> float:
    """Best of three updates [s], so that a busy machine matters little; 64 chains, as a fleet would have."""
    vehicles = len(statistics.n)
    loop = SequentialInference(vehicles=vehicles, settings=SamplerSettings(chains=64, draws=60))
    excited = torch.ones(vehicles, dtype=torch.bool)
    spent = []
    for _ in range(4):
        begun = time.perf_counter()
        loop.update(lambda i, p: JerkDensity(statistics.select(i), p), excited)
        spent.append(time.perf_counter() - begun)
    return min(spent[1:])


@pytest.mark.slow
def test_a_hundred_vehicles_cost_far_less_than_a_hundred_times_one(make_windows):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        statistics = make_windows(0, [1.0]).statistics
        one, hundred = cost(statistics), cost(statistics.select(torch.zeros(100, dtype=torch.long)))
    finally:
        torch.set_num_threads(threads)
    assert hundred < 30 * one


def test_the_cost_does_not_grow_with_the_points(make_windows):
    """Six sums a window, however long it is."""
    density = [JerkDensity(make_windows(0, [1.0], rows=rows).statistics) for rows in (100, 5000)]
    z = torch.zeros(64, 1, 3, dtype=torch.float64)
    spent = []
    for d in density:
        best = float("inf")
        for _ in range(20):
            begun = time.perf_counter()
            for _ in range(10):
                d.score(z)
            best = min(best, time.perf_counter() - begun)
        spent.append(best)
    assert spent[1] < 3 * spent[0]
