"""The monitoring experiment behind US06: the truth it is held to, the alert, errors below the paper's."""

from __future__ import annotations

import pytest
import torch

from avtorch.paper import Leaders, Monitoring, monitoring
from avtorch.paper.monitoring import PAPER_ALERT_S, Watched

pytestmark = pytest.mark.slow  # all tests need the experiment itself


@pytest.fixture(scope="module")
def found() -> Monitoring:
    return monitoring(Leaders.read(), seeds=3, seed=11)


def test_truth_changes_with_the_vehicle(found: Monitoring) -> None:
    truth = found.watched[0].truth[:, 0]
    assert truth.shape == (40, 2)
    assert truth[12].tolist() == [0.3, 1.0]
    assert truth[13].tolist() == [1.5, 0.5]


def test_rows(found: Monitoring) -> None:
    rows = {(r.quantity, r.setting.split(",")[0]): r for r in found.rows}
    alert = rows["time of the alert [s]", "change at 26 s; US06"]
    # behind US06 the window after the change is excited whatever the noise (README, Figures)
    assert (alert.ours, alert.verdict) == (PAPER_ALERT_S, "same")
    for name, theirs in (("T_L [s]", 0.06), ("K_L [-]", 0.02)):
        before = rows[f"error of {name}", "before the change"]
        assert before.paper == pytest.approx(theirs)
        assert before.verdict == "better"
    # the mean over some 20 windows: 0.03 s and 0.004 in the README, far below the paper's
    assert rows["error of T_L [s]", "over all windows after"].verdict == "better"
    assert rows["error of K_L [-]", "over all windows after"].verdict == "better"


def test_nothing_excited_is_said(found: Monitoring) -> None:
    one = found.watched[0]
    blind = Watched(
        one.ahead,
        one.run,
        one.start,
        one.end,
        one.mean,
        torch.zeros_like(one.used),
        torch.full_like(one.alert, 1e9),
        torch.ones_like(one.early),
    )
    rows = blind.rows(0)
    assert all(r.verdict == "not reproduced" for r in rows)
    assert rows[0].ours == "not known"
    assert rows[-2].ours == "never"
    assert rows[-1].ours == 1.0
