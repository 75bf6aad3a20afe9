"""The strategist and its replay: least intrusive and sufficient by brute force, and right about clipping."""

import time
from functools import cache

import pytest
import torch

from avtorch.decision.grid import Grid
from avtorch.decision.replay import History, replay
from avtorch.decision.settings import Setting
from avtorch.decision.strategist import Strategist
from avtorch.errors import InputError
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader, LowerLevel, performance

SMALL = Grid(gains=((1.5, 3.0, -1.8), (1.5, 4.0, -3.0), (3.0, 3.0, -1.8)), targets=(0.0, 0.5, 1.0))


def belief(T, K, *, sd=0.05, draws=256, seed=0):
    generator = torch.Generator().manual_seed(seed)
    T, K = (torch.as_tensor(x, dtype=torch.float64).reshape(-1, 1) for x in (T, K))
    z = torch.randn(2, T.shape[0], draws, generator=generator, dtype=torch.float64)
    return T * torch.exp(sd * z[0]), K * torch.exp(0.5 * sd * z[1])


def history(T, K, *, accel_min=-6.0, accel_max=4.0):
    """20 s of US06 with a healthy vehicle, then two with (T, K). The leader pulls away at up to 1.7 m/s²."""
    flat = (tuple(torch.as_tensor(x, dtype=torch.float64).reshape(-1).tolist()) for x in (T, K))
    return _history(*flat, accel_min, accel_max)


@cache
def _history(T, K, accel_min, accel_max):
    loop = ClosedLoop(
        Leader.default(start=5.0),
        plant=GLVDPlant(0.3, 1.0, 0.0),
        lower_level=LowerLevel(accel_min=accel_min, accel_max=accel_max),
        scenarios=len(T),
    )
    before = loop.advance(2600)
    loop.plant = GLVDPlant(*(torch.tensor(x, dtype=torch.float64) for x in (T, K)), 0.0)
    return History.of_blocks([before, loop.advance(200)])


def decide(T, K, *, strategist=None, default=None, limits=(-6.0, 4.0), sd=0.05, **how):
    n = torch.as_tensor(T).reshape(-1).shape[0]
    default = Setting(scenarios=n) if default is None else default
    return (strategist or Strategist()).decide(
        *belief(T, K, sd=sd),
        history(T, K, accel_min=limits[0], accel_max=limits[1]),
        current=how.pop("current", default),
        default=default,
        accel_min=limits[0],
        accel_max=limits[1],
        **how,
    )


@pytest.mark.slow
def test_the_choice_is_the_least_of_all_sufficient_ones():
    """Against every setting of the grid, evaluated one by one without the search's shortcuts."""
    T, K = [0.3, 1.0, 1.5, 1.5, 2.0], [0.6, 0.6, 0.5, 0.8, 1.0]
    strategist, default = Strategist(grid=SMALL), Setting(scenarios=5)
    draws, past = belief(T, K), history(T, K)
    chosen = strategist.decide(*draws, past, current=default, default=default)
    mean = (draws[0].mean(dim=1), draws[1].mean(dim=1))
    offer = SMALL.candidates(*mean, current=default, default=default, model_wrong=torch.ones(5, dtype=torch.bool))
    wide = tuple((2 * x.log() - x.log().mean(dim=1, keepdim=True)).exp()[:, None, ::2] for x in draws)
    p = offer.setting.p_string_stable(draws[0][:, None], draws[1][:, None])
    robust = offer.setting.p_string_stable(*wide)
    seen = replay(past, offer.setting, T_L=mean[0], K_L=mean[1], time_gap_now=default.time_gap)
    sufficient = (p >= 0.95) & (seen.clipped_share <= 0.05) & (seen.min_spacing_m > 0.0)
    total = torch.where(sufficient, offer.cost + 4.0 * (1.0 - robust), torch.inf)
    best = total.min(dim=1)
    assert torch.equal(chosen.sufficient, torch.isfinite(best.values))
    assert bool(chosen.sufficient.any())
    for i in torch.nonzero(chosen.sufficient)[:, 0].tolist():
        assert chosen.setting.as_dict(i) == offer.setting[i].as_dict(int(best.indices[i]))
        assert float(chosen.p_string_stable[i]) == float(p[i, best.indices[i]])
        assert float(chosen.predicted.clipped_share[i]) == float(seen.clipped_share[i, best.indices[i]])


@pytest.mark.slow
def test_a_scenario_is_decided_alike_in_any_company():
    T, K = [0.2, 1.0, 1.5, 2.0], [1.0, 0.6, 0.5, 0.4]
    draws, past = belief(T, K), history(T, K)
    strategist = Strategist(grid=SMALL)
    default = Setting(scenarios=4)
    together = strategist.decide(*draws, past, current=default, default=default)
    for i in range(4):
        one = torch.tensor([i])
        alone = strategist.decide(draws[0][one], draws[1][one], past[one], current=default[one], default=default[one])
        assert alone.setting.as_dict(0) == together.setting.as_dict(i)
        assert alone.why[0] == together.why[i]


def test_with_a_strong_actuator_the_lower_level_is_enough():
    decision = decide([1.5, 0.6], [0.5, 0.6], limits=(-60.0, 60.0))
    assert decision.strategies == [{1}, {1}]
    assert decision.sufficient.tolist() == [True, True]
    assert bool((decision.p_string_stable >= 0.95).all())
    assert decision.changes.tolist() == [True, True]


def test_clipping_rules_out_what_would_win_on_paper():
    strong, weak = (decide([1.5], [0.5], limits=limits) for limits in ((-60.0, 60.0), (-6.0, 4.0)))
    assert strong.strategies == [{1}]
    assert weak.strategies != [{1}]
    assert float(weak.setting.amplification()) < float(strong.setting.amplification())
    assert float(weak.predicted.clipped_share) <= 0.05
    assert bool(weak.sufficient[0])


@pytest.mark.slow
def test_gains_are_taken_where_the_driver_leaves_no_gap_to_open():
    decision = decide([1.5], [0.6], default=Setting(time_gap=2.5), strategist=Strategist(grid=Grid(time_gaps=(2.5,))))
    assert 2 not in decision.strategies[0]
    decision = decide([2.0], [0.6], strategist=Strategist(grid=Grid(allowed=frozenset({3}))), limits=(-60.0, 60.0))
    assert decision.strategies[0] <= {3}
    decision = decide([1.5], [0.8], strategist=Strategist(grid=Grid(allowed=frozenset({3}))), limits=(-60.0, 60.0))
    assert decision.strategies == [{3}]
    assert bool(decision.sufficient[0])


def test_where_nothing_is_sufficient_it_is_said():
    only_gaps = Strategist(grid=Grid(allowed=frozenset({2}), time_gaps=(1.0, 1.6)))
    decision = decide([2.0], [0.4], strategist=only_gaps)
    assert decision.sufficient.tolist() == [False]
    keeps = "keeps P(string stable) at 0.95 with 5 % of commands clipped or less"
    assert decision.why[0].startswith(f"no setting of the grid {keeps}; the best one: ")
    # A leader beyond the car's power clips everything: the lower level may not win by amplifying what is clipped.
    decision = decide([1.5], [0.6], limits=(-3.0, 2.0))
    assert decision.sufficient.tolist() == [False]
    assert float(decision.setting.amplification()) < 2.0
    assert float(decision.p_string_stable) >= 0.95


def test_where_no_setting_is_string_stable_the_one_that_amplifies_least_is_taken():
    """P is 0 for every gap of the list; a longer one still takes most of the growth away."""
    only_gaps = Strategist(grid=Grid(allowed=frozenset({2}), time_gaps=(1.0, 1.6, 2.2)))
    for in_force in (1.0, 2.2):
        decision = decide([2.0], [0.4], strategist=only_gaps, current=Setting(time_gap=in_force), default=Setting())
        assert decision.sufficient.tolist() == [False]
        assert float(decision.p_string_stable) == 0.0
        gain = [float(Setting(time_gap=gap).peak_gain(2.0, 0.4)) for gap in (1.0, 1.6, 2.2)]
        assert gain == sorted(gain, reverse=True)
        assert float(decision.setting.time_gap) == 2.2


def test_a_sufficient_setting_in_force_stays():
    default = Setting()
    inverted = Setting(T_hat=1.0, K_hat=0.8, T_d=0.3)
    decision = decide(
        [1.0], [0.8], default=default, current=inverted, model_wrong=torch.tensor([False]), limits=(-20.0, 20.0)
    )
    assert decision.changes.tolist() == [False]
    assert decision.strategies == [{1}]
    assert "stays" in decision.why[0]


@pytest.mark.slow
def test_a_vehicle_that_recovers_is_given_its_default_back():
    drastic = Setting(T_hat=1.5, K_hat=0.5, T_d=0.9, time_gap=2.5, gains=(1.5, 4.0, -3.0))
    decision = decide([0.3], [1.0], current=drastic, default=Setting())
    assert float(decision.setting.time_gap) == 1.0
    assert decision.setting.gains[0].tolist() == [1.5, 1.5, -0.8]
    assert bool(decision.changes[0])


def test_the_driver_is_asked_and_given_time():
    patient = Strategist(grid=Grid(allowed=frozenset({2})), driver_delay=8.0)
    decision = decide([1.0], [0.5], strategist=patient)
    assert decision.strategies == [{2}]
    assert decision.driver_delay_s.tolist() == [8.0]
    assert "driver asked" in decision.why[0]
    at_once = decide([1.0], [0.5], strategist=Strategist(grid=Grid(allowed=frozenset({2}))))
    assert at_once.driver_delay_s.tolist() == [0.0]


def test_a_dead_time_is_counted():
    # Nominal vehicle: fine without a delay, string unstable with one of 0.4 s (SPEC section 2).
    rules = {"grid": Grid(allowed=frozenset({2}), time_gaps=(1.0, 1.6, 2.5)), "draws": 20}
    assert decide([0.3], [1.0], strategist=Strategist(**rules)).strategies == [set()]
    delayed = decide([0.3], [1.0], strategist=Strategist(**rules, dead_time=0.4))
    assert delayed.strategies != [set()] or not bool(delayed.sufficient[0])


def test_a_decision_takes_well_under_a_second_of_computing():
    draws, past = belief([1.5], [0.5]), history([1.5], [0.5])
    Strategist().decide(*draws, past, current=Setting(), default=Setting())
    start = time.process_time()
    Strategist().decide(*draws, past, current=Setting(), default=Setting())
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize("bad", [{"required": 1.0}, {"most_clipped": 0.0}, {"draws": 3}, {"driver_delay": -1.0}])
def test_bad_rules_are_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        Strategist(**bad)


def test_shapes_that_do_not_fit_are_refused():
    draws, past = belief([1.5, 1.5], [0.5, 0.5]), history([1.5], [0.5])
    with pytest.raises(InputError, match="scenario"):
        Strategist().decide(*draws, past, current=Setting(), default=Setting())


# The replay: it repeats what happened, respects the limits, and does not depend on the batch.
def drive(T=0.3, K=1.0, *, seconds=20.0, lower=None, scenarios=1, start=48.0):
    loop = ClosedLoop(
        Leader.default(start=start),
        plant=GLVDPlant(T, K, 0.0),
        lower_level=lower or LowerLevel(),
        scenarios=scenarios,
    )
    return loop.advance(round(seconds / 0.01) + 1)


def column(T):
    return torch.as_tensor(T, dtype=torch.float64).reshape(-1)


def test_the_setting_in_force_does_again_what_it_did():
    block = drive(1.0, 0.7)
    seen = replay(
        History.of_blocks([block]),
        Setting()[:, None],
        T_L=column(1.0),
        K_L=column(0.7),
        time_gap_now=column(1.0),
        dt=0.01,
    )
    truth = performance(block, time_gap=1.0)
    # The leader's way is re-integrated by the trapezium rule: error below dt²/12 times the change of acceleration.
    assert float(seen.min_spacing_m) == pytest.approx(float(truth.min_spacing_m), abs=1e-3)
    assert float(seen.jerk_rms_mps3) == pytest.approx(float(truth.jerk_rms_mps3), rel=1e-3)
    assert float(seen.clipped_share) == float(truth.clipped_share)
    assert float(seen.throughput_vph) == pytest.approx(float(truth.throughput_vph), rel=1e-9)
    assert float(seen.energy_jpkgm) == pytest.approx(float(truth.energy_jpkgm), rel=1e-3)


def test_limits_are_the_vehicles_and_only_grow_the_clipping():
    history = History.of_blocks([drive()])
    inverted = Setting(T_hat=1.5, K_hat=0.5)[:, None]
    shares = [
        float(
            replay(
                history,
                inverted,
                T_L=column(1.5),
                K_L=column(0.5),
                time_gap_now=column(1.0),
                accel_min=-limit,
                accel_max=limit,
            ).clipped_share
        )
        for limit in (1000.0, 10.0, 5.0, 3.0)
    ]
    assert shares[0] == 0.0
    assert shares == sorted(shares)
    assert shares[-1] > 0.2


def test_a_gap_that_opens_slowly_and_a_driver_who_takes_time():
    """Behind a leader who brakes: the wider the gap has become by then, the more room is left."""
    history = History.of_blocks([drive(start=120.0)])

    def seen(time_gap=2.5, **how):
        setting = Setting(time_gap=time_gap)[:, None]
        return replay(history, setting, T_L=column(0.3), K_L=column(1.0), time_gap_now=column(1.0), **how)

    slow, fast, late = seen(), seen(ramp_rate=1e3), seen(delay=10.0)
    assert float(fast.min_spacing_m) > float(slow.min_spacing_m) > float(late.min_spacing_m)
    assert float(fast.clipped_share) > float(slow.clipped_share)
    never, kept = seen(delay=100.0), seen(time_gap=1.0)
    assert float(never.min_spacing_m) == float(kept.min_spacing_m)


def test_a_scenario_is_predicted_alike_in_any_company():
    blocks = [drive(scenarios=4)]
    history = History.of_blocks(blocks)
    T, K = torch.tensor([0.1, 0.3, 1.5, 2.0]).double(), torch.tensor([1.1, 1.0, 0.5, 0.4]).double()
    setting = Setting(time_gap=torch.tensor([1.0, 1.6, 2.5]).expand(4, 3))
    gap = torch.ones(4, dtype=torch.float64)
    together = replay(history, setting, T_L=T, K_L=K, time_gap_now=gap)
    for i in range(4):
        one = torch.tensor([i])
        alone = replay(history[one], setting[one], T_L=T[one], K_L=K[one], time_gap_now=gap[one])
        for name, value in vars(alone).items():
            torch.testing.assert_close(value[0], getattr(together, name)[i], rtol=1e-9, atol=1e-9)


def test_history_keeps_the_last_seconds():
    block = drive(seconds=12.0)
    history = History.of_blocks([block[:600], block[600:]], seconds=5.0)
    assert history.seconds == pytest.approx(5.0)
    assert float(history.spacing) == float(block.spacing[0, -501])
    assert History.of_blocks([block], seconds=100.0).lead_speed.shape[1] == block.time.shape[0]
    with pytest.raises(InputError, match="rows"):
        History(0.01, torch.zeros(1, 1), torch.zeros(1, 1), torch.ones(1), torch.ones(1))
    with pytest.raises(InputError, match="lead_speed"):
        History(0.01, torch.zeros(1, 5), torch.zeros(1, 4), torch.ones(1), torch.ones(1))
