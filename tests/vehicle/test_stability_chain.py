"""The general chain against the exact verdicts, where both apply, and against a simulation where only it does."""

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle.stability import (
    Chain,
    actuator,
    chain_verdict,
    frequencies,
    local_stable,
    peak_gain,
    string_stable,
)

NOMINAL = torch.tensor([1.5, 1.5, -0.8], dtype=torch.float64)


@pytest.mark.statistical
@pytest.mark.slow
def test_as_the_exact_verdicts_of_glvd_with_dead_time(rotating_seed: int) -> None:
    generator = torch.Generator().manual_seed(rotating_seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    n = 1000
    T, K, tau = uniform(0.1, 1.8, n), uniform(0.4, 1.2, n), uniform(0.5, 2.5, n)
    theta = uniform(0.0, 0.8, n) * (uniform(0, 1, n) < 0.7)
    gains = torch.stack([uniform(0.2, 2.0, n), uniform(0.2, 3.0, n), uniform(-2.0, 0.5, n)], -1)
    seen = chain_verdict(actuator(frequencies(points=4000), T, K, theta), tau, gains)
    want = local_stable(T, K, tau, gains, dead_time=theta)
    # a mode that neither grows nor decays to speak of may hide between two frequencies 0.25 % apart
    assert float((seen.locally_stable != want).double().mean()) < 0.003
    usual = chain_verdict(actuator(frequencies(), T, K, theta), tau, gains)
    assert float((usual.locally_stable != want).double().mean()) < 0.01
    peak = peak_gain(T, K, tau, gains, dead_time=theta)
    # halfway between two frequencies a resonance of quality Q is lower by (0.0025 Q)^2 / 2, and by 49 times that on
    # the usual grid; Q is some ten times the peak at most where that is below three
    both = want & seen.locally_stable & usual.locally_stable & (peak < 3)
    torch.testing.assert_close(seen.peak_gain[both], peak[both], rtol=3e-3, atol=2e-4)
    torch.testing.assert_close(usual.peak_gain[both], peak[both], rtol=0.14, atol=2e-4)
    string = string_stable(T, K, tau, gains, dead_time=theta)
    border = (peak - 1).abs() < 2e-4
    assert bool((seen.string_stable == string)[both & ~border].all())


@pytest.mark.statistical
def test_the_lower_level_is_the_effective_actuation(rotating_seed: int) -> None:
    generator = torch.Generator().manual_seed(rotating_seed)
    T = 0.3 + torch.rand(500, generator=generator, dtype=torch.float64)
    K = 0.6 + 0.5 * torch.rand(500, generator=generator, dtype=torch.float64)
    T_hat, K_hat, T_d, K_d = 0.8, 0.8, 0.3, 1.0
    inner, forward = T_hat / K_hat * (1 / T_hat - 1 / T_d), T_hat * K_d / (K_hat * T_d)
    r = K * T_hat / (T * K_hat)
    T_e = 1 / (1 / T - r * (1 / T_hat - 1 / T_d))
    K_e = r * K_d * T_e / T_d
    seen = chain_verdict(
        actuator(frequencies(), T, K), torch.tensor(1.0, dtype=torch.float64), NOMINAL, inner=inner, forward=forward
    )
    assert float((seen.locally_stable != local_stable(T_e, K_e, 1.0, NOMINAL)).double().mean()) < 0.01
    peak = peak_gain(T_e, K_e, 1.0, NOMINAL)
    fine = (peak < 5) & seen.locally_stable
    torch.testing.assert_close(seen.peak_gain[fine], peak[fine], rtol=0.03, atol=2e-4)


def test_the_dead_time_of_the_specification() -> None:
    T, K = (torch.tensor(x, dtype=torch.float64) for x in (0.3, 1.0))
    one = torch.tensor(1.0, dtype=torch.float64)
    seen = chain_verdict(actuator(frequencies(points=3000), T, K, 0.4), one, NOMINAL)
    assert float(seen.peak_gain) == pytest.approx(1.7464, abs=1e-3)
    assert not bool(chain_verdict(actuator(frequencies(), T, K, 0.65), one, NOMINAL).locally_stable)
    assert bool(chain_verdict(actuator(frequencies(), T, K, 0.5), one, NOMINAL).locally_stable)


def test_a_second_pole_and_drag_against_the_eigenvalues(fresh_seed: int) -> None:
    """Rational chains have a polynomial whose roots NumPy finds."""
    rng = np.random.default_rng(fresh_seed)
    omega = frequencies()
    s = 1j * omega
    for _ in range(300):
        w, zeta, d, late = rng.uniform(1, 8), rng.uniform(0.1, 1.2), rng.uniform(0, 0.1), rng.uniform(0.02, 0.6)
        k = np.array([rng.uniform(0.3, 2), rng.uniform(0.3, 3), rng.uniform(-2, 0.3)])
        tau = rng.uniform(0.6, 2.0)
        motion, sensed = 1 / (1 + 2 * zeta * s / w + (s / w) ** 2), 1 / (1 + late * s)
        chain = Chain(omega, motion, sensed, torch.tensor(d, dtype=torch.float64))
        seen = chain_verdict(chain, torch.tensor(tau, dtype=torch.float64), torch.as_tensor(k))
        g = k[0] * tau + k[1]
        pole, lag = np.array([1 / w**2, 2 * zeta / w, 1]), np.array([late, 1])
        free = np.polymul(np.polymul(pole, lag), [1, d, 0])
        asked = np.polyadd(np.polymul(lag, [g, k[0]]), [-k[2], 0, 0])
        roots = np.roots(np.polyadd(free, asked))
        if abs(roots.real.max()) > 0.02:
            assert bool(seen.locally_stable) == bool(roots.real.max() < 0)


def test_wrong_chains_are_refused() -> None:
    omega = frequencies(points=20)
    one = torch.ones(20, dtype=torch.complex128)
    with pytest.raises(InputError, match="omega"):
        Chain(omega.flip(0), one, one, torch.zeros(()))
    with pytest.raises(InputError, match="sensed"):
        Chain(omega, one, one[:-1], torch.zeros(()))


def test_feed_forward_is_that_of_the_exact_verdicts(fresh_seed: int) -> None:
    generator = torch.Generator().manual_seed(fresh_seed)
    T, K, kf = torch.rand(3, 300, generator=generator, dtype=torch.float64)
    T, K, kf = 0.3 + 1.2 * T, 0.5 + 0.6 * K, 1.5 * kf
    tau, far = torch.tensor(1.2, dtype=torch.float64), frequencies(points=4000)
    for delay in (0.0, 0.3):
        seen = chain_verdict(actuator(far, T, K), tau, NOMINAL, feedforward=kf, feedforward_delay=delay)
        want = peak_gain(T, K, tau, NOMINAL, feedforward=kf, feedforward_delay=delay)
        # these loops are well damped: between frequencies 0.25 % apart a peak falls by far less than its square
        torch.testing.assert_close(seen.peak_gain, want, rtol=1e-3, atol=2e-4)
    silent = chain_verdict(actuator(far, T, K), tau, NOMINAL)
    assert float((silent.peak_gain - seen.peak_gain).abs().max()) > 0.05
