"""A controller of unknown structure under the monitor: its slopes give the setting; the belief needs neither."""

import torch

from avtorch.decision import Setting, Supervisor
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader, LinearController, linearise


def network(state):
    """Saturating units around a linear law, as a small trained policy has them."""
    return 4.0 * torch.tanh(LinearController(time_gap=1.1)(state) / 4.0)


def test_a_change_is_detected_and_evaluated_by_the_slopes():
    law = linearise(network, 15.0)
    setting = Setting(time_gap=law.time_gap, gains=law.gains, feedforward=law.feedforward)
    loop = ClosedLoop(Leader.default(start=48), network, plant=GLVDPlant(0.3, 1.0, 0.1), scenarios=2, seeds=4)

    def change(world):
        world.plant = GLVDPlant(torch.tensor([1.5, 0.3]), torch.tensor([0.5, 1.0]), 0.1)

    run = Supervisor(loop, setting=setting, seed=4).run(12.0, events=[(6.0, change)])
    assert [(a.time_s, a.detector) for a in run.alerts[0]][:2] == [(8.0, "stability"), (8.0, "accepted_change")]
    assert run.alerts[1] == []
    last = run.windows[-1].window.belief
    truth = torch.tensor([[1.5, 0.5], [0.3, 1.0]], dtype=torch.float64)
    assert bool(((last.mean[:, :2] - truth).abs() < 5 * last.sd[:, :2]).all())
