"""The replay: it repeats what happened, respects the limits, and does not depend on the batch."""

import pytest
import torch

from avtorch.decision.replay import History, replay
from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader, LowerLevel, performance


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
