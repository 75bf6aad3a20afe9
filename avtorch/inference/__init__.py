"""Estimation: densities and priors, SGLD, Algorithm 1, and the sequential loop.

Example:
    >>> from avtorch import GLVDPlant, Leader, simulate
    >>> from avtorch.inference import JerkDensity, JerkStatistics, sample
    >>> run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
    >>> sums = JerkStatistics.from_samples(run.accel[:, 0], run.accel_cmd[:, 0], run.jerk[:, 0])
    >>> posterior = sample(JerkDensity(sums))
    >>> posterior.names, posterior.converged.tolist(), [round(x, 1) for x in posterior.mean[0].tolist()]
    (('T_L', 'K_L', 'sigma'), [True], [0.5, 0.9, 0.1])
"""

from avtorch.inference.belief import Belief
from avtorch.inference.chains import nested_rhat
from avtorch.inference.density import (
    ConstrainedDensity,
    Density,
    ScoredDensity,
    SelectableDensity,
    SubsampledDensity,
)
from avtorch.inference.form import Form, WindowLikelihood
from avtorch.inference.jerk import (
    ExcitationRule,
    JerkDensity,
    JerkForm,
    JerkPoints,
    JerkStatistics,
    jerk_log_likelihood,
)
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.posterior import Posterior
from avtorch.inference.quadrature import Quadrature, integrate
from avtorch.inference.sampler import sample
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.inference.sequential import SequentialInference
from avtorch.inference.sgld import SGLD
from avtorch.inference.stream import BeliefStream, Window

__all__ = [
    "SGLD",
    "Belief",
    "BeliefStream",
    "ConstrainedDensity",
    "Density",
    "ExcitationRule",
    "Form",
    "JerkDensity",
    "JerkForm",
    "JerkPoints",
    "JerkStatistics",
    "Mode",
    "Posterior",
    "Quadrature",
    "SamplerSettings",
    "ScoredDensity",
    "SelectableDensity",
    "SequentialInference",
    "SubsampledDensity",
    "Window",
    "WindowLikelihood",
    "find_mode",
    "integrate",
    "jerk_log_likelihood",
    "nested_rhat",
    "sample",
]
