"""How well a manoeuvre would tell causes apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from avtorch.experiment.foretold import Prediction

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Information:
    """`nats`: mutual information between the cause and what will be measured, at most the entropy of the cause.

    `told`: expected probability of the true cause afterwards. `margin`: median log odds [nats] of the true cause
    against the likest other one, for the worst pair.
    """

    nats: float
    told: float
    margin: float


def information(foretold: Sequence[Prediction], number: int, prior: Sequence[float], *, seed: int = 0) -> Information:
    """Of manoeuvre `number`, with causes a priori as probable as `prior` says, by examples of what would be measured.

    Every example is judged by the law of each cause.
    """
    rng = np.random.default_rng([seed, number])
    laws = [f.law(number) for f in foretold]
    log_prior = np.log(np.maximum(np.asarray(prior, float) / np.sum(prior), 1e-6))
    nats, told, margin = 0.0, 0.0, np.inf
    for i, one in enumerate(foretold):
        measured = one.examples(number, rng)
        densities = np.stack([law.log_density(measured) for law in laws])
        joint = densities + log_prior[:, None]
        posterior = joint[i] - logsumexp(joint, axis=0)
        weight = float(np.exp(log_prior[i]))
        nats += weight * float((posterior - log_prior[i]).mean())
        told += weight * float(np.exp(posterior).mean())
        others = np.delete(densities, i, axis=0)
        margin = min(margin, float(np.median(densities[i] - others, axis=1).min()))
    return Information(max(nats, 0.0), told, margin)
