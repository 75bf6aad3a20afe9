"""The effects that the diagnosis can name, one file each, in the order of the chain.

Example:
    >>> from avtorch.gap import effects
    >>> len(effects.__all__), effects.DeadTime.place, effects.DeadTime.equation
    (25, 'command', 'u(t - tau)')
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

__all__ = [
    "AerodynamicDrag",
    "Backlash",
    "BrakeThrottleAsymmetry",
    "CommandHold",
    "ConstantResistance",
    "DeadBand",
    "DeadTime",
    "DrivelineOscillation",
    "GainChange",
    "GearShift",
    "Gust",
    "HandOver",
    "LowSpeedCreep",
    "Outliers",
    "RateLimit",
    "RoadGrade",
    "Saturation",
    "SecondOrderActuator",
    "SensorBias",
    "SensorLag",
    "SensorScale",
    "SpeedDependentGain",
    "SpeedDependentLag",
    "SpeedSensorLag",
    "ViscousDrag",
]
