"""The monitor and its detectors: the accepted change, divergences of Gaussians, control charts; rates and resuming."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm
from scipy.stats import chi2
from torch.distributions import MultivariateNormal, kl_divergence

from avtorch.decision.charts import ALLOWANCE, CHARTS, WEIGHT, Chart, chart_limit, cusum_arl, ewma_arl, shewhart_arl
from avtorch.decision.divergence import (
    DIVERGENCES,
    Gaussian,
    divergence,
    divergence_p_value,
    hellinger,
    innovation,
    kl,
    w2,
    weighted_chi2_tail,
)
from avtorch.decision.monitor import DEFAULT_DETECTORS, DETECTORS, Monitor
from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from tests.bars import BAR


def cloud(T, K, *, sd=0.03, draws=400, seed=0):
    """Draws (scenario, draw) about T [s] and K [-] (scenario,), spread `sd` in the logarithm."""
    generator = torch.Generator().manual_seed(seed)
    T, K = (torch.as_tensor(x, dtype=torch.float64).reshape(-1, 1) for x in (T, K))
    z = torch.randn(2, T.shape[0], draws, generator=generator, dtype=torch.float64)
    z = (z - z.mean(dim=-1, keepdim=True)) / z.std(dim=-1, keepdim=True)
    return T * torch.exp(sd * z[0]), K * torch.exp(0.5 * sd * z[1])


def yes(n=1):
    return torch.ones(n, dtype=torch.bool)


@pytest.mark.parametrize(
    ("T", "K", "sd", "alarmed"),
    [
        (0.3, 1.0, 0.03, False),
        (0.45, 0.9, 0.03, False),  # within 0.2 s and 0.15
        (0.6, 1.0, 0.03, True),
        (0.3, 0.8, 0.03, True),
        (0.51, 1.0, 0.15, False),  # outside by its mean, but the belief is not sure of it
        (0.45, 1.0, 0.6, False),  # wide, mean inside
    ],
)
def test_accepted_change(T, K, sd, alarmed):
    monitor = Monitor(1, detectors=["accepted_change"])
    report = monitor.update(*cloud([T], [K], sd=sd), yes(), Setting())
    assert bool(report.alerts["accepted_change"][0]) is alarmed
    assert bool(report.any[0]) is alarmed


def test_accepting_moves_the_accepted_value_only_where_given():
    monitor = Monitor(2, detectors=["accepted_change"])
    changed = cloud([1.5, 1.5], [0.5, 0.5])
    assert monitor.update(*changed, yes(2), Setting()).any.tolist() == [True, True]
    monitor.accept(torch.tensor([True, False]))
    assert monitor.update(*changed, yes(2), Setting()).any.tolist() == [False, True]
    assert monitor.update(*cloud([0.3, 0.3], [1.0, 1.0]), yes(2), Setting()).any.tolist() == [True, False]
    torch.testing.assert_close(monitor.accepted[0][0], changed[0][0].mean())


def test_stability_takes_precedence_and_asks_the_setting_in_force():
    monitor = Monitor(2)
    both = Setting(T_hat=torch.tensor([0.3, 1.5]), K_hat=torch.tensor([1.0, 0.5]))  # default, and inverted
    report = monitor.update(*cloud([1.5, 1.5], [0.5, 0.5]), yes(2), both)
    assert report.names(0) == ["stability", "accepted_change"]
    assert report.names(1) == ["accepted_change"]
    assert float(report.p_string_stable[0]) == 0.0
    assert float(report.p_string_stable[1]) > 0.99
    assert "P(string stable) is 0.00" in report.why("stability", 0)
    assert report.actuation_changed.tolist() == [True, True]


def test_each_detector_is_opt_in_and_named():
    assert Monitor(1).detectors == DEFAULT_DETECTORS == ("stability", "accepted_change")
    monitor = Monitor(1, detectors=list(reversed(DETECTORS)))
    for seed in range(3):
        monitor.update(*cloud([0.3], [1.0], seed=seed), yes(), Setting())
    report = monitor.update(*cloud([1.5], [0.5], seed=9), yes(), Setting())
    assert report.names() == list(DETECTORS)
    for name in DETECTORS:
        assert len(report.why(name)) > 10
        assert "\n" not in report.why(name)


def test_unexcited_windows_neither_alarm_nor_move_anything():
    monitor, untouched = Monitor(1, detectors=DETECTORS), Monitor(1, detectors=DETECTORS)
    for m in (monitor, untouched):
        m.update(*cloud([0.3], [1.0]), yes(), Setting())
    report = monitor.update(*cloud([1.9], [0.3]), ~yes(), Setting())
    assert report.names() == []
    assert float(report.p_string_stable[0]) == 0.0  # still reported
    monitor.accept(~yes())
    for seed in range(3):
        seen = cloud([0.31], [1.0], seed=seed)
        a, b = (m.update(*seen, yes(), Setting()) for m in (monitor, untouched))
        for name in a.statistics:
            assert torch.equal(a.statistics[name], b.statistics[name])


def test_saved_state_resumes_to_the_bit():
    def fresh():
        return Monitor(3, detectors=DETECTORS, arl=20.0)

    windows = [
        cloud([0.3, 0.3 + 0.01 * i, 0.3 if i < 5 else 1.2], [1.0, 1.0, 1.0 if i < 5 else 0.6], seed=i) for i in range(9)
    ]
    whole, resumed = fresh(), fresh()
    for i, window in enumerate(windows):
        excited = torch.tensor([True, i % 3 != 0, True])
        report = whole.update(*window, excited, Setting())
        if i > 4:
            again = resumed.update(*window, excited, Setting())
            for name in DETECTORS:
                assert torch.equal(report.alerts[name], again.alerts[name])
            for name, value in report.statistics.items():
                assert torch.equal(value, again.statistics[name])
        whole.accept(report.any)
        if i > 4:
            resumed.accept(report.any)
        if i == 4:
            resumed.load_state_dict(whole.state_dict())


@pytest.mark.statistical
@pytest.mark.parametrize("name", [*DIVERGENCES, *CHARTS])
def test_rates_of_false_alarm_in_control(name, rotating_seed, draws_factor):
    """Window posteriors scatter about one truth as widely as their SDs: alarms come at the stated rate."""
    generator = torch.Generator().manual_seed(rotating_seed)
    n, windows, rate = 2000 * draws_factor, 10, 0.02
    monitor = Monitor(n, detectors=[name], false_alarm_rate=rate, arl=50.0)
    alarms = torch.zeros(n, dtype=torch.float64)
    for _ in range(windows):
        centre = 0.05 * torch.randn(2, n, generator=generator, dtype=torch.float64)
        # The cloud's spread in log K_L is half of that in log T_L.
        window = cloud(0.3 * centre[0].exp(), (0.5 * centre[1]).exp(), sd=0.05, draws=60)
        alarms += monitor.update(*window, yes(n), Setting()).alerts[name]
    counted = windows - 1  # the first is the baseline
    if name in CHARTS:
        # An alarm every 50 windows at most: memoryless for Shewhart; the others start from zero and alarm later.
        expected = counted / 50.0
        spread = BAR * float(alarms.std()) / math.sqrt(n)
        assert float(alarms.mean()) < expected + spread
        assert float(alarms.mean()) > (0.9 * expected - spread if name == "shewhart" else 0.0)
    else:
        # Alarmed windows are kept out of the baseline, which only steadies it: the rate is met to a tenth of itself.
        share = alarms / counted
        assert abs(float(share.mean()) - rate) < BAR * float(share.std()) / math.sqrt(n) + 0.1 * rate


def test_a_vehicle_that_swings_by_a_few_per_cent_is_quiet_only_where_it_may():
    """A gain that swings by 2 % with a belief ten times as narrow: an alarm unless unevenness is allowed for."""
    for unevenness, alarmed in (((0.0, 0.0), True), ((0.1, 0.03), False)):
        monitor = Monitor(1, detectors=[*DIVERGENCES, *CHARTS], unevenness=unevenness)
        seen = False
        for i in range(30):
            swing = 1.0 + 0.02 * math.sin(i / 2.4)
            seen |= bool(monitor.update(*cloud([0.3], [swing], sd=0.004, seed=i), yes(), Setting()).any[0])
        assert seen is alarmed
        found = monitor.update(*cloud([0.6], [0.8], sd=0.004), yes(), Setting())
        assert "hellinger" in found.names()


def test_dead_time_counts_in_the_stability_verdict():
    quick = cloud([0.3], [1.0])
    assert not bool(Monitor(1).update(*quick, yes(), Setting()).any[0])
    assert Monitor(1, dead_time=0.4).update(*quick, yes(), Setting()).names() == ["stability"]


@pytest.mark.parametrize(
    "bad",
    [
        {"detectors": ["guess"]},
        {"detectors": []},
        {"certainty": 1.0},
        {"stability_level": 0.0},
        {"false_alarm_rate": 2.0},
        {"change": (0.2, 0.0)},
        {"unevenness": (0.1, -0.1)},
        {"scenarios": 0},
        {"detectors": ["ewma"], "arl": 0.5},
    ],
)
def test_bad_arguments_are_refused(bad):
    with pytest.raises(InputError, match=r"found|need"):
        Monitor(**bad)


def test_wrong_shapes_are_refused():
    monitor = Monitor(2)
    with pytest.raises(InputError, match="draw"):
        monitor.update(*cloud([0.3], [1.0]), yes(2), Setting())
    with pytest.raises(InputError, match="excited"):
        monitor.update(*cloud([0.3, 0.3], [1.0, 1.0]), yes(1), Setting())
    with pytest.raises(InputError, match="state"):
        monitor.load_state_dict(Monitor(3).state_dict())


# Divergences of Gaussians against independent computations, and the false-alarm rate of their thresholds.
def random_gaussian(batch, generator, scale=1.0):
    root = torch.randn(batch, 2, 2, generator=generator, dtype=torch.float64)
    cov = root @ root.mT + 0.2 * torch.eye(2, dtype=torch.float64)
    return Gaussian(torch.randn(batch, 2, generator=generator, dtype=torch.float64), scale**2 * cov)


@pytest.fixture
def pair(fresh_seed):
    generator = torch.Generator().manual_seed(fresh_seed)
    return random_gaussian(6, generator), random_gaussian(6, generator)


def test_kl_against_torch(pair):
    p, q = pair
    other = kl_divergence(MultivariateNormal(p.mean, p.cov), MultivariateNormal(q.mean, q.cov))
    torch.testing.assert_close(kl(p, q), other, rtol=1e-10, atol=1e-12)


def test_hellinger_against_quadrature(pair):
    p, q = pair
    # The integrand sqrt(p q) is a Gaussian: on a fine grid the trapezium rule is exact to rounding.
    axis = torch.linspace(-30.0, 30.0, 1201, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).reshape(-1, 2)
    for i in range(2):
        logs = [MultivariateNormal(g.mean[i], g.cov[i]).log_prob(grid) for g in (p, q)]
        overlap = float((0.5 * (logs[0] + logs[1])).exp().sum()) * 0.05**2
        assert float(hellinger(p, q)[i]) == pytest.approx(math.sqrt(1.0 - overlap), abs=1e-8)


def test_w2_against_scipy(pair):
    p, q = pair
    for i in range(6):
        P, Q = p.cov[i].numpy(), q.cov[i].numpy()
        root = sqrtm(Q)
        squared = np.sum((p.mean[i] - q.mean[i]).numpy() ** 2) + np.trace(P + Q - 2 * np.real(sqrtm(root @ P @ root)))
        assert float(w2(p, q)[i]) == pytest.approx(math.sqrt(squared), rel=1e-7)


@pytest.mark.parametrize("kind", DIVERGENCES)
def test_a_belief_does_not_diverge_from_itself(kind, pair):
    assert float(divergence(kind, pair[0], pair[0]).abs().max()) < 1e-6


def test_tail_of_weighted_chi_squares():
    value = torch.tensor([0.3, 2.0, 9.0, 25.0], dtype=torch.float64)
    equal = weighted_chi2_tail(value, torch.tensor([1.7, 1.7], dtype=torch.float64))
    torch.testing.assert_close(equal, torch.exp(-value / 3.4), rtol=1e-12, atol=0.0)
    single = weighted_chi2_tail(value, torch.tensor([0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(single, torch.from_numpy(chi2.sf(value.numpy(), 1)), rtol=1e-2, atol=1e-12)


@pytest.mark.statistical
@pytest.mark.parametrize("kind", DIVERGENCES)
@pytest.mark.parametrize("baseline_scale", [0.1, 1.0, 3.0])
def test_false_alarm_rate_counts_the_baselines_own_uncertainty(kind, baseline_scale, rotating_seed, draws_factor):
    generator = torch.Generator().manual_seed(rotating_seed)
    n, rate = 20000 * draws_factor, 0.05
    p, q = (random_gaussian(1, generator, s) for s in (1.0, baseline_scale))

    def around_the_truth(g):
        noise = torch.randn(n, 2, generator=generator, dtype=torch.float64)
        return Gaussian(noise @ torch.linalg.cholesky(g.cov[0]).mT, g.cov.expand(n, 2, 2))

    chance = divergence_p_value(kind, around_the_truth(p), around_the_truth(q))
    share = float((chance < rate).double().mean())
    assert abs(share - rate) < BAR * math.sqrt(rate * (1.0 - rate) / n)


@pytest.mark.statistical
def test_combined_beliefs_add_their_precisions_and_leave_white_residuals(rotating_seed, draws_factor):
    generator = torch.Generator().manual_seed(rotating_seed)
    a, b = random_gaussian(4, generator), random_gaussian(4, generator)
    both = a.combine(b)
    precision = torch.linalg.inv(a.cov) + torch.linalg.inv(b.cov)
    torch.testing.assert_close(torch.linalg.inv(both.cov), precision, rtol=1e-9, atol=1e-9)
    pulled = torch.linalg.inv(a.cov) @ a.mean[..., None] + torch.linalg.inv(b.cov) @ b.mean[..., None]
    torch.testing.assert_close(precision @ both.mean[..., None], pulled, rtol=1e-9, atol=1e-9)

    n = 20000 * draws_factor
    cov = a.cov[:1].expand(n, 2, 2)
    windows = [
        Gaussian(torch.randn(n, 2, generator=generator, dtype=torch.float64) @ torch.linalg.cholesky(cov[0]).mT, cov)
        for _ in range(3)
    ]
    baseline, residuals = windows[0], []
    for window in windows[1:]:
        residuals.append(innovation(window, baseline))
        baseline = baseline.combine(window)
    z = torch.cat(residuals, dim=-1)
    # Covariance of n standard normal vectors: entries off the identity by sqrt(2/n) at most, 1 sigma.
    assert float((z.mT @ z / n - torch.eye(4, dtype=torch.float64)).abs().max()) < BAR * math.sqrt(2.0 / n)


def test_too_few_draws_are_refused():
    with pytest.raises(InputError, match="draws"):
        Gaussian.of_draws(torch.ones(4, 2), torch.ones(4, 2))


# Control charts: limits are what the stated run length demands, by simulation and by closed form.
def run_lengths(kind, *, arl, components, shift, runs, seed, longest=6000):
    """First alarm of each of `runs` scenarios, (run,); innovations N(shift, 1)."""
    generator = torch.Generator().manual_seed(seed)
    chart = Chart(kind, runs, arl, components)
    first = torch.zeros(runs)
    alive = torch.ones(runs, dtype=torch.bool)
    for step in range(1, longest):
        z = torch.randn(runs, components, generator=generator, dtype=torch.float64) + shift
        alarm = chart.step(z, alive)
        first = torch.where(alive & alarm, float(step), first)
        alive &= ~alarm
        if not bool(alive.any()):
            return first
    raise AssertionError("a chart never alarmed")


def bar_of(lengths):
    return BAR * float(lengths.std()) / math.sqrt(len(lengths))


@pytest.mark.statistical
@pytest.mark.parametrize("kind", CHARTS)
def test_in_control_run_length_is_what_was_asked(kind, rotating_seed, draws_factor):
    lengths = run_lengths(kind, arl=60.0, components=1, shift=0.0, runs=4000 * draws_factor, seed=rotating_seed)
    assert abs(float(lengths.mean()) - 60.0) < bar_of(lengths)


@pytest.mark.statistical
def test_two_components_alarm_once_per_arl(rotating_seed, draws_factor):
    lengths = run_lengths("shewhart", arl=60.0, components=2, shift=0.0, runs=4000 * draws_factor, seed=rotating_seed)
    exact = 1.0 / (1.0 - (1.0 - 1.0 / 120.0) ** 2)  # either of two independent charts of 120
    assert 60.0 < exact < 61.0
    assert abs(float(lengths.mean()) - exact) < bar_of(lengths)


def test_shewhart_is_exact_and_ewma_of_weight_one_is_shewhart():
    limit = chart_limit("shewhart", 370.0)
    assert math.erfc(limit / math.sqrt(2.0)) == pytest.approx(1.0 / 370.0, rel=1e-12)
    assert shewhart_arl(limit) == pytest.approx(370.0, rel=1e-12)
    # by the quadrature of any weight, which is exact here but for the rounding of its sums
    assert ewma_arl(limit, 1.0) == pytest.approx(370.0, rel=1e-9)
    assert ewma_arl(limit, 0.999) == pytest.approx(370.0, rel=0.01)


def test_limits_solve_their_own_equation():
    assert ewma_arl(chart_limit("ewma", 500.0), WEIGHT) == pytest.approx(500.0, rel=1e-6)
    assert cusum_arl(chart_limit("cusum", 500.0), ALLOWANCE) == pytest.approx(500.0, rel=1e-6)


def test_a_cusum_of_no_height_is_two_one_sided_shewhart_arms():
    # With a limit near zero an arm alarms as soon as z exceeds the allowance: ARL 1 / (2 P(z > 1.5)).
    assert cusum_arl(1e-9, 1.5) == pytest.approx(1.0 / math.erfc(1.5 / math.sqrt(2.0)), rel=1e-6)


@pytest.mark.statistical
def test_small_shifts_are_found_sooner_by_the_charts_that_remember(rotating_seed, draws_factor):
    mean = {
        kind: run_lengths(kind, arl=300.0, components=1, shift=1.0, runs=1500 * draws_factor, seed=rotating_seed)
        for kind in CHARTS
    }
    for kind in ("ewma", "cusum"):
        gap = bar_of(mean[kind]) + bar_of(mean["shewhart"])
        assert float(mean[kind].mean()) < float(mean["shewhart"].mean()) - gap


@pytest.mark.parametrize("kind", CHARTS)
def test_unseen_windows_move_nothing_and_a_state_resumes_to_the_bit(kind, fresh_seed):
    generator = torch.Generator().manual_seed(fresh_seed)
    z = torch.randn(30, 5, 2, generator=generator, dtype=torch.float64)
    seen = torch.rand(30, 5, generator=generator) < 0.6
    whole, part = Chart(kind, 5, 20.0), Chart(kind, 5, 20.0)
    for i in range(30):
        before = whole.state_dict()["arms"]
        alarm = whole.step(z[i], seen[i])
        assert not bool((alarm & ~seen[i]).any())
        assert torch.equal(whole.state_dict()["arms"][~seen[i]], before[~seen[i]])
        if i == 12:
            part.load_state_dict(whole.state_dict())
        elif i > 12:
            assert torch.equal(part.step(z[i], seen[i]), alarm)
            assert torch.equal(part.last_statistic, whole.last_statistic)


@pytest.mark.parametrize(("kind", "arl"), [("shewhart", 1.0), ("shewhart", float("nan")), ("cusum", 1.1)])
def test_bad_designs_are_refused(kind, arl):
    with pytest.raises(InputError, match="found"):
        chart_limit(kind, arl)
