"""Open-loop errors taken into the loop, against loops that are simulated."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.gap.crossval.closed_loop_errors import ClosedLoopMetric, closed_loop_metrics

DT = 0.005
GAINS = (0.4, 0.9, -0.3)
GAP = 1.2


def loops(T: float, K: float, push: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed and spacing (row,) behind a leader that wanders, with a force `push` (row,) [m/s²] on the car."""
    time = np.arange(len(push)) * DT
    lead = 20 + 2 * np.sin(0.4 * time) + np.sin(0.09 * time)
    v, a, s = lead[0], 0.0, 5 + GAP * lead[0]
    speed, spacing = [v], [s]
    k_s, k_v, k_a = GAINS
    for k in range(len(push) - 1):
        u = k_s * (s - 5 - GAP * v) + k_v * (lead[k] - v) + k_a * (a + push[k])
        a += DT * (K * u - a) / T
        s += DT * (lead[k] - v)
        v += DT * (a + push[k])
        speed.append(v)
        spacing.append(s)
    return np.array(speed), np.array(spacing)


@pytest.mark.parametrize("channel", ["speed", "accel"])
def test_superposition_is_what_the_loops_differ_by(channel: str, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    T, K = float(rng.uniform(0.2, 0.8)), float(rng.uniform(0.7, 1.2))
    time = np.arange(round(60 / DT)) * DT
    push = 0.2 * np.sin(rng.uniform(0.2, 1.0) * time) + 0.1 * (time > 20)
    push[0] = 0.0
    (v1, s1), (v0, s0) = loops(T, K, push), loops(T, K, np.zeros_like(push))
    error = push if channel == "accel" else np.concatenate([[0.0], np.cumsum(push[:-1]) * DT])
    for quantity, want in (("speed", v1 - v0), ("spacing", s1 - s0)):
        metric = ClosedLoopMetric(channel, quantity, T, K, GAP, GAINS)
        told = metric.of(np.stack([error, 2 * error]), DT)
        # Euler steps of 5 ms against a bilinear transform
        np.testing.assert_allclose(told[0], want, atol=0.01 * np.abs(want).max() + 1e-4)
        np.testing.assert_allclose(told[1], 2 * told[0])


def test_a_loop_that_does_not_forget_is_no_measure() -> None:
    assert {m.name for m in closed_loop_metrics(("accel", "speed"), 0.3, 1.0)} == {
        "closed_loop_rmse_speed",
        "closed_loop_rmse_spacing",
    }
    assert all(m.channel == "speed" for m in closed_loop_metrics(("accel", "speed"), 0.3, 1.0))
    assert closed_loop_metrics(("accel",), 0.3, 1.0)[0].channel == "accel"
    assert not ClosedLoopMetric("speed", "speed", 4.0, 1.0, 0.1, (1.5, 0.05, 0.0)).stable
