"""Decisions: detectors, Algorithm 2, the strategist, and the supervisor that closes the loop online.

Example:
    >>> from avtorch import GLVDPlant, Leader, Setting, estimate, simulate
    >>> run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(T_L=1.5, K_L=0.5))
    >>> last = estimate(run.log(), estimator="map").windows[-1]
    >>> round(last.window.belief.stat("T_L")["mean"], 1), last.report.names()
    (1.4, ['stability', 'accepted_change'])
"""

from avtorch.decision.algorithm2 import Algorithm2, algorithm2
from avtorch.decision.estimation import Estimates, estimate
from avtorch.decision.grid import Grid
from avtorch.decision.monitor import DEFAULT_DETECTORS, DETECTORS, Monitor, MonitorReport
from avtorch.decision.replay import History, replay
from avtorch.decision.settings import DesignBounds, Setting
from avtorch.decision.strategist import Decision, Strategist
from avtorch.decision.supervisor import Supervisor
from avtorch.decision.watch import Action, Alert, SupervisedRun, Watch, WatchedWindow

__all__ = [
    "DEFAULT_DETECTORS",
    "DETECTORS",
    "Action",
    "Alert",
    "Algorithm2",
    "Decision",
    "DesignBounds",
    "Estimates",
    "Grid",
    "History",
    "Monitor",
    "MonitorReport",
    "Setting",
    "Strategist",
    "SupervisedRun",
    "Supervisor",
    "Watch",
    "WatchedWindow",
    "algorithm2",
    "estimate",
    "replay",
]
