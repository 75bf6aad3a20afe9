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

from avtorch.gap.effects import (
    AerodynamicDrag,
    Backlash,
    BrakeThrottleAsymmetry,
    CommandHold,
    ConstantResistance,
    DeadBand,
    DeadTime,
    DrivelineOscillation,
    GainChange,
    GearShift,
    Gust,
    HandOver,
    LowSpeedCreep,
    Outliers,
    RateLimit,
    RoadGrade,
    Saturation,
    SecondOrderActuator,
    SensorBias,
    SensorLag,
    SensorScale,
    SpeedDependentGain,
    SpeedDependentLag,
    SpeedSensorLag,
    ViscousDrag,
)
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
