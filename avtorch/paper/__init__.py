"""The paper's figures and tables, one module each: rerun and compared with its claims."""

from avtorch.paper.estimation import Estimation, estimation
from avtorch.paper.gains import Gains, gains
from avtorch.paper.leaders import Leaders
from avtorch.paper.monitoring import Monitoring, monitoring
from avtorch.paper.platoon import Platoon, platoon
from avtorch.paper.regions import Regions, regions
from avtorch.paper.reproduce import EXPERIMENTS, SEEDS, Reproduction, reproduce
from avtorch.paper.rows import ClaimRow
from avtorch.paper.strategies import Strategies, strategies

__all__ = [
    "EXPERIMENTS",
    "SEEDS",
    "ClaimRow",
    "Estimation",
    "Gains",
    "Leaders",
    "Monitoring",
    "Platoon",
    "Regions",
    "Reproduction",
    "Strategies",
    "estimation",
    "gains",
    "monitoring",
    "platoon",
    "regions",
    "reproduce",
    "strategies",
]
