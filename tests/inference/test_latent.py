"""The latent form: one number by a dense normal and by the filter in torch, and its density."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from avtorch.errors import InputError
from avtorch.inference.latent import (
    FINEST,
    LatentDensity,
    LatentWindow,
    default_noise_prior,
    even_steps,
    latent_names,
)
from avtorch.inference.latent_model import ACCEL_SD0, SPEED_SD0, discretise, latent_log_likelihood
from avtorch.inference.map import find_mode
from avtorch.inference.priors import Joint, default_actuation_prior
from avtorch.inference.sampler import SamplerSettings, sample
from tests.bars import BAR

T, K, Q, ROAD, SD, TIME, ACCEL, SPEED = 0.3, 0.9, 0.15, 0.02, 0.2, 1.5, 0.1, 0.03
TRUTH = {"T_L": T, "K_L": K, "process_noise": Q, "road_noise": ROAD, "coloured_sd": SD, "coloured_time": TIME} | {
    "accel_noise": ACCEL,
    "speed_noise": SPEED,
}


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def record(rows: int, generator: torch.Generator, *, jitter: float = 0.0, dt: float = 0.02) -> tuple[Tensor, ...]:
    """Times, command, acceleration and speed of no particular vehicle."""
    steps = dt * (1 + jitter * (torch.rand(rows, generator=generator, dtype=torch.float64) - 0.5))
    u, noise = torch.randn(2, rows, generator=generator, dtype=torch.float64)
    a = u.cumsum(0) / 10 + noise / 10
    return steps.cumsum(0), u, a, 8 + (a * dt).cumsum(0) + noise / 30


def dense_log_likelihood(time: Tensor, u: Tensor, used: Tensor, accel: Tensor | None, speed: Tensor | None) -> float:
    """The same law as one big normal, built with matrix exponentials instead of the model's closed forms.

    An interval's noise covariance is the upper right block of exp([[-A, BBᵀ], [0, Aᵀ]] dt) (Van Loan).
    """
    A = torch.zeros(4, 4, dtype=torch.float64)
    rate = math.sqrt(3) / TIME
    A[0, 1] = A[2, 3] = 1.0
    A[1, 1], A[3, 2], A[3, 3] = -1 / T, -(rate**2), -2 * rate
    drive = torch.diag(f64(ROAD**2, Q**2, 0.0, 4 * rate * SD**2))
    n = len(time)
    mean, cov = torch.zeros(n, 4, dtype=torch.float64), torch.zeros(n, 4, n, 4, dtype=torch.float64)
    cov[0, :, 0] = torch.diag(f64(SPEED_SD0**2, ACCEL_SD0**2, (SD / rate) ** 2, SD**2))
    for k in range(n - 1):
        dt = float(time[k + 1] - time[k])
        phi = torch.linalg.matrix_exp(A * dt)
        loan = torch.linalg.matrix_exp(torch.cat((torch.cat((-A, drive), 1), torch.cat((0 * A, A.T), 1))) * dt)
        held = torch.zeros(5, 5, dtype=torch.float64)
        held[:4, :4], held[1, 4] = A, K / T * u[k]
        mean[k + 1] = phi @ mean[k] + torch.linalg.matrix_exp(held * dt)[:4, 4]
        for j in range(k + 1):
            cov[k + 1, :, j] = phi @ cov[k, :, j]
            cov[j, :, k + 1] = cov[k + 1, :, j].T
        cov[k + 1, :, k + 1] = phi @ cov[k, :, k] @ phi.T + loan[4:, 4:].T @ loan[:4, 4:]
    rows, data, noise = [], [], []
    channels = ((speed, f64(1, 0, 1, 0), SPEED), (accel, f64(0, 1, 0, 1), ACCEL))
    for signal, seen, sd in channels:
        if signal is not None:
            centre = float(signal[used][0]) if signal is speed else 0.0
            rows.append(torch.einsum("nm,i->nmi", torch.eye(n, dtype=torch.float64), seen)[used])
            data.append(signal[used] - centre)
            noise += [sd**2] * int(used.sum())
    H = torch.cat(rows).flatten(1)
    spread = H @ cov.reshape(4 * n, 4 * n) @ H.T + torch.diag(f64(*noise))
    law = torch.distributions.MultivariateNormal(H @ mean.flatten(), spread)
    return float(law.log_prob(torch.cat(data)))


CHANNELS = pytest.mark.parametrize("channels", ["speed", "accel", "both"])


def pick(channels: str, accel: Tensor, speed: Tensor) -> dict[str, Tensor | None]:
    return {"accel": None if channels == "speed" else accel, "speed": None if channels == "accel" else speed}


@CHANNELS
def test_filter_equals_dense_normal_with_jitter_a_gap_and_masked_rows(channels: str, fresh_seed: int) -> None:
    generator = torch.Generator().manual_seed(fresh_seed)
    time, u, a, v = record(40, generator, jitter=0.8)
    time[25:] += 0.7
    used = torch.ones(40, dtype=torch.bool)
    used[[0, 7, 8, 30]] = False
    a[7], v[7] = torch.nan, torch.nan
    measured = pick(channels, a, v)
    lag = f64(T).requires_grad_()
    ours = latent_log_likelihood(
        lag, K, Q, SD, TIME, time, u, mask=used, accel_noise=ACCEL, speed_noise=SPEED, road_noise=ROAD, **measured
    )
    assert bool(torch.autograd.grad(ours.sum(), lag, retain_graph=True)[0].isfinite())
    # Round-off: the diffuse start's variance of 100 against 1e-3 costs five of sixteen digits.
    assert float(ours.detach()) == pytest.approx(dense_log_likelihood(time, u, used, **measured), abs=1e-8)


def test_discretisation_is_exact_over_the_switch_to_the_series() -> None:
    """Two half steps make one step, on both sides of the point where the closed form takes over from the series."""
    for lag, length in ((0.01, 0.1), (0.19, 0.34), (0.21, 0.36), (5.0, 20.0)):
        half, full = (
            discretise(f64(lag), f64(K), f64(Q), f64(ROAD), f64(SD), f64(length), f64(dt)) for dt in (0.05, 0.1)
        )
        phi = half.transition
        torch.testing.assert_close(full.transition, phi @ phi, rtol=1e-13, atol=1e-15)
        torch.testing.assert_close(full.gain, (phi @ half.gain[..., None])[..., 0] + half.gain, rtol=1e-12, atol=1e-15)
        torch.testing.assert_close(full.noise, phi @ half.noise @ phi.mT + half.noise, rtol=1e-12, atol=1e-18)


@pytest.mark.slow
def test_a_log_without_noise_is_resolved_to_the_finest_sensor() -> None:
    """Its likelihood grows without end as the noise parameters fall, unless sensors have a finest step."""
    dt, rows = 0.05, 101
    u = f64(*([1.0] * 30 + [-1.0] * 41 + [0.5] * 30))
    a, v = [0.0], [20.0]
    for k in range(rows - 1):
        decay = math.exp(-dt / T)
        a.append(decay * a[-1] + K * (1 - decay) * float(u[k]))
        v.append(v[-1] + K * float(u[k]) * dt + (a[-2] - K * float(u[k])) * T * (1 - decay))
    time = torch.arange(rows, dtype=torch.float64) * dt
    density = LatentDensity(LatentWindow(*(x[None] for x in (time, u, f64(*a), f64(*v), time >= 0))))
    quiet = SamplerSettings(chains=16, draws=40, burn_in=20, attempts=1)
    found = sample(density, quiet, generator=torch.Generator().manual_seed(0))
    away = (found.mean[0, :2] - f64(T, K)).abs() / found.sd[0, :2]
    assert bool((away < 5.0).all())
    # a hundred rows, each read to 1e-4 m/s² while the command is of order one, determine a ratio no better than this
    assert bool((found.sd[0, :2] > 0.1 * FINEST / math.sqrt(rows)).all())
    assert bool((found.sd[0, :2] < 0.01).all())


def _gradient_case(generator: torch.Generator) -> tuple[Tensor, tuple[Tensor, ...]]:
    time, u, a, v = record(7, generator, jitter=0.5, dt=0.1)
    # sensor noise of order one: finite differences of 1/noise² at 0.03 err by more than gradcheck allows
    values = [f64(x) for x in (T, K, Q, SD, TIME, 0.5, 0.3, 0.2)]
    return time, tuple(x.requires_grad_() for x in (*values, u, a, v))


@pytest.mark.slow
def test_filter_gradients(fresh_seed: int) -> None:
    time, inputs = _gradient_case(torch.Generator().manual_seed(fresh_seed))

    def f(*x: Tensor) -> Tensor:
        noise = {"accel_noise": x[5], "speed_noise": x[6], "road_noise": x[7]}
        lag, gain, rough, sd, slow_time = x[:5]
        return latent_log_likelihood(lag, gain, rough, sd, slow_time, time, x[8], accel=x[9], speed=x[10], **noise)

    assert gradcheck(f, inputs)
    assert gradgradcheck(f, inputs)


@pytest.mark.parametrize("lag", [0.003, 5.0])
@pytest.mark.parametrize("gain", [0.05, 3.0])
def test_gradients_are_finite_at_the_edges(lag: float, gain: float) -> None:
    _, u, _, v = record(300, torch.Generator().manual_seed(1), dt=0.01)
    density = LatentDensity(LatentWindow.single(0.01 * torch.arange(300, dtype=torch.float64), u, speed=v))
    for scale in (0.1, 10.0):
        z = density.prior.center().clone() + math.log(scale)
        z[:2] = f64(lag, gain).log()
        z = z[None].requires_grad_()
        (gradient,) = torch.autograd.grad(density.log_prob(z).sum(), z)
        assert bool(gradient.isfinite().all())


def simulate(rows: int, generator: torch.Generator, windows: int) -> LatentWindow:
    """Windows drawn from the model itself, at the values at the head of this file, 100 Hz."""
    step = discretise(f64(T), f64(K), f64(Q), f64(ROAD), f64(SD), f64(TIME), dt=f64(0.01))
    root = torch.linalg.cholesky(step.noise[0])
    u = 0.5 * torch.randn(windows, rows // 100 + 1, generator=generator, dtype=torch.float64).repeat_interleave(100, 1)
    x = torch.zeros(windows, 4, dtype=torch.float64)
    x[:, 0] = 10.0
    x[:, 2:] = torch.randn(windows, 2, generator=generator, dtype=torch.float64) * f64(SD * TIME / math.sqrt(3), SD)
    states = []
    for k in range(rows):
        states.append(x)
        noise = torch.randn(windows, 4, generator=generator, dtype=torch.float64) @ root.T
        x = x @ step.transition[0].T + u[:, k, None] * step.gain[0] + noise
    v = torch.stack(states, 1)[..., [0, 2]].sum(-1)
    v = v + SPEED * torch.randn(v.shape, generator=generator, dtype=torch.float64)
    time = (0.01 * torch.arange(rows, dtype=torch.float64)).expand(windows, -1)
    return LatentWindow(time, u[:, :rows], None, v, torch.ones_like(v, dtype=torch.bool))


@pytest.mark.statistical
@pytest.mark.slow
def test_mode_finds_the_truth_within_its_laplace_bars(rotating_seed: int) -> None:
    data = simulate(3000, torch.Generator().manual_seed(rotating_seed), windows=4)
    mode = find_mode(LatentDensity(data))
    assert bool(mode.converged.all())
    score = (mode.z[:, :2] - f64(T, K).log()) / mode.covariance.diagonal(dim1=-2, dim2=-1)[:, :2].sqrt()
    assert float(score.abs().max()) < BAR


@pytest.mark.statistical
def test_score_has_mean_zero_at_the_truth(rotating_seed: int, draws_factor: int) -> None:
    """First Bartlett identity: the likelihood's gradient at the truth averages to nothing over simulated windows."""
    windows = 60 * draws_factor
    data = simulate(200, torch.Generator().manual_seed(rotating_seed), windows)
    density = LatentDensity(data)
    z = f64(*(TRUTH[name] for name in density.names)).log().expand(windows, -1).clone().requires_grad_()
    (score,) = torch.autograd.grad(density.log_likelihood(z).sum(), z)
    assert bool((score.mean(0).abs() < BAR * score.std(0) / math.sqrt(windows)).all())


def test_density_adds_prior_and_runs_and_keeps_leading_dimensions(fresh_seed: int) -> None:
    generator = torch.Generator().manual_seed(fresh_seed)
    data = simulate(200, generator, windows=2)
    time = data.time.clone()
    time[0, 120:] += 3.0  # a gap starts a new run
    mask = data.mask.clone()
    mask[1, 50:60] = False  # so does a stretch that may not be used
    density = LatentDensity(LatentWindow(time, data.u, None, data.speed, mask))
    z = density.initial() + 0.1 * torch.randn(4, 3, 2, len(density.names), generator=generator, dtype=torch.float64)
    p = dict(zip(density.names, z.exp().unbind(-1), strict=True))
    p["speed_noise"] = torch.hypot(p["speed_noise"], f64(FINEST))
    assert data.speed is not None
    pieces = ((0, slice(0, 120)), (0, slice(120, 200)), (1, slice(0, 50)), (1, slice(60, 200)))
    expected = torch.zeros(4, 3, 2, dtype=torch.float64)
    for w, rows in pieces:
        one = {name: value[..., w] for name, value in p.items()}
        expected[..., w] += latent_log_likelihood(
            **one, time=time[w, rows], u=data.u[w, rows], speed=data.speed[w, rows]
        )
    prior = Joint(default_actuation_prior(), default_noise_prior(density.names[2:]))
    torch.testing.assert_close(density.log_prob(z), expected + prior.log_prob(z), rtol=1e-9, atol=1e-7)


def test_uneven_rows_are_taken_as_they_are_and_rounded_stamps_as_even() -> None:
    data = simulate(100, torch.Generator().manual_seed(0), windows=1)
    rounded = LatentWindow(data.time + 1e-3 * torch.sin(37 * data.time), data.u, None, data.speed, data.mask)
    uneven = LatentWindow(data.time + 4e-3 * torch.sin(37 * data.time), data.u, None, data.speed, data.mask)
    assert even_steps(rounded) is not None
    assert even_steps(uneven) is None
    density = LatentDensity(uneven)
    noise = {"speed_noise": math.hypot(SPEED, FINEST), "road_noise": ROAD}
    exact = latent_log_likelihood(T, K, Q, SD, TIME, uneven.time, uneven.u, speed=uneven.speed, **noise)
    z = f64(*(TRUTH[name] for name in density.names)).log()[None]
    torch.testing.assert_close(density.log_likelihood(z), exact, rtol=1e-9, atol=1e-8)


def test_select_and_stack_are_inverse_up_to_padding() -> None:
    data = simulate(60, torch.Generator().manual_seed(0), windows=3)
    again = LatentWindow.stack([data.select(torch.tensor([w])) for w in range(3)])
    assert torch.equal(again.u, data.u)
    assert torch.equal(again.mask, data.mask)


def test_names_follow_the_signals() -> None:
    assert latent_names(accel=False, speed=True)[2:5] == ("process_noise", "road_noise", "speed_noise")
    assert "road_noise" not in latent_names(accel=True, speed=False)
    assert "accel_noise" in latent_names(accel=True, speed=True)


def test_bad_input_names_itself() -> None:
    t = torch.arange(5, dtype=torch.float64)
    with pytest.raises(InputError, match="accel, speed"):
        LatentWindow.single(t, t)
    with pytest.raises(InputError, match="time: does not increase"):
        LatentWindow.single(t.flip(0), t, speed=t)
    with pytest.raises(InputError, match="speed: is not finite"):
        LatentWindow.single(t, t, speed=t * torch.nan)
    with pytest.raises(InputError, match="u: has shape"):
        LatentWindow.single(t, t[:4], speed=t)
    with pytest.raises(InputError, match="mask: no row"):
        LatentWindow.single(t, t, speed=t, mask=torch.zeros(5)).runs()
    with pytest.raises(InputError, match="speed_noise: missing"):
        latent_log_likelihood(T, K, Q, SD, TIME, t, t, speed=t)
    with pytest.raises(InputError, match="accel: measured in some"):
        LatentWindow.stack([LatentWindow.single(t, t, speed=t), LatentWindow.single(t, t, speed=t, accel=t)])
