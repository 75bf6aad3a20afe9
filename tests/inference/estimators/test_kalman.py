"""Joint Kalman filters: the exact filter where the model is linear, slopes, quadrature where it nearly is, coverage."""

from __future__ import annotations

import math

import pytest
import torch
from torch.autograd.functional import jacobian

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, JerkForm, integrate
from avtorch.inference.estimators import JointEKF, JointUKF
from avtorch.inference.estimators.kalman import GaussianState, JerkState, LatentState, Observation
from avtorch.inference.latent import FINEST, LatentDensity, LatentForm, LatentWindow
from avtorch.inference.priors import Joint, LogNormalPrior, default_jerk_noise_prior
from avtorch.vehicle.glvd import glvd_jerk
from tests.bars import BAR

F64 = torch.float64
FILTERS = [JointEKF, JointUKF]


class Linear:
    """Two coefficients on a walk, read through ``a x_0 + u x_1``: linear, with a closed form."""

    def __init__(self, variance: float, walk: float, vehicles: int) -> None:
        self.variance = torch.full((vehicles, 1), variance, dtype=F64)
        self.walk = walk

    def start(self, actuation, row):
        return actuation

    def advance(self, x, row):
        return x @ torch.tensor([[0.9, 0.2], [0.0, 1.0]], dtype=F64).T

    def slope(self, x, row):
        return torch.tensor([[0.9, 0.2], [0.0, 1.0]], dtype=F64).expand(*x.shape, 2)

    def noise(self, x, row):
        return self.walk * torch.eye(2, dtype=F64)

    def observe(self, x, row, channel):
        return row.a * x[..., 0] + row.u * x[..., 1]

    def observed_slope(self, x, row, channel):
        return torch.stack([row.a, row.u], -1).expand_as(x)


def rows_of(a, u, jerk):
    time = 0.01 * torch.arange(a.shape[-1], dtype=F64)
    usable = torch.ones_like(a, dtype=torch.bool)
    return {"time": time, "usable": usable, "accel": a, "accel_cmd": u, "jerk": jerk}


@pytest.mark.parametrize("kind", FILTERS)
def test_a_linear_model_is_filtered_exactly(kind, fresh_seed):
    """Against the conditional of one joint normal of all states and readings, by dense algebra."""
    g = torch.Generator().manual_seed(fresh_seed)
    vehicles, n, r, q = 3, 12, 0.3, 0.05
    a, u, y = torch.randn(3, vehicles, n, generator=g, dtype=F64)
    model, mean0 = Linear(r, q, vehicles), torch.randn(vehicles, 2, generator=g, dtype=F64)
    cov0 = torch.tensor([[1.0, 0.3], [0.3, 0.5]], dtype=F64)
    start = GaussianState(mean0, cov0.expand(vehicles, 2, 2))
    found, likelihood = kind(JerkForm(), vehicles=vehicles).filter(model, start, rows_of(a, u, y), ("jerk",))
    F = model.slope(mean0[:1], None)[0]
    for v in range(vehicles):
        mean, cov = mean0[v], cov0
        means, crosses = [mean], {(0, 0): cov}
        for k in range(1, n):
            means.append(F @ means[-1])
            for j in range(k):
                crosses[k, j] = F @ crosses[k - 1, j]
            crosses[k, k] = F @ crosses[k - 1, k - 1] @ F.T + q * torch.eye(2, dtype=F64)
        whole = torch.cat(
            [
                torch.cat([crosses[max(i, j), min(i, j)] if i >= j else crosses[j, i].T for j in range(n)], 1)
                for i in range(n)
            ],
            0,
        )
        H = torch.block_diag(*(torch.stack([a[v, k], u[v, k]])[None] for k in range(n)))
        spread = H @ whole @ H.T + r * torch.eye(n, dtype=F64)
        gain = whole[-2:] @ H.T @ torch.linalg.inv(spread)
        off = y[v] - H @ torch.cat(means)
        torch.testing.assert_close(found.mean[v], means[-1] + gain @ off, rtol=0, atol=1e-10)
        torch.testing.assert_close(found.cov[v], crosses[n - 1, n - 1] - gain @ H @ whole[:, -2:], rtol=0, atol=1e-10)
        exact = torch.distributions.MultivariateNormal(H @ torch.cat(means), spread).log_prob(y[v])
        torch.testing.assert_close(likelihood[v], exact, rtol=0, atol=1e-9)


def random_row(g, channels, dt=0.04):
    u, a = torch.randn(2, 3, generator=g, dtype=F64)
    return Observation(u, a, torch.randn(3, channels, generator=g, dtype=F64), torch.tensor(dt, dtype=F64))


@pytest.mark.parametrize("latent", [False, True])
def test_slopes_are_those_of_autograd(latent, fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    if latent:
        form = LatentForm(accel=True, speed=True)
        model, d, channels = LatentState(form.measured, JointEKF(form).noise, 0.1, 3), 6, 2
    else:
        model, d, channels = JerkState(torch.ones(3, dtype=F64), 0.1), 2, 1
    row, x = random_row(g, channels), torch.randn(3, d, generator=g, dtype=F64)

    def of(function):
        whole = jacobian(function, x)
        return torch.stack([whole[v, ..., v, :] for v in range(3)])

    torch.testing.assert_close(model.slope(x, row), of(lambda y: model.advance(y, row)), rtol=1e-9, atol=1e-12)
    for channel in range(channels):
        expected = of(lambda y, c=channel: model.observe(y, row, c))
        torch.testing.assert_close(model.observed_slope(x, row, channel), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("signals", [("accel",), ("speed",), ("accel", "speed")])
def test_known_parameters_give_the_latent_form_s_likelihood(signals, fresh_seed):
    """With T_L and K_L known and at rest the joint filter is linear: the latent form's own filter, gaps and all."""
    g = torch.Generator().manual_seed(fresh_seed)
    n = 60
    time = 0.05 * torch.arange(n, dtype=F64)
    time[40:] += 3.0
    u = torch.randn(2, n, generator=g, dtype=F64).cumsum(-1) * 0.2
    columns = {"accel_cmd": u, "accel": torch.randn(2, n, generator=g, dtype=F64), "speed": 10 + 0.1 * u}
    usable = torch.ones(2, n, dtype=torch.bool)
    usable[1, 12:15] = False
    form = LatentForm(accel="accel" in signals, speed="speed" in signals)
    ekf = JointEKF(form, vehicles=2, drift=0.0)
    actuation = GaussianState(torch.tensor([0.6, 0.8], dtype=F64).log().expand(2, 2), torch.zeros(2, 2, 2, dtype=F64))
    model = LatentState(form.measured, ekf.noise, 0.0, 2)
    rows = {"time": time, "usable": usable, **{name: columns[name] for name in form.columns}}
    _, likelihood = ekf.filter(model, actuation, rows, form.measured)
    window = LatentWindow(
        time.expand(2, n), u, *(columns[s] if s in signals else None for s in ("accel", "speed")), usable
    )
    # what no sensor reads finer than comes on top in the latent form
    below = {name: (FINEST if name in ("accel_noise", "speed_noise") else 0.0) for name in form.names[2:]}
    noise = [math.sqrt(ekf.noise[name] ** 2 - least**2) for name, least in below.items()]
    values = torch.tensor([0.6, 0.8, *noise], dtype=F64)
    exact = LatentDensity(window).log_likelihood(values.log().expand(2, -1))
    torch.testing.assert_close(likelihood, exact, rtol=1e-8, atol=0)


TIGHT = LogNormalPrior(torch.tensor([0.4, 0.9], dtype=F64), torch.tensor([0.05, 0.05], dtype=F64))


def windows_of(truth, sigma, g, rows=200):
    a, u, noise = torch.randn(3, len(truth), rows, generator=g, dtype=F64)
    return rows_of(a, u, glvd_jerk(a, u, truth[:, :1], truth[:, 1:]) + sigma * noise)


@pytest.mark.statistical
@pytest.mark.parametrize("kind", FILTERS)
def test_nearly_linear_is_nearly_quadrature(kind, rotating_seed):
    """A prior of 5 % in both parameters: the model bends by about that share of its slope, and moments are off so."""
    g = torch.Generator().manual_seed(rotating_seed)
    truth = TIGHT.sample(1, 4, generator=g)[0].exp()
    rows = windows_of(truth, 1.0, g)
    loop = kind(JerkForm(), vehicles=4, drift=0.0, actuation_prior=TIGHT)
    found, converged = loop._learn(rows, torch.arange(4))
    assert converged.all()
    likelihood = JerkForm().likelihood(rows, 200)
    density = likelihood.density(torch.arange(4), Joint(TIGHT, default_jerk_noise_prior()))
    assert isinstance(density, JerkDensity)
    exact = integrate(density)
    assert ((found.mean - exact.mean)[:, :2].abs() / exact.sd[:, :2]).max() < 0.25
    assert (found.sd / exact.sd - 1)[:, :2].abs().max() < 0.1


@pytest.mark.statistical
@pytest.mark.parametrize("kind", FILTERS)
def test_intervals_cover_truths_of_a_tight_prior(kind, rotating_seed, draws_factor):
    """2000 vehicles of a 5 % prior, one window each; 90 % to 5 binomial errors, and 0.01 for what the tangent lacks."""
    count, g = 2000 * draws_factor, torch.Generator().manual_seed(rotating_seed)
    truth = TIGHT.sample(1, count, generator=g)[0].exp()
    loop = kind(JerkForm(), vehicles=count, drift=0.0, actuation_prior=TIGHT, kept=2)
    found, converged = loop._learn(windows_of(truth, 1.0, g), torch.arange(count))
    assert converged.all()
    covered = ((found.q05[:, :2] <= truth) & (truth <= found.q95[:, :2])).double().mean(0)
    assert ((covered - 0.9).abs() < BAR * math.sqrt(0.09 / count) + 0.01).all()


@pytest.mark.parametrize("kind", FILTERS)
def test_a_filter_that_diverges_begins_anew(kind):
    """Jerk of the wrong sign drives the lag out of any car's range: nothing of it may reach the belief."""
    g = torch.Generator().manual_seed(0)
    a, u = torch.randn(2, 1, 400, generator=g, dtype=F64)
    loop = kind(JerkForm(), drift=1.0)
    before = loop.belief
    found, converged = loop._learn(rows_of(a, u, -glvd_jerk(a, u, 0.3, 1.0)), torch.tensor([0]))
    assert not converged.any()
    assert loop._memory["mean"].equal(loop.first_prior.actuation.median.log()[None])
    after = before.updated(torch.tensor([True]), torch.tensor([0]), found, converged)
    assert after.draws.equal(before.draws)


@pytest.mark.parametrize(
    ("options", "name"), [({"drift": -1.0}, "drift"), ({"noise": {"sigma": 1.0}}, "noise"), ({"kept": 1}, "kept")]
)
def test_bad_arguments_are_refused_by_name(options, name):
    with pytest.raises(InputError, match=rf"^{name}"):
        JointEKF(JerkForm(), **options)
