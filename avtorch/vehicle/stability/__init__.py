"""Stability of the car-following loop: Eq. 2, Eq. 3, the exact string condition, dead time, regions and beliefs.

Example:
    >>> from avtorch import stability
    >>> gains = (1.5, 1.5, -0.8)
    >>> round(float(stability.peak_gain(T_L=1.5, K_L=0.5, time_gap=1.0, gains=gains)), 4)  # amplifies
    2.2445
    >>> bool(stability.string_stable(T_L=1.5, K_L=0.5, time_gap=2.5, gains=gains))  # a longer gap repairs it
    True
"""

from avtorch.vehicle.stability.belief import (
    Interval,
    StabilityBelief,
    p_locally_and_string_stable,
    p_string_stable,
    stability_belief,
)
from avtorch.vehicle.stability.chain import Chain, ChainVerdict, actuator, chain_verdict, frequencies
from avtorch.vehicle.stability.conditions import (
    Conditions,
    local_conditions,
    string_conditions,
    string_sufficient,
)
from avtorch.vehicle.stability.exact import string_margins
from avtorch.vehicle.stability.local_and_string import (
    dead_time_margin,
    local_stable,
    peak_frequency,
    peak_gain,
    string_stable,
)
from avtorch.vehicle.stability.region import Region, region
from avtorch.vehicle.stability.transfer import gain

__all__ = [
    "Chain",
    "ChainVerdict",
    "Conditions",
    "Interval",
    "Region",
    "StabilityBelief",
    "actuator",
    "chain_verdict",
    "dead_time_margin",
    "frequencies",
    "gain",
    "local_conditions",
    "local_stable",
    "p_locally_and_string_stable",
    "p_string_stable",
    "peak_frequency",
    "peak_gain",
    "region",
    "stability_belief",
    "string_conditions",
    "string_margins",
    "string_stable",
    "string_sufficient",
]
