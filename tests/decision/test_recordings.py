"""The latent form on a real car: a Hyundai Genesis, commanded acceleration and measured speed, three laps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avtorch.decision import Estimates, estimate
from avtorch.io import Log
from avtorch.pedals import fit_pedals


@pytest.fixture(scope="module")
def laps(data_dir: Path) -> list[Estimates]:
    return [estimate(Log.read(data_dir / "genesis" / f"lap{i}.csv"), window=10.0) for i in (1, 2, 3)]


def excited(found: Estimates, name: str) -> np.ndarray:
    """``(window, 2)``: mean and SD of a parameter over the whole 10 s windows that were used."""
    rows = []
    for w in found.windows:
        belief = w.window.belief
        if bool(belief.excited[0] & belief.converged[0]) and int(w.window.n[0]) > 950:
            stat = belief.stat(name)
            rows.append((stat["mean"], stat["sd"]))
    return np.array(rows)


@pytest.mark.slow
def test_lag_and_gain_of_the_genesis(laps: list[Estimates]) -> None:
    """Lag and delay together are about 0.32 s there, the gain about 0.96, by whole-lap fits of others."""
    T, K = (np.concatenate([excited(lap, name) for lap in laps]) for name in ("T_L", "K_L"))
    assert len(T) >= 9
    assert abs(np.median(T[:, 0]) - 0.32) <= 0.06
    assert abs(np.median(K[:, 0]) - 0.96) <= 0.05
    medians = [np.median(excited(lap, "T_L")[:, 0]) for lap in laps]
    assert max(medians) - min(medians) <= 0.08


@pytest.mark.slow
def test_spread_of_windows_is_relative_to_their_posteriors(laps: list[Estimates]) -> None:
    """Spread over posterior SD: about 1 for the lag; about 2 for the gain, which differs along the lap (see README)."""
    T, K = (np.concatenate([excited(lap, name) for lap in laps]) for name in ("T_L", "K_L"))
    ratio_T, ratio_K = (x[:, 0].std(ddof=1) / np.median(x[:, 1]) for x in (T, K))
    print(f"spread over posterior SD: T_L {ratio_T:.2f}, K_L {ratio_K:.2f}")
    assert ratio_T <= 1.5
    # 1.5 is the aim; the bar is today's value plus a tenth, so that a regression is detected
    assert ratio_K <= 2.2


@pytest.mark.slow
def test_lag_and_gain_of_the_av21(data_dir: Path) -> None:
    """Behind the filter of its accelerometer, of 2.5 s, the lag seems 3.7 s; on its map's commands it is 0.2 s."""
    file = data_dir / "indy_av21" / "Putnam_park2023_run4_2.csv"
    log = Log.read(file, map=["throttle=throttle_pct", "brake=brake_kPa"], unit=["throttle=%", "brake=kPa"])
    fit = fit_pedals(log)
    found = estimate(fit.map.commanded(log), dead_time=None)
    assert found.late is not None
    assert not found.late.recoverable
    used = [w.window.belief for w in found.windows if bool(w.window.belief.excited[0] & w.window.belief.converged[0])]
    lag, gain = (float(np.median([belief.stat(name)["mean"] for belief in used])) for name in ("T_L", "K_L"))
    assert len(used) > 20
    # the map's own lag, 0.07 s, is less than that by five of its standard errors, which are too small here
    assert abs(lag + found.dead_time - fit.map.T_L - fit.map.dead_time) < 0.15
    # the map's own gain is 1; that of 37 windows of 2 s has a spread of a sixth, so 5 sigma of their median
    assert abs(gain - 1) < 5 * 1.25 * 0.17 / np.sqrt(len(used))
