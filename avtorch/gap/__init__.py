"""What the simulator lacks: effects along the chain command, actuator, body, sensor, and plants composed of them.

Example:
    >>> from avtorch import Leader, diagnose, simulate
    >>> from avtorch.gap import DeadTime, plant
    >>> late = plant([DeadTime(0.4)], sigma=0.0)  # a car whose commands act 0.4 s late
    >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=late).log()
    >>> found = diagnose(log, effects=["dead_time"], pairs=False)  # leave both out to try all effects
    >>> found.verdict.name, round(float(found.plant.values()["dead_time.delay_s"]), 1)
    ('dead_time', 0.4)
"""

from avtorch.gap.effects.aerodynamic_drag import AerodynamicDrag
from avtorch.gap.effects.backlash import Backlash
from avtorch.gap.effects.brake_throttle_asymmetry import BrakeThrottleAsymmetry
from avtorch.gap.effects.command_hold import CommandHold
from avtorch.gap.effects.constant_resistance import ConstantResistance
from avtorch.gap.effects.dead_band import DeadBand
from avtorch.gap.effects.dead_time import DeadTime
from avtorch.gap.effects.driveline_oscillation import DrivelineOscillation
from avtorch.gap.effects.gain_change import GainChange
from avtorch.gap.effects.gear_shift import GearShift
from avtorch.gap.effects.gust import Gust
from avtorch.gap.effects.hand_over import HandOver
from avtorch.gap.effects.low_speed_creep import LowSpeedCreep
from avtorch.gap.effects.outliers import Outliers
from avtorch.gap.effects.rate_limit import RateLimit
from avtorch.gap.effects.road_grade import RoadGrade
from avtorch.gap.effects.saturation import Saturation
from avtorch.gap.effects.second_order_actuator import SecondOrderActuator
from avtorch.gap.effects.sensor_bias import SensorBias
from avtorch.gap.effects.sensor_lag import SensorLag
from avtorch.gap.effects.sensor_scale import SensorScale
from avtorch.gap.effects.speed_dependent_gain import SpeedDependentGain
from avtorch.gap.effects.speed_dependent_lag import SpeedDependentLag
from avtorch.gap.effects.speed_lag import SpeedSensorLag
from avtorch.gap.effects.viscous_drag import ViscousDrag
from avtorch.gap.simulator.effect import (
    EFFECTS,
    PLACES,
    Effect,
    EffectContext,
    NoiseChange,
    register,
)
from avtorch.gap.simulator.force_table import FREE_FORMS, ForceTable, ResistanceCurve
from avtorch.gap.simulator.parameter import Domain, Parameter
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.recursion import scan
from avtorch.gap.simulator.simulator_input import Response, SimulatorInput

__all__ = [
    "EFFECTS",
    "FREE_FORMS",
    "PLACES",
    "AerodynamicDrag",
    "Backlash",
    "BrakeThrottleAsymmetry",
    "CommandHold",
    "ConstantResistance",
    "DeadBand",
    "DeadTime",
    "Domain",
    "DrivelineOscillation",
    "Effect",
    "EffectContext",
    "ForceTable",
    "GainChange",
    "GapPlant",
    "GearShift",
    "Gust",
    "HandOver",
    "LowSpeedCreep",
    "NoiseChange",
    "Outliers",
    "Parameter",
    "RateLimit",
    "ResistanceCurve",
    "Response",
    "RoadGrade",
    "Saturation",
    "SecondOrderActuator",
    "SensorBias",
    "SensorLag",
    "SensorScale",
    "SimulatorInput",
    "SpeedDependentGain",
    "SpeedDependentLag",
    "SpeedSensorLag",
    "ViscousDrag",
    "plant",
    "register",
    "scan",
]
