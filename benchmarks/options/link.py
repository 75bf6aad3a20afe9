"""Feed-forward on the leader's acceleration over a link with delay: verdict, simulation, strategy."""

from __future__ import annotations

import torch

from avtorch.decision import Grid, History, Setting, Strategist, SupervisedRun
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader, LinearController, LowerLevel, measured_gain, stability
from benchmarks.options.watched import last_used, watched

MILD = (1.0, 0.8)
GAINS = (1.5, 1.5, -0.8)
K_F = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5)
DELAYS = (0.0, 0.1, 0.2, 0.3, 0.5)


def verdict() -> None:
    """Exact peak gain over k_f and the link's delay, for a mildly worn vehicle."""
    print(f"vehicle {MILD}, time gap 1 s, gains {GAINS}: exact peak gain")
    print("| delay [s] | " + " | ".join(f"k_f {k:g}" for k in K_F) + " |")
    print("|---|" + "---|" * len(K_F))
    for delay in DELAYS:
        peaks = stability.peak_gain(
            *MILD, 1.0, GAINS, feedforward=torch.tensor(K_F, dtype=torch.float64), feedforward_delay=delay
        )
        print(f"| {delay:g} | " + " | ".join(f"{float(p):.3f}" for p in peaks) + " |")
    print("\nat the frequency of the peak, or 1 rad/s: simulated against exact, k_f 0.75")
    for delay in DELAYS:
        how = {"feedforward": 0.75, "feedforward_delay": delay}
        at = stability.peak_frequency(*MILD, 1.0, GAINS, **how).clamp_min(0.0)
        omega = float(at) if float(at) > 0 else 1.0
        simulated = measured_gain(
            LinearController(GAINS, 1.0, feedforward=0.75), [omega], plant=GLVDPlant(*MILD, 0.0), link_delay=delay
        )
        # a command held for a step of 0.01 s acts half a step late
        exact = stability.gain(omega, *MILD, 1.0, GAINS, dead_time=0.005, **how)
        print(f"  delay {delay:g} s, {omega:.2f} rad/s: {float(simulated[0]):.4f}, {float(exact):.4f}")


def strategy() -> None:
    """What the strategist selects, with and without a link, when the lower level must not be changed.

    Decided twice: with the first belief after the change, 2 s later, and with the last one of the drive, 14 s later.
    """
    print("| T_L [s], K_L | link | 2 s after the change | cost, P, exact gain | 14 s after | cost, P, exact gain |")
    print("|---|---|---|---|---|---|")
    for vehicle in ((0.8, 0.7), (1.0, 0.8), (1.5, 0.5)):
        drives = [watched(_strong, vehicle=vehicle, duration=end) for end in (28.0, 40.0)]
        for delay in (None, 0.1, 0.3, 0.5):
            cells = [_decided(run, vehicle, delay) for run in drives]
            name = "none" if delay is None else f"{delay:g} s late"
            print(f"| {vehicle[0]}, {vehicle[1]} | {name} | {' | '.join(cells)} |")


def _strong(leader: Leader) -> ClosedLoop:
    """An actuator without clipping, as the question here is stability."""
    return ClosedLoop(leader, lower_level=LowerLevel(accel_min=-12.0, accel_max=12.0), seeds=0)


def _decided(run: SupervisedRun, vehicle: tuple[float, float], delay: float | None) -> str:
    late, links = (0.0, ()) if delay is None else (delay, (0.25, 0.5, 0.75, 1.0))
    rules = Strategist(Grid(allowed=frozenset({2, 3, 4}), feedforward=links), link_delay=late)
    T, K = (last_used(run).draws[..., i].mT.double() for i in range(2))
    past = History.of_blocks([run.rows])
    chosen = rules.decide(T, K, past, current=Setting(), default=Setting(), accel_min=-12.0, accel_max=12.0)
    s = chosen.setting.as_dict()
    steps = [f"time gap {s['time_gap_s']:g} s"] if 2 in chosen.strategies[0] else []
    steps += ["gains " + "/".join(f"{k:g}" for k in s["gains"])] if 3 in chosen.strategies[0] else []
    steps += [f"k_f {s['feedforward']:g}"] if 4 in chosen.strategies[0] else []
    truth = (torch.tensor([x], dtype=torch.float64) for x in vehicle)
    gain = float(chosen.setting.peak_gain(*truth, link_delay=late)[0])
    note = "" if bool(chosen.sufficient[0]) else ", not sufficient"
    what = ", ".join(steps) or "default"
    return f"{what} | {float(chosen.intrusiveness[0]):.2f}, {float(chosen.p_string_stable[0]):.2f}, {gain:.3f}{note}"
