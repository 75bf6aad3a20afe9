"""Estimators compared, learned ones too: one stream for all, and figures that match their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avtorch.inference import Belief, JerkForm, Window
from avtorch.vehicle import FollowerState, GLVDPlant
from benchmarks.estimators import CHANGE_S, DEGRADED, HEALTHY, Arm, drive, run, score
from benchmarks.learned.prediction import DT, DelayedGLVD, OneStep, Recurrent, errors, pieces, simulated

F64 = torch.float64


def window(start, mean, sd, *, excited=(True, True), converged=(True, True)):
    """Two vehicles that are believed to be the same, with a symmetric interval of 2 SDs."""
    middle = torch.tensor([mean, mean], dtype=F64)
    spread = torch.full_like(middle, sd)
    flags = [torch.tensor(f) for f in (excited, converged)]
    belief = Belief(("T_L", "K_L"), middle, spread, middle - 2 * spread, middle + 2 * spread, middle[None], *flags)
    return Window(start, start + 2.0, torch.tensor([200, 200]), belief)


def test_the_score_of_beliefs_made_by_hand():
    healthy = window(CHANGE_S - 2, (HEALTHY[0] + 0.1, HEALTHY[1]), 0.01)
    late_to_see = window(CHANGE_S, HEALTHY, 0.01)
    found = window(CHANGE_S + 2, (DEGRADED[0] + 0.1, DEGRADED[1]), 0.1)
    carried = window(60.0, (DEGRADED[0] + 0.2, DEGRADED[1]), 0.01, excited=(True, False), converged=(False, True))
    s = score(Arm("", None, [healthy, late_to_see, found, carried]))  # pyright: ignore[reportArgumentType]
    torch.testing.assert_close(s.error["before"], torch.tensor([0.1, 0.0], dtype=F64))
    assert s.coverage["before"].tolist() == [0.0, 1.0]
    assert s.coverage["after"].tolist() == [0.5, 0.5]
    assert s.delay.tolist() == [4.0, 4.0]
    # one window of seven excited ones did not converge
    assert s.used == 6 / 7
    assert s.coverage["late"].isnan().all()


def test_all_arms_see_the_same_rows():
    block = drive(2)
    assert float(block.accel[:, round(CHANGE_S / 0.01)].std()) > 0  # noise of their own
    part = slice(1000, 1600)
    columns = {name: getattr(block, name)[:, part] for name in JerkForm.columns}
    time, usable = block.time[part], torch.ones(2, 600, dtype=torch.bool)
    arms = run(
        {"map": {"estimator": "map"}, "rls": {"estimator": "rls"}}, JerkForm(), columns, time, usable, window=2.0
    )
    one, other = (arm.windows for arm in arms)
    assert len(one) == len(other) == 3
    for a, b in zip(one, other, strict=True):
        assert (a.start_s, a.end_s) == (b.start_s, b.end_s)
        assert a.belief.excited.equal(b.belief.excited)
    assert all(arm.seconds > 0 for arm in arms)


# The learned rivals: what they are given, and what stands in for the measured past.
@pytest.mark.slow
def test_glvd_foretells_a_car_that_is_glvd_and_finds_it() -> None:
    drive = [simulated(GLVDPlant(0.5, 0.8, sigma=0.0), 40.0, 40.0, 0)]
    truth = DelayedGLVD(0.5, 0.8, 0.0, 0.0)
    # the speed's noise of 2 mm/s over a step of 50 ms is 0.057 m/s² in a slope; over 0.2 s, of two readings, 0.014
    one, far = errors(truth, drive)
    assert one < 0.07
    assert far < 0.03
    late = errors(DelayedGLVD(0.5, 0.8, 0.3, 0.0), drive)[1]
    assert late > 3 * far
    found = DelayedGLVD.fit(drive)
    assert abs(found.lag + found.dead - 0.5) < 0.05
    assert abs(found.gain - 0.8) < 0.02


def test_networks_see_no_row_that_is_yet_to_come() -> None:
    """Measured speeds after the past change nothing, and a command changes nothing before it acts."""
    drive = simulated(GLVDPlant(0.3, 1.0, sigma=0.1), 40.0, 30.0, 1)
    past, u, _ = pieces([drive], 60, 40)
    torch.manual_seed(0)
    for net in (OneStep(), Recurrent(), DelayedGLVD(0.3, 1.0, 0.12, 0.0)):
        with torch.no_grad():
            before = net.rollout(past, u)
            other = u.clone()
            other[:, 30:] += 1.0
            after = net.rollout(past, other)
        torch.testing.assert_close(before[:, :30], after[:, :30], rtol=0, atol=1e-5)
        assert float((before - after)[:, 45:].abs().max()) > 1e-3


def test_features_of_the_sums_hold_all_six() -> None:
    """From the six numbers of least squares the sums come back."""
    posterior = pytest.importorskip("benchmarks.learned.posterior")
    windows = posterior.prior_windows(5, 0)
    f = posterior.from_sums(windows).double()
    rate, gain = 0.1 * torch.sinh(f[:, 0]), 0.1 * torch.sinh(f[:, 1])
    noise, errors_of, together = f[:, 2].exp(), f[:, 3:5].exp(), torch.tanh(f[:, 5])
    scale = (noise[:, None] / errors_of).square() / (1 - together.square())[:, None]
    aa, uu = scale[:, 0], scale[:, 1]
    sums = torch.from_numpy(windows.sums())
    torch.testing.assert_close(aa, sums[:, 4], rtol=2e-3, atol=0)
    torch.testing.assert_close(uu, sums[:, 6], rtol=2e-3, atol=0)
    au = together * (aa * uu).sqrt()
    torch.testing.assert_close(-rate * aa + gain * au, sums[:, 2], rtol=0.02, atol=0.05)


def test_the_environment_is_the_closed_loop() -> None:
    """What is seen and rewarded is that of the loop, and all episodes end together."""
    pytest.importorskip("stable_baselines3")
    from benchmarks.learned import policy

    env = policy.Following(3, seed=0)
    seen = env.reset()
    assert seen.shape == (3, 4)
    env.step_async(np.array([[0.5], [0.0], [-2.0]], np.float32))
    seen, reward, done, _ = env.step_wait()
    assert seen.shape == (3, 4)
    assert not done.any()
    assert (reward < 0).all()
    # half of the limit, nothing, and no more than the limit; a lag of 0.3 s has not followed wholly
    accel = 3.0 * seen[:, 2]
    assert 0 < accel[0] < 1.5
    assert accel[2] < -0.3
    steps = round(policy.EPISODE_S / (policy.DT * policy.TICKS)) - 2
    for _ in range(steps):
        env.step_async(np.zeros((3, 1), np.float32))
        _, _, done, infos = env.step_wait()
        if done.any():
            break
    assert done.all()
    assert infos[0]["TimeLimit.truncated"]
    assert len(env.returns) == 1


def test_a_policy_is_a_controller_that_is_limited() -> None:
    pytest.importorskip("stable_baselines3")
    from benchmarks.learned import policy

    net = torch.nn.Linear(4, 1).double()
    with torch.no_grad():
        net.weight.copy_(torch.tensor([[10.0, 0.0, 0.0, 0.0]]))
        net.bias.zero_()
    state = FollowerState(0.0, *(torch.tensor([x, x], dtype=F64) for x in (40.0, 20.0, 0.0, 20.0, 0.0)))
    assert policy.Policy(net)(state).tolist() == [policy.LIMIT] * 2
    assert DT == policy.DT
