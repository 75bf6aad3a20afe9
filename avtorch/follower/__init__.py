"""Cars that follow: diagnosis of loop, gap and cause where the demanded acceleration was not logged."""

from avtorch.follower.diagnose_follower import FollowerDiagnosis, diagnose_follower
from avtorch.follower.laws import LAWS as LAWS
from avtorch.follower.laws import FollowerMeasurements as FollowerMeasurements
from avtorch.follower.laws import HeadwayLaw as HeadwayLaw
from avtorch.follower.laws import loop_errors as loop_errors
from avtorch.follower.laws import loop_stability as loop_stability

__all__ = [
    "FollowerDiagnosis",
    "diagnose_follower",
]
