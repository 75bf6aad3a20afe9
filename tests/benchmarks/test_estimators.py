"""The comparison of estimators: one stream for all, and figures that match their definitions."""

from __future__ import annotations

import torch

from avtorch.inference import Belief, JerkForm, Window
from benchmarks.estimators import CHANGE_S, DEGRADED, HEALTHY, Arm, drive, run, score

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
