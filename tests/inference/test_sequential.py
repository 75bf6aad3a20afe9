"""The loop over windows: its three priors, windows without excitation, many vehicles at once, divergence, resume."""

from __future__ import annotations

import io
import math

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, JerkStatistics, SamplerSettings, SequentialInference, find_mode
from avtorch.inference.priors import Joint, LogSpaceNormal, QuadrantNormal, Switch
from tests.bars import BAR, student

F64 = torch.float64
MODES = ["lambda", "posterior", "forgetting"]
FIELDS = ["mean", "sd", "q05", "q95", "draws"]


def density_of(statistics: JerkStatistics):
    return lambda index, prior: JerkDensity(statistics.select(index), prior)


def every(vehicles: int, value: bool = True) -> Tensor:
    return torch.full((vehicles,), value)


def assert_same(one, other, vehicles=slice(None)) -> None:
    for name in FIELDS:
        a, b = getattr(one, name), getattr(other, name)
        assert (a[:, vehicles] if name == "draws" else a[vehicles]).equal(
            b[:, vehicles] if name == "draws" else b[vehicles]
        ), name


@pytest.mark.statistical
def test_before_any_window_the_belief_is_the_first_prior(rotating_seed, draws_factor):
    kept = 20_000 * draws_factor
    loop = SequentialInference(vehicles=3, kept=kept, seed=rotating_seed)
    z = loop.belief.draws.log()
    assert z.shape == (kept, 3, 3)
    for i, (mean, sd) in enumerate([(math.log(0.3), 0.7), (0.0, 0.3)]):
        assert (z[..., i].mean(0) - mean).abs().max() < BAR * sd / math.sqrt(kept)
        assert (z[..., i].std(0) / sd - 1).abs().max() < BAR / math.sqrt(2 * kept)
    prior = loop.prior()
    assert isinstance(prior, Switch)
    index = torch.arange(3)
    assert prior.select(index) == loop.first_prior


@pytest.mark.parametrize("mode", MODES)
def test_the_prior_of_the_second_window(mode, make_windows):
    loop = SequentialInference(mode=mode, lam=0.09, forgetting=0.5, seed=1)
    loop.update(density_of(make_windows(0, [1.0]).statistics), every(1))
    prior = loop.prior().select(torch.tensor([0]))
    if mode == "lambda":
        assert isinstance(prior, Joint)
        assert isinstance(prior.actuation, QuadrantNormal)
        assert prior.actuation.mean.equal(loop.belief.mean[:, :2])
        assert prior.actuation.variance == 0.09
        assert prior.noise is loop.first_prior.noise
    else:
        assert isinstance(prior, LogSpaceNormal)
        # the kept draws are a thinned quarter of the 3840, so their moments are near, not equal
        z = loop.belief.draws[:, 0].log()
        covariance = torch.cov(z.T) * (2 if mode == "forgetting" else 1)
        sd = covariance.diagonal().sqrt()
        assert ((prior.mean_z[0] - z.mean(0)) / sd).abs().max() < 0.1
        assert (prior.cov_z[0].diagonal() / sd.square() - 1).abs().max() < 0.2


@pytest.mark.parametrize("mode", MODES)
def test_a_window_that_teaches_nothing_leaves_the_belief_to_the_bit(mode, make_windows):
    """Vehicle 0 is excited throughout, vehicle 1 in the first window only, vehicle 2 never."""
    loop = SequentialInference(vehicles=3, mode=mode, seed=3)
    start = loop.belief
    w = make_windows(0, [1.0, 1.0, 1.0])
    first = loop.update(density_of(w.statistics), torch.tensor([True, True, False]))
    assert_same(start, first, slice(2, 3))
    prior = loop.prior()
    for seed in range(2):
        statistics = make_windows(seed, [1.0, 0.0, 0.0]).statistics
        belief = loop.update(density_of(statistics), torch.tensor([True, False, False]))
        assert_same(first, belief, slice(1, 3))
        assert not belief.mean[0].equal(first.mean[0])
        assert belief.excited.tolist() == [True, False, False]
        assert belief.converged.all()
        one = torch.tensor([1])
        z = torch.randn(4, 1, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
        assert loop.prior().select(one).log_prob(z).equal(prior.select(one).log_prob(z))
    none = loop.update(density_of(w.statistics), every(3, False))
    assert_same(belief, none)


class Broken:
    """A hill that is not a number a little off its top."""

    names = ("T_L", "K_L", "sigma")

    def __init__(self, good: JerkDensity, broken: Tensor) -> None:
        self.good, self.broken, self.windows = good, broken, good.windows
        self.top = find_mode(good).z

    def log_prob(self, z: Tensor) -> Tensor:
        value = self.good.log_prob(z)
        distance = (z - self.top).abs().amax(-1)
        return torch.where(self.broken & (distance > 1e-3), torch.nan, value)

    def initial(self) -> Tensor:
        return self.top


@pytest.mark.parametrize("mode", MODES)
def test_a_window_that_diverges_never_reaches_the_belief(mode, make_windows):
    loop = SequentialInference(vehicles=2, mode=mode, seed=3, settings=SamplerSettings(chains=16, attempts=2))
    w = make_windows(0, [1.0, 1.0])
    first = loop.update(density_of(w.statistics), every(2))
    broken = torch.tensor([False, True])
    belief = loop.update(lambda i, p: Broken(JerkDensity(w.statistics.select(i), p), broken), every(2))
    assert belief.converged.tolist() == [True, False]
    assert belief.excited.all()
    assert_same(first, belief, slice(1, 2))
    assert not belief.mean[0].equal(first.mean[0])
    # and the loop goes on
    belief = loop.update(density_of(w.statistics), every(2))
    assert belief.converged.all()
    for name in FIELDS:
        assert getattr(belief, name).isfinite().all()


@pytest.mark.statistical
@pytest.mark.parametrize("mode", [pytest.param(m, marks=[] if m == "posterior" else pytest.mark.slow) for m in MODES])
def test_vehicles_side_by_side_are_vehicles_alone(mode, make_windows, rotating_seed, draws_factor):
    """Three vehicles at once, 16 copies of each for the error, against loops of their own: the same posterior means."""
    copies, lags, gains = 16 * draws_factor, [0.3, 0.3, 1.5], [1.0, 0.7, 0.5]
    together = SequentialInference(vehicles=3 * copies, mode=mode, seed=rotating_seed)
    alone = [SequentialInference(vehicles=copies, mode=mode, seed=rotating_seed + 1 + v) for v in range(3)]
    for k in range(2):
        w = make_windows(k, [1.0, 0.6, 1.0], T=lags, K=gains)
        s = w.statistics.select(torch.arange(3).repeat(copies))
        batch = together.update(density_of(s), every(3 * copies))
        for v in range(3):
            own = alone[v].update(density_of(w.statistics.select(torch.full((copies,), v))), every(copies))
            a, b = batch.mean[v::3], own.mean
            error = ((a.var(0) + b.var(0)) / copies).sqrt()
            assert ((a.mean(0) - b.mean(0)) / error).abs().max() < student(2 * (copies - 1))


@pytest.mark.statistical
def test_posterior_mode_adds_windows_up(make_windows, rotating_seed):
    """Five windows in a row are nearly one window of a thousand points under the first prior.

    Each step carries on a normal in log space estimated from 64 chains x 60 draws with an autocorrelation time of about
    three, an error of 1/sqrt(1280) of an SD in the mean: after five windows 5 sigma are 5 sqrt(5/1280) = 0.31 SDs. The
    normal itself errs by the skewness of a well excited window's posterior, which is of order SD/T, 0.05.
    """
    lag, gain, count = 0.6, 0.8, 5
    windows = [make_windows(rotating_seed + k, [1.0], T=lag, K=gain, sigma=0.2) for k in range(count)]
    loop = SequentialInference(mode="posterior", seed=rotating_seed)
    for w in windows:
        belief = loop.update(density_of(w.statistics), every(1))
    a, u, jerk = (torch.cat([getattr(w, c) for w in windows], -1) for c in ("a", "u", "jerk"))
    pooled = SequentialInference(seed=rotating_seed, settings=SamplerSettings(chains=256))
    reference = pooled.update(density_of(JerkStatistics.from_samples(a, u, jerk)), every(1))
    shift = (belief.mean - reference.mean) / reference.sd
    assert shift.abs().max() < 0.31 + 0.1
    # an SD is that of the last step only, 5/sqrt(2 x 1280) = 0.1, and the normal's 0.05
    assert (belief.sd / reference.sd - 1).abs().max() < 0.1 + 0.1


def test_forgetting_keeps_more_doubt_than_remembering(make_windows):
    """With weights f^k the information of many equal windows is (1 - f^n)/(1 - f) of one: SDs of 1/sqrt of that."""
    beliefs = {}
    for mode in ("posterior", "forgetting"):
        loop = SequentialInference(mode=mode, forgetting=0.5, seed=0)
        for k in range(6):
            belief = loop.update(density_of(make_windows(k, [1.0], sigma=0.2).statistics), every(1))
        beliefs[mode] = belief.sd[0, :2]
    expected = math.sqrt(6 / ((1 - 0.5**6) / 0.5))
    ratio = beliefs["forgetting"] / beliefs["posterior"]
    # SDs from 3840 correlated draws and from windows of unequal phase
    assert ((ratio / expected - 1).abs() < 0.25).all()


def test_lambda_mode_follows_a_change(make_windows):
    loop = SequentialInference(seed=0)
    for k in range(3):
        loop.update(density_of(make_windows(k, [1.0]).statistics), every(1))
    assert loop.belief.stat("T_L")["mean"] == pytest.approx(0.3, abs=0.05)
    loop.update(density_of(make_windows(9, [1.0], T=1.5, K=0.5).statistics), every(1))
    stat = loop.belief.stat("T_L")
    assert abs(stat["mean"] - 1.5) < 5 * stat["sd"]
    assert stat["q05"] < stat["mean"] < stat["q95"]
    assert stat["sd"] < 0.2


@pytest.mark.parametrize("mode", MODES)
def test_resume_is_equal_to_the_bit(mode, make_windows):
    statistics = [make_windows(k, [1.0, 0.5]).statistics for k in range(4)]
    straight = SequentialInference(vehicles=2, mode=mode, seed=7)
    for s in statistics:
        straight.update(density_of(s), every(2))
    broken = SequentialInference(vehicles=2, mode=mode, seed=7)
    for s in statistics[:2]:
        broken.update(density_of(s), every(2))
    file = io.BytesIO()
    torch.save(broken.state_dict(), file)
    file.seek(0)
    resumed = SequentialInference(vehicles=2, mode=mode, seed=99)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    for s in statistics[2:]:
        resumed.update(density_of(s), every(2))
    assert_same(straight.belief, resumed.belief)


@pytest.mark.parametrize(
    "other",
    [{"mode": "posterior"}, {"vehicles": 3}, {"names": ("T_L", "K_L", "process_noise")}],
    ids=lambda o: next(iter(o)),
)
def test_a_state_of_another_loop_is_refused(other):
    state = SequentialInference(vehicles=2).state_dict()
    with pytest.raises(InputError, match=r"^state[:.]"):
        SequentialInference(**{"vehicles": 2, **other}).load_state_dict(state)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"mode": "prior"}, "mode"),
        ({"lam": 0.0}, "lam"),
        ({"lam": math.nan}, "lam"),
        ({"forgetting": 0.0}, "forgetting"),
        ({"forgetting": 1.1}, "forgetting"),
    ],
)
def test_bad_arguments_are_refused_by_name(options, name):
    with pytest.raises(InputError, match=rf"^{name}: "):
        SequentialInference(**options)
