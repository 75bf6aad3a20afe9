"""Feed-forward as Strategy 4: evaluated with its delay, costed, chosen where it is the least sufficient, put in
force."""

import pytest
import torch

from avtorch.decision import Grid, History, Monitor, Setting, Strategist, Supervisor
from avtorch.decision.grid import intrusiveness
from avtorch.errors import InputError
from avtorch.vehicle import MPC, ClosedLoop, GLVDPlant, Leader, LinearController, LowerLevel, stability

LINKED = Grid(feedforward=(0.25, 0.5, 0.75, 1.0), allowed=frozenset({2, 3, 4}))
DELAY = 0.1
LEADER = Leader.default(start=48)


def belief(T, K, *, sd=0.02, draws=200):
    z = torch.randn(2, 1, draws, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return T * torch.exp(sd * z[0]), K * torch.exp(0.5 * sd * z[1])


def decide(T, K, strategist, **how):
    loop = ClosedLoop(LEADER, plant=GLVDPlant(0.3, 1.0, 0.0))
    past = History.of_blocks([loop.advance(1500)])
    return strategist.decide(*belief(T, K), past, current=Setting(), default=Setting(), accel_max=40.0, **how)


def test_the_verdict_counts_gain_and_delay():
    T, K = belief(1.0, 0.8)
    setting = Setting(feedforward=torch.tensor([0.0, 0.75, 0.75]))
    p = setting.p_string_stable(T.expand(3, -1), K.expand(3, -1), link_delay=torch.tensor([0.0, 0.1, 0.5]))
    for i, (k_f, delay) in enumerate(((0.0, 0.0), (0.75, 0.1), (0.75, 0.5))):
        one = stability.string_stable(T[0], K[0], 1.0, (1.5, 1.5, -0.8), feedforward=k_f, feedforward_delay=delay)
        assert float(p[i]) == float(one.double().mean())
    assert float(p[1]) > 0.95 > 0.05 > float(p[0] + p[2])
    for delay in (0.0, 0.3):
        gain = float(stability.peak_gain(1.5, 0.5, 1.0, (1.5, 1.5, -0.8), feedforward=0.8, feedforward_delay=delay))
        chosen = Setting(feedforward=0.8).peak_gain(torch.tensor([1.5]), torch.tensor([0.5]), link_delay=delay)
        assert float(chosen) == pytest.approx(gain)


def test_it_is_a_strategy_of_its_own_with_a_stated_cost():
    assert Setting(feedforward=0.5).strategies(Setting()) == [{4}]
    assert Setting(feedforward=0.5, time_gap=1.6).strategies(Setting()) == [{2, 4}]
    cost = intrusiveness(Setting(feedforward=torch.tensor([0.0, 0.5, 1.0])), Setting(), torch.tensor([False]))
    assert cost.tolist() == pytest.approx([0.0, 2.0, 2.5])
    longer = intrusiveness(Setting(time_gap=1.6), Setting(), torch.tensor([False]))
    assert float(cost.max()) < float(longer)


def test_it_is_offered_only_where_something_is_heard():
    def count(grid):
        one = torch.tensor([1.0], dtype=torch.float64)
        wrong = torch.tensor([True])
        cost = grid.candidates(one, one * 0.8, current=Setting(), default=Setting(), model_wrong=wrong).cost
        return int(torch.isfinite(cost).sum())

    assert count(LINKED) == 5 * count(Grid(allowed=frozenset({2, 3})))
    assert count(Grid(feedforward=(0.5,), allowed=frozenset({2, 3}))) == count(Grid(allowed=frozenset({2, 3})))


@pytest.mark.slow
def test_it_is_chosen_before_a_longer_gap_and_not_with_a_late_link():
    near = decide(1.0, 0.8, Strategist(LINKED, link_delay=DELAY))
    assert near.strategies == [{4}]
    assert near.sufficient.tolist() == [True]
    k_f = float(near.setting.feedforward)
    gain = stability.peak_gain(1.0, 0.8, 1.0, (1.5, 1.5, -0.8), feedforward=k_f, feedforward_delay=DELAY)
    assert float(gain) <= 1.001
    assert "k_f" in near.why[0]
    assert "0.00 if the link is lost" in near.why[0]
    late = decide(1.0, 0.8, Strategist(LINKED, link_delay=0.4))
    assert 4 not in late.strategies[0] or late.strategies[0] > {4}
    deaf = decide(1.0, 0.8, Strategist(Grid(allowed=frozenset({2, 3}))))
    assert deaf.strategies != [{4}]
    assert float(near.intrusiveness[0]) < float(deaf.intrusiveness[0])


@pytest.mark.slow
def test_it_is_put_in_force_and_watched_with_its_delay():
    def change(loop):
        loop.plant = GLVDPlant(0.8, 0.7, 0.1)

    only = Grid(feedforward=(0.5, 0.75), allowed=frozenset({4}))
    lower = LowerLevel(accel_min=-60.0, accel_max=60.0)
    loop = ClosedLoop(LEADER, lower_level=lower, plant=GLVDPlant(0.3, 1.0, 0.1), seeds=5, link_delay=DELAY)
    supervisor = Supervisor(loop, strategist=Strategist(only, link_delay=DELAY), seed=5)
    run = supervisor.run(14.0, events=[(6.0, change)])
    first = run.actions[0][0]
    assert first.strategies == [4]
    assert first.peak_gain_true <= 1.001
    k_f = float(first.setting.feedforward)
    assert isinstance(loop.controller, LinearController)
    r, rows = run.rows, torch.arange(round(first.time_s / loop.dt) + 20, round(first.time_s / loop.dt) + 190)
    heard = r.lead_accel[0, rows - round(DELAY / loop.dt)]
    s = first.setting.as_dict()
    k_s, k_v, k_a = s["gains"]
    own = k_s * (r.spacing[0, rows] - r.speed[0, rows] - 5.0) + k_v * (r.lead_speed[0, rows] - r.speed[0, rows])
    expected = own + k_a * r.accel[0, rows] + k_f * heard
    assert torch.allclose(r.demanded[0, rows], expected, rtol=0, atol=1e-11)
    last = run.windows[-1]
    # the verdict in force is that of the loop as it is, link and all
    T, K = (last.window.belief.draws[..., i].mT for i in range(2))
    told = supervisor.setting.p_string_stable(T, K, link_delay=DELAY)
    assert float(last.report.p_string_stable[0]) == float(told[0]) > float(Setting().p_string_stable(T, K)[0])


def test_a_loop_with_a_link_is_evaluated_with_it():
    loop = ClosedLoop(LEADER, LinearController(feedforward=0.75), link_delay=0.5)
    supervisor = Supervisor(loop)
    assert supervisor.setting.feedforward.tolist() == [0.75]
    assert supervisor.watch.monitor.link_delay == pytest.approx(0.5)
    draws = belief(1.0, 0.8)
    excited = torch.tensor([True])
    report = supervisor.watch.monitor.update(*draws, excited, supervisor.setting)
    assert float(report.p_string_stable[0]) == 0.0
    assert float(Monitor(link_delay=0.1).update(*draws, excited, supervisor.setting).p_string_stable[0]) > 0.95


def test_what_does_not_go_together_is_refused():
    with pytest.raises(InputError, match="link_delay"):
        Supervisor(ClosedLoop(LEADER, link_delay=0.3), strategist=Strategist(LINKED, link_delay=0.1))
    with pytest.raises(InputError, match="feed"):
        Grid(feedforward=(0.5,), gains_of_gap=lambda gap: (1.0, 1.0, 0.0))
    with pytest.raises(InputError, match="feedforward"):
        Grid(feedforward=(float("nan"),))
    with pytest.raises(InputError, match="feedforward"):
        Setting(feedforward=float("inf"))
    mpc = ClosedLoop(LEADER, MPC())
    with pytest.raises(InputError, match="forward"):
        Supervisor(mpc, strategist=Strategist(Grid(feedforward=(0.5,), allowed=frozenset({1, 4}))))
    with pytest.raises(InputError, match="link_delay"):
        Strategist(link_delay=-0.1)
