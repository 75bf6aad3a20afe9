"""Logs and their checks, recorded leaders, answers for machines."""

from avtorch.io.answers import write_json
from avtorch.io.atomic import atomic
from avtorch.io.following import read_following
from avtorch.io.log import STANDSTILL_MPS, Log
from avtorch.io.merge import held
from avtorch.io.quality import Gap, Quality, check
from avtorch.io.raw_leader import RawLeader
from avtorch.io.recordings import read_leader

__all__ = [
    "STANDSTILL_MPS",
    "Gap",
    "Log",
    "Quality",
    "RawLeader",
    "atomic",
    "check",
    "held",
    "read_following",
    "read_leader",
    "write_json",
]
