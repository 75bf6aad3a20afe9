"""The effects that the diagnosis can name, by their place in the chain.

Example:
    >>> from avtorch.gap import EFFECTS, DeadTime
    >>> len(EFFECTS), DeadTime.place, DeadTime.equation
    (25, 'command', 'u(t - tau)')
"""

from avtorch.gap.effects.actuator import BrakeThrottleAsymmetry as BrakeThrottleAsymmetry
from avtorch.gap.effects.actuator import GainChange as GainChange
from avtorch.gap.effects.actuator import GearShift as GearShift
from avtorch.gap.effects.actuator import RateLimit as RateLimit
from avtorch.gap.effects.actuator import SecondOrderActuator as SecondOrderActuator
from avtorch.gap.effects.actuator import SpeedDependentGain as SpeedDependentGain
from avtorch.gap.effects.actuator import SpeedDependentLag as SpeedDependentLag
from avtorch.gap.effects.body import AerodynamicDrag as AerodynamicDrag
from avtorch.gap.effects.body import ConstantResistance as ConstantResistance
from avtorch.gap.effects.body import DrivelineOscillation as DrivelineOscillation
from avtorch.gap.effects.body import Gust as Gust
from avtorch.gap.effects.body import LowSpeedCreep as LowSpeedCreep
from avtorch.gap.effects.body import RoadGrade as RoadGrade
from avtorch.gap.effects.body import ViscousDrag as ViscousDrag
from avtorch.gap.effects.command import Backlash as Backlash
from avtorch.gap.effects.command import CommandHold as CommandHold
from avtorch.gap.effects.command import DeadBand as DeadBand
from avtorch.gap.effects.command import DeadTime as DeadTime
from avtorch.gap.effects.command import HandOver as HandOver
from avtorch.gap.effects.command import Saturation as Saturation
from avtorch.gap.effects.sensor import Outliers as Outliers
from avtorch.gap.effects.sensor import SensorBias as SensorBias
from avtorch.gap.effects.sensor import SensorLag as SensorLag
from avtorch.gap.effects.sensor import SensorScale as SensorScale
from avtorch.gap.effects.sensor import SpeedSensorLag as SpeedSensorLag
