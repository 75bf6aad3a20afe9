"""The monitor: the paper's rule with certainty, precedence, no alarms in unexcited windows, rates, resuming."""

import math

import pytest
import torch

from avtorch.decision.charts import CHARTS
from avtorch.decision.divergence import DIVERGENCES
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
