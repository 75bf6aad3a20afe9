"""Cars that follow: diagnosis of loop, gap and cause where the demanded acceleration was not logged."""

from avtorch.follower.closed_loop import LoopErrors, loop_errors
from avtorch.follower.diagnose_follower import FollowerDiagnosis, diagnose_follower
from avtorch.follower.identify import Identified
from avtorch.follower.laws import LAWS, ConstantTimeGap, FollowerMeasurements, HeadwayLaw, IntelligentDriver, Slopes
from avtorch.follower.loop_stability import LoopStability, loop_stability

__all__ = [
    "LAWS",
    "ConstantTimeGap",
    "FollowerDiagnosis",
    "FollowerMeasurements",
    "HeadwayLaw",
    "Identified",
    "IntelligentDriver",
    "LoopErrors",
    "LoopStability",
    "Slopes",
    "diagnose_follower",
    "loop_errors",
    "loop_stability",
]
