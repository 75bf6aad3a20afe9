"""The dead time of a log, from its likelihood."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avtorch.decision import estimate
from avtorch.decision.dead_time import GRID_S
from avtorch.inference.latent_model import discretise
from avtorch.io import Log


def driven(dead_time: float, seed: int, *, jitter: float = 0.0, seconds: float = 40.0, rate: float = 50.0) -> Log:
    """Speed of a car with T_L 0.3 s and K_L 0.9 that obeys steps of the command ``dead_time`` [s] later."""
    random = np.random.default_rng(seed)
    rows, late = int(seconds * rate), round(dead_time * rate)
    time = (np.arange(rows) + jitter * random.uniform(-1, 1, rows)) / rate
    u = random.normal(size=rows)[np.cumsum(random.random(rows) < 1.0 / rate)]
    obeyed = np.concatenate([np.zeros(late), u[: rows - late]])
    steps = torch.from_numpy(np.diff(time))
    values = (torch.tensor(x, dtype=torch.float64) for x in (0.3, 0.9, 0.1, 0.005, 0.1, 1.5))
    step = discretise(*values, steps)
    root = torch.linalg.cholesky(step.noise + 1e-18 * torch.eye(4)).numpy()
    phi, gain = step.transition.numpy(), step.gain.numpy()
    x, speed = np.array([20.0, 0.0, 0.0, 0.1 * random.normal()]), []
    for k in range(rows):
        speed.append(x[0] + x[2] + 0.01 * random.normal())
        if k + 1 < rows:
            x = phi[k] @ x + gain[k] * obeyed[k] + root[k] @ random.normal(size=4)
    return Log.from_arrays(time=time - time[0], accel_cmd=u, speed=np.array(speed))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_a_dead_time_is_found_and_the_lag_behind_it(jitter: float, rotating_seed: int) -> None:
    found = estimate(driven(0.2, rotating_seed, jitter=jitter), window=10.0, dead_time=None, seed=rotating_seed)
    assert found.inferred is not None
    # a step of the command falls anywhere within a row's 20 ms where the clock jitters
    assert abs(found.dead_time - 0.2) < 0.04
    assert found.inferred.nats > 10.0
    last = found.windows[-1].window.belief.stat("T_L")
    assert abs(last["mean"] - 0.3) < 5 * last["sd"] + 0.04


@pytest.mark.slow
@pytest.mark.statistical
def test_none_is_claimed_where_there_is_none(rotating_seed: int) -> None:
    found = estimate(driven(0.0, rotating_seed), window=10.0, dead_time=None, seed=rotating_seed)
    assert found.inferred is not None
    assert found.dead_time == 0.0
    assert 0.0 <= found.inferred.q05 <= found.inferred.q95 < GRID_S[2]


def test_a_given_dead_time_is_not_inferred(fresh_seed: int) -> None:
    found = estimate(driven(0.0, fresh_seed, seconds=8.0), window=4.0, dead_time=0.1, estimator="map")
    assert found.inferred is None
    assert found.dead_time == 0.1
