"""A simulated log without any noise is many users' first trial: the estimate must converge."""

from __future__ import annotations

import pytest

from avtorch.decision import estimate
from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.vehicle import GLVDPlant, Leader, simulate


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(Leader.default(start=5.0), plant=GLVDPlant(0.4, 0.9, sigma=0.0), duration=12.0).log()


def test_log_without_noise_gives_the_truth(log: Log) -> None:
    found = estimate(log, window=2.0)
    used = [w.window.belief for w in found.windows if bool(w.window.belief.excited[0])]
    assert used
    for belief in used:
        assert bool(belief.converged[0])
        for name, truth in (("T_L", 0.4), ("K_L", 0.9)):
            stat = belief.stat(name)
            # the floor on sigma is 1e-4 of the RMS jerk; 200 rows and least squares do not enlarge it tenfold
            assert abs(stat["mean"] - truth) < 1e-3
            assert 0.0 < stat["sd"] < 1e-3


def test_window_of_a_few_rows_is_refused(log: Log) -> None:
    with pytest.raises(InputError, match=r"window: found 0\.01 s, needs 0\.1 s or more"):
        estimate(log, window=0.01)
    with pytest.raises(InputError, match="window: found 1e-09 s"):
        estimate(log, window=1e-9)
