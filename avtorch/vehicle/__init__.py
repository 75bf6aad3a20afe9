"""The GLVD, controllers, closed loop and platoons, leaders, performance; stability has its own package.

Example:
    >>> from avtorch.vehicle import GLVDPlant, Leader, performance, simulate
    >>> leader = Leader.default(start=180.0, duration=40.0, dt=0.05)
    >>> run = simulate(leader, plant=GLVDPlant(T_L=1.5, K_L=0.5, sigma=0.0))
    >>> float(performance(run).accel_rms_ratio.round(decimals=2))  # above 1: the follower amplifies
    1.14
"""

from avtorch.vehicle.black_box import Linearised, linearise, measured_gain
from avtorch.vehicle.block import Block, Trajectory
from avtorch.vehicle.controllers import NOMINAL_GAINS, RAMP_RATE, Controller, FollowerState, LinearController, TimeGap
from avtorch.vehicle.glvd import GLVD, glvd_jerk, glvd_rollout, glvd_step
from avtorch.vehicle.leader import Leader
from avtorch.vehicle.loop import ClosedLoop, simulate
from avtorch.vehicle.lower_level import LowerLevel
from avtorch.vehicle.mpc import MPC
from avtorch.vehicle.performance import Performance, equilibrium_throughput, performance
from avtorch.vehicle.plant import GLVDPlant, Plant
from avtorch.vehicle.second_order import PositionLag, SpeedLag

__all__ = [
    "GLVD",
    "MPC",
    "NOMINAL_GAINS",
    "RAMP_RATE",
    "Block",
    "ClosedLoop",
    "Controller",
    "FollowerState",
    "GLVDPlant",
    "Leader",
    "LinearController",
    "Linearised",
    "LowerLevel",
    "Performance",
    "Plant",
    "PositionLag",
    "SpeedLag",
    "TimeGap",
    "Trajectory",
    "equilibrium_throughput",
    "glvd_jerk",
    "glvd_rollout",
    "glvd_step",
    "linearise",
    "measured_gain",
    "performance",
    "simulate",
]
