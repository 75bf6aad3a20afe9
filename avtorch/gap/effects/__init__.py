"""The effects that the diagnosis can name, a file each.

Example:
    >>> from avtorch.gap import EFFECTS, DeadTime
    >>> len(EFFECTS), DeadTime.place, DeadTime.equation
    (25, 'command', 'u(t - tau)')
"""

from avtorch.gap.effects.aerodynamic_drag import AerodynamicDrag as AerodynamicDrag
from avtorch.gap.effects.backlash import Backlash as Backlash
from avtorch.gap.effects.brake_throttle_asymmetry import BrakeThrottleAsymmetry as BrakeThrottleAsymmetry
from avtorch.gap.effects.command_hold import CommandHold as CommandHold
from avtorch.gap.effects.constant_resistance import ConstantResistance as ConstantResistance
from avtorch.gap.effects.dead_band import DeadBand as DeadBand
from avtorch.gap.effects.dead_time import DeadTime as DeadTime
from avtorch.gap.effects.driveline_oscillation import DrivelineOscillation as DrivelineOscillation
from avtorch.gap.effects.gain_change import GainChange as GainChange
from avtorch.gap.effects.gear_shift import GearShift as GearShift
from avtorch.gap.effects.gust import Gust as Gust
from avtorch.gap.effects.hand_over import HandOver as HandOver
from avtorch.gap.effects.low_speed_creep import LowSpeedCreep as LowSpeedCreep
from avtorch.gap.effects.outliers import Outliers as Outliers
from avtorch.gap.effects.rate_limit import RateLimit as RateLimit
from avtorch.gap.effects.road_grade import RoadGrade as RoadGrade
from avtorch.gap.effects.saturation import Saturation as Saturation
from avtorch.gap.effects.second_order_actuator import SecondOrderActuator as SecondOrderActuator
from avtorch.gap.effects.sensor_bias import SensorBias as SensorBias
from avtorch.gap.effects.sensor_lag import SensorLag as SensorLag
from avtorch.gap.effects.sensor_scale import SensorScale as SensorScale
from avtorch.gap.effects.speed_dependent_gain import SpeedDependentGain as SpeedDependentGain
from avtorch.gap.effects.speed_dependent_lag import SpeedDependentLag as SpeedDependentLag
from avtorch.gap.effects.speed_lag import SpeedSensorLag as SpeedSensorLag
from avtorch.gap.effects.viscous_drag import ViscousDrag as ViscousDrag
