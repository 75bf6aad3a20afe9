"""The sweep: what is counted, by hand on made-up sweeps; and one small sweep for real."""

from __future__ import annotations

import pytest
import torch

from avtorch.paper import Leaders, estimation
from avtorch.paper.estimation import GAINS, LAGS, Estimation, Sweep
from tests.bars import BAR

TRUTH = torch.tensor([(T, 1.0) for T in LAGS] + [(0.3, K) for K in GAINS], dtype=torch.float64)
SETTINGS, SEEDS = len(TRUTH), 4


def made_up(error: torch.Tensor, used: torch.Tensor, inside: torch.Tensor) -> Sweep:
    """Errors (setting, seed, 2) added to the truth."""
    mean = TRUTH[:, None] + error
    ahead = Leaders.read().main
    return Sweep(ahead, TRUTH, mean, mean - 1, mean + 1, used, inside, torch.ones(SETTINGS, SEEDS).double())


def row(found: Estimation, quantity: str, setting: str = ""):
    return next(r for r in found.rows if r.quantity == quantity and setting in r.setting)


def test_counts_and_slopes_by_hand() -> None:
    # errors of T_L go with T_L squared, those of K_L with 1 / K_L
    error = torch.stack([TRUTH[:, :1].square(), 1 / TRUTH[:, 1:]], -1).expand(SETTINGS, SEEDS, 2) * 0.01
    used = torch.ones(7, SETTINGS, SEEDS, dtype=torch.bool)
    used[:, 1] = False
    used[0, 1] = True
    inside = torch.ones(7, SETTINGS, SEEDS, 2, dtype=torch.bool)
    inside[0, 2] = False
    inside[3, 1] = False  # in a window that was not used: it counts for nothing
    found = Estimation([made_up(error, used, inside)], seed=0)
    intervals = 2 * int(used.sum())
    assert row(found, "coverage of the 90 % interval").ours == pytest.approx(1 - 2 * SEEDS / intervals)
    assert row(found, "coverage of the 90 % interval").verdict == "not reproduced"
    growth = row(found, "exponent of the error of T_L in T_L")
    assert (growth.ours, growth.verdict) == (pytest.approx(2.0), "same")
    fall = row(found, "exponent of the error of K_L in K_L")
    assert (fall.ours, fall.verdict) == (pytest.approx(-1.0), "same")
    assert row(found, "exponent of the relative error of K_L in K_L").ours == pytest.approx(-2.0)
    known = row(found, "share of settings with at least half of the windows excited")
    assert known.ours == pytest.approx(1 - 1 / SETTINGS)
    assert (known.verdict, "T_L 0.2 s: too few" in known.why) == ("not reproduced", True)


@pytest.mark.statistical
@pytest.mark.slow
def test_a_small_sweep_covers_the_truth(rotating_seed: int) -> None:
    found = estimation(Leaders.read(), seeds=2, seed=rotating_seed)
    assert [s.truth.shape for s in found.sweeps] == [(15, 2)]
    sweep = found.sweeps[0]
    assert sweep.used.shape == (7, 15, 2)
    coverage = row(found, "coverage of the 90 % interval")
    # T_L and K_L of a window go together: half as many independent intervals at worst
    independent = int(sweep.used.sum())
    assert independent > 100
    assert coverage.ours == pytest.approx(0.9, abs=BAR * (0.09 / independent) ** 0.5)
    # behind US06 the lag of the slowest vehicle is known to a few per cent
    assert float(sweep.error[..., 0].max()) < 0.5
