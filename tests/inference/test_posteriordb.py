"""SGLD against independent reference draws, for posteriors unrelated to vehicles.

Three of stan-dev/posteriordb (BSD-3), written in torch: arK-arK, kidiq-kidscore_momiq, sblrc-blr. The recordings hold
``posteriordb/NAME.data.json`` and ``NAME.draws.npz``, 10 000 nearly independent draws each.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import HalfCauchy, HalfNormal, Normal
from torch.distributions.constraints import positive, real

from avtorch.inference import SamplerSettings, sample
from benchmarks.torch_density import TorchDensity
from tests.bars import BAR

NAMES = {"arK-arK": "arK", "kidiq-kidscore_momiq": "kidiq", "sblrc-blr": "sblrc"}


def density(name: str, folder: Path) -> TorchDensity:
    """The posterior ``name`` over its data in ``folder/posteriordb``."""
    data = json.loads((folder / "posteriordb" / f"{NAMES[name]}.data.json").read_text())
    return {"arK": _autoregression, "kidiq": _kidiq, "sblrc": _regression}[NAMES[name]](data)


def reference(name: str, folder: Path) -> dict[str, Tensor]:
    """Reference draws, ``(chain 10, draw 1000)`` a parameter."""
    with np.load(folder / "posteriordb" / f"{name}.draws.npz", allow_pickle=False) as draws:
        return {key: torch.from_numpy(np.asarray(draws[key], dtype=np.float64)) for key in draws.files}


def _column(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _regression_log_density(X: Tensor, y: Tensor, coefficients: Tensor, sigma: Tensor) -> Tensor:
    """``y ~ Normal(X beta, sigma)`` for ``coefficients`` ``(..., column)`` and ``sigma`` ``(...)``."""
    return Normal(coefficients @ X.T, sigma[..., None]).log_prob(y).sum(-1)


def _autoregression(data: dict) -> TorchDensity:
    order, y = data["K"], _column(data["y"])
    lagged = torch.stack(
        [torch.ones(len(y) - order, dtype=torch.float64), *(y[order - k : -k] for k in range(1, order + 1))], -1
    )
    names = ["alpha", *(f"beta[{k}]" for k in range(1, order + 1))]

    def log_density(p: dict[str, Tensor]) -> Tensor:
        coefficients = torch.stack([p[name] for name in names], -1)
        prior = Normal(0.0, 10.0).log_prob(coefficients).sum(-1) + HalfCauchy(2.5).log_prob(p["sigma"])
        return prior + _regression_log_density(lagged, y[order:], coefficients, p["sigma"])

    return TorchDensity(log_density, {**dict.fromkeys(names, real), "sigma": positive})


def _kidiq(data: dict) -> TorchDensity:
    score, iq = _column(data["kid_score"]), _column(data["mom_iq"])
    X = torch.stack([torch.ones_like(iq), iq], -1)

    def log_density(p: dict[str, Tensor]) -> Tensor:
        coefficients = torch.stack([p["beta[1]"], p["beta[2]"]], -1)
        return HalfCauchy(2.5).log_prob(p["sigma"]) + _regression_log_density(X, score, coefficients, p["sigma"])

    return TorchDensity(log_density, {"beta[1]": real, "beta[2]": real, "sigma": positive})


def _regression(data: dict) -> TorchDensity:
    X, y = torch.tensor(data["X"], dtype=torch.float64), _column(data["y"])
    names = [f"beta[{k}]" for k in range(1, X.shape[1] + 1)]

    def log_density(p: dict[str, Tensor]) -> Tensor:
        coefficients = torch.stack([p[name] for name in names], -1)
        prior = Normal(0.0, 10.0).log_prob(coefficients).sum(-1) + HalfNormal(10.0).log_prob(p["sigma"])
        return prior + _regression_log_density(X, y, coefficients, p["sigma"])

    return TorchDensity(log_density, {**dict.fromkeys(names, real), "sigma": positive})


@pytest.mark.statistical
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n == "arK-arK" else []) for n in NAMES])
def test_means_sds_and_quantiles_are_those_of_the_reference_draws(name, data_dir, rotating_seed, draws_factor):
    """5 sigma of both sets of draws, and 0.01 SDs (1 % of an SD) for the bias of the step.

    The reference draws count as independent: posteriordb keeps them only if they nearly are.
    """
    target, others = density(name, data_dir), reference(name, data_dir)
    settings = SamplerSettings(chains=2048 * draws_factor)
    posterior = sample(target, settings, generator=torch.Generator().manual_seed(rotating_seed))
    assert posterior.converged.all()
    assert set(target.names) == set(others)
    for parameter in target.names:
        theirs = others[parameter].flatten()
        center, scale = theirs.mean(), theirs.std()
        ours = (posterior[parameter][..., 0] - center) / scale
        # chains are independent of each other, whatever happens within them
        shift, wide = ours.mean(1), ours.square().mean(1)
        error = BAR * math.sqrt(1 / len(theirs) + shift.var().item() / len(shift))
        assert abs(shift.mean().item()) < error + 0.01, parameter
        # the variance's error from the fourth moment
        fourth = ((theirs - center) / scale).pow(4).mean().item()
        error = BAR * 0.5 * math.sqrt((fourth - 1) / len(theirs) + wide.var().item() / len(wide))
        assert abs(0.5 * (wide.mean().item() - 1)) < error + 0.01, parameter
        for q in (0.05, 0.25, 0.5, 0.75, 0.95):
            # share of each chain below their quantile; theirs has a binomial error of its own
            below = (posterior[parameter][..., 0] <= theirs.quantile(q)).double().mean(1)
            error = BAR * math.sqrt(q * (1 - q) / len(theirs) + below.var().item() / len(below))
            # 0.01 SDs of shift or width move at most 0.004 of the mass across a quantile
            assert abs(below.mean().item() - q) < error + 0.004, (parameter, q)
