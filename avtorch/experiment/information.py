"""How well a manoeuvre would distinguish causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from avtorch.experiment.prediction import ManoeuvrePrediction


@dataclass(frozen=True)
class Information:
    """`nats`: mutual information between the cause and the measurements to come, at most the entropy of the cause.

    `truth_probability`: expected probability of the true cause afterwards. `margin`: median log odds [nats] of the true
    cause against the likest other one, for the worst pair.

    Example:
        >>> from avtorch.experiment import Information
        >>> expected = Information(0.6, 0.95, 4.0)
        >>> 0.69 - expected.nats < 0.1  # of two causes alike in probability, log 2 nats, little stays unknown
        True
    """

    nats: float
    truth_probability: float
    margin: float


def information(
    predictions: Sequence[ManoeuvrePrediction], number: int, prior: Sequence[float], *, seed: int = 0
) -> Information:
    """The information of manoeuvre `number`, from simulated measurements; `prior` has the causes' probabilities.

    Each simulated measurement is scored under the distribution of each cause.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.experiment import ManoeuvrePrediction, information, library
        >>> from avtorch.gap import DeadTime, plant
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log()
        >>> cause = diagnose(log, effects=["dead_time"], pairs=False).contenders[0]
        >>> one = ManoeuvrePrediction.of(cause, library(), ("accel", "speed"), group=1, draws=20)
        >>> round(information([one, one], 0, prior=[0.5, 0.5]).nats, 3)  # two causes that do the same
        0.0
    """
    rng = np.random.default_rng([seed, number])
    laws = [f.law(number) for f in predictions]
    log_prior = np.log(np.maximum(np.asarray(prior, float) / np.sum(prior), 1e-6))
    nats, truth_probability, margin = 0.0, 0.0, np.inf
    for i, one in enumerate(predictions):
        measured = one.examples(number, rng)
        densities = np.stack([law.log_density(measured) for law in laws])
        joint = densities + log_prior[:, None]
        posterior = joint[i] - logsumexp(joint, axis=0)
        weight = float(np.exp(log_prior[i]))
        nats += weight * float((posterior - log_prior[i]).mean())
        truth_probability += weight * float(np.exp(posterior).mean())
        others = np.delete(densities, i, axis=0)
        margin = min(margin, float(np.median(densities[i] - others, axis=1).min()))
    return Information(max(nats, 0.0), truth_probability, margin)
