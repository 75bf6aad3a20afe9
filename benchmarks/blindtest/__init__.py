"""The blind test: a reference vehicle that shares no code with the diagnosis, sealed cases, and their scores.

Example:
    >>> from benchmarks.blindtest import draw_case
    >>> case = draw_case(0, seed=1, mix={"none": 1.0}, seconds=20.0)
    >>> case.truth_name, case.log().accel_cmd is None
    ('none', False)
"""

from benchmarks.blindtest.car import Car, draw_car
from benchmarks.blindtest.case import Case, write
from benchmarks.blindtest.cases import draw_case, draw_cases
from benchmarks.blindtest.catalogue import CALIBRATION, EFFECTS, SEALED, Family, family
from benchmarks.blindtest.deck import KINDS, MIX
from benchmarks.blindtest.drives import DURATIONS_S, MANOEUVRES, RATES_HZ, DrivePlan, Recorded, draw_drive
from benchmarks.blindtest.in_front import IN_FRONT, put_in_front
from benchmarks.blindtest.recorder import Recorder, draw_recorder
from benchmarks.blindtest.score import score
from benchmarks.blindtest.vehicle import Run, simulate
from benchmarks.blindtest.visibility import TIERS, Oracle, Sight, sight, tier_of

__all__ = [
    "CALIBRATION",
    "DURATIONS_S",
    "EFFECTS",
    "IN_FRONT",
    "KINDS",
    "MANOEUVRES",
    "MIX",
    "RATES_HZ",
    "SEALED",
    "TIERS",
    "Car",
    "Case",
    "DrivePlan",
    "Family",
    "Oracle",
    "Recorded",
    "Recorder",
    "Run",
    "Sight",
    "draw_car",
    "draw_case",
    "draw_cases",
    "draw_drive",
    "draw_recorder",
    "family",
    "put_in_front",
    "score",
    "sight",
    "simulate",
    "tier_of",
    "write",
]
