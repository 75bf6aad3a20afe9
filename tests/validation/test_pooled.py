"""The loop against one inference on all windows, and on vehicles that change."""

from __future__ import annotations

import math

import pytest
import torch

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, JerkStatistics, integrate
from avtorch.validation.windows import simulate_windows
from benchmarks.pooled import (
    FreeNoise,
    PooledComparison,
    constant,
    drift,
    pool,
    step,
    track_loop,
    truth_given_all,
    windows_of,
)
from benchmarks.sine_windows import sine_commands

F64 = torch.float64


def fleet(count: int) -> torch.Tensor:
    """Vehicles with well resolved windows: ``log(T_L, K_L, sigma)``."""
    share = torch.linspace(0, 1, count, dtype=F64)
    return torch.stack([0.3 + 0.7 * share, 1.0 - 0.4 * share, 0.1 + 0.0 * share], -1).log()


def test_sums_of_windows_are_sums_of_all_rows(fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    z = fleet(3)
    rows = [
        (*simulate_windows(z, u, generator=g), u) for u in (sine_commands(3, 50, 1.0, generator=g) for _ in range(4))
    ]
    parts = [JerkStatistics.from_samples(a, u, jerk) for a, jerk, u in rows]
    a, jerk, u = (torch.cat(column, -1) for column in zip(*rows, strict=True))
    whole = JerkStatistics.from_samples(a, u, jerk)
    for name in ("n", "jj", "aj", "uj", "aa", "au", "uu"):
        assert torch.allclose(getattr(pool(parts), name), getattr(whole, name), rtol=1e-10)


@pytest.mark.parametrize("amplitude", [1.0, 0.2])
def test_one_window_with_a_sigma_of_its_own_is_that_window(amplitude, fresh_seed):
    """With one window both are the same posterior: that of the vehicle with sigma integrated out."""
    g = torch.Generator().manual_seed(fresh_seed)
    (seen,) = windows_of(constant(fleet(4), 1), amplitude=amplitude, generator=g)
    free, whole = integrate(FreeNoise([seen])), integrate(JerkDensity(seen))
    assert torch.allclose(free.log_evidence, whole.log_evidence, atol=1e-5)
    assert ((free.mean - whole.mean[:, :2]) / free.sd).abs().max() < 1e-4
    assert torch.allclose(free.sd, whole.sd[:, :2], rtol=1e-4)


def test_selected_vehicles_keep_their_density(fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    density = FreeNoise(windows_of(constant(fleet(3), 2), generator=g))
    z = fleet(3)[:, :2]
    index = torch.tensor([2, 0])
    assert density.select(index).log_prob(z[index]).equal(density.log_prob(z)[index])
    assert density.constrain(z).equal(z.exp())


@pytest.mark.statistical
def test_posterior_mode_ends_where_the_pooled_posterior_is(rotating_seed):
    """Four well excited windows.

    Each step carries on the moments of at least a thousand effective draws, an error of 1/sqrt(1000) SD in the mean:
    after four steps 5 sigma are 0.32 SD, and in the SD of the last step 0.11. The normal itself errs by the skewness of
    a well excited window's posterior, which is of order SD/T, below 0.1.
    """
    g = torch.Generator().manual_seed(rotating_seed)
    path = constant(fleet(10), 4)
    seen = windows_of(path, generator=g)
    pooled = truth_given_all(seen)
    found = PooledComparison.of(track_loop(path, seen, mode="posterior", seed=rotating_seed), pooled)
    assert pooled.converged.all()
    assert found.shift.abs().max() < 0.32 + 0.1
    assert (found.sd_ratio - 1).abs().max() < 0.11 + 0.1
    assert found.select(torch.tensor([3])).shift.equal(found.shift[3:4])
    # lambda I forgets all but the last of four windows: twice the SD, within what windows of other phases differ
    loose = PooledComparison.of(track_loop(path, seen, mode="lambda", seed=rotating_seed), pooled)
    assert 1.5 < loose.sd_ratio[:, :2].median() < 2.8


@pytest.mark.statistical
def test_a_sigma_of_its_own_for_every_window_costs_little(rotating_seed):
    """Where all windows have the same sigma, letting it vary loses of order one part in 2 n of the information."""
    g = torch.Generator().manual_seed(rotating_seed)
    seen = windows_of(constant(fleet(5), 3), generator=g)
    shared, free = truth_given_all(seen), truth_given_all(seen, shared_noise=False)
    assert free.names == ("T_L", "K_L")
    assert ((free.sd / shared.sd[:, :2]) - 1).abs().max() < 0.15


def test_paths():
    z, later = fleet(2), fleet(2) + 1
    stays, steps = constant(z, 4), step(z, later, 4, at=3)
    assert stays.shape == (4, 2, 3)
    assert steps[2].equal(z)
    assert steps[3, :, :2].equal(later[:, :2])
    assert steps[3, :, 2].equal(z[:, 2])
    rate = torch.tensor([[0.1, -0.1]], dtype=F64).expand(2, 2)
    drifts = drift(z, rate, 4)
    assert torch.allclose(drifts[3] - z, torch.tensor([0.3, -0.3, 0.0], dtype=F64).expand(2, 3))


@pytest.mark.statistical
def test_lambda_follows_a_step_that_posterior_mode_does_not(rotating_seed):
    g = torch.Generator().manual_seed(rotating_seed)
    z = torch.tensor([[0.3, 1.0, 0.1]], dtype=F64).log().expand(10, -1)
    later = torch.tensor([[1.0, 0.6, 0.1]], dtype=F64).log().expand(10, -1)
    path = step(z, later, 4, at=3)
    seen = windows_of(path, generator=g)
    follows, stays = (track_loop(path, seen, mode=mode, seed=rotating_seed) for mode in ("lambda", "posterior"))
    assert follows.covered.shape == (4, 10, 3)
    # an SD of about 3 %; posterior mode is between three windows at 0.3 s and one at 1 s
    assert follows.relative_error[-1, :, 0].median() < 0.2
    assert stays.relative_error[-1, :, 0].median() > 0.3
    assert math.isclose(float(follows.truth[-1, 0, 0]), 1.0)


def test_bad_arguments_are_refused_by_name():
    with pytest.raises(InputError, match=r"^windows: "):
        pool([])
    with pytest.raises(InputError, match=r"^path, windows: "):
        track_loop(constant(fleet(2), 3), windows_of(constant(fleet(2), 2)), mode="lambda")
