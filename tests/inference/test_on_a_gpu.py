"""Everything in `inference` on a graphics card, whose random numbers are others: what is exact is compared as numbers,
what is drawn by its spread."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from avtorch.inference import BeliefStream, SamplerSettings, find_mode, integrate, sample
from avtorch.inference.estimators import ESTIMATORS
from avtorch.inference.importance import weighted_draws
from avtorch.inference.sgld import SGLD
from tests.inference.device_cases import DENSITIES, F64, jerk_density, rows, same

CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU on this machine")


@pytest.mark.gpu
@CUDA
@pytest.mark.parametrize("name", DENSITIES)
def test_on_a_gpu_densities_and_modes(name: str) -> None:
    here, there = DENSITIES[name]("cpu"), DENSITIES[name]("cuda")
    z = here.initial() + 0.1
    same(there.log_prob(z.cuda()), here.log_prob(z), 1e-8)
    if hasattr(here, "log_prob_minibatch"):
        batch = torch.arange(10)
        same(there.log_prob_minibatch(z.cuda(), batch.cuda()), here.log_prob_minibatch(z, batch))
    same(find_mode(there).z, find_mode(here).z, 1e-4)


@pytest.mark.gpu
@CUDA
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_on_a_gpu_streams(estimator: str) -> None:
    """Means by Monte Carlo agree to a tenth of an SD: thousands of draws err by a fiftieth."""
    time, columns = rows(count=401)
    beliefs = []
    for device in ("cpu", "cuda"):
        stream = BeliefStream(window=2.0, vehicles=2, estimator=estimator, device=device)
        block = {name: columns[name] for name in stream.form.columns}
        beliefs.append(stream.feed(time, block)[-1].belief)
    assert beliefs[1].draws.device.type == "cuda"
    assert ((beliefs[1].mean.cpu() - beliefs[0].mean).abs() < 0.1 * beliefs[0].sd).all()


@pytest.mark.gpu
@CUDA
def test_on_a_gpu_quadrature_is_the_same() -> None:
    same(integrate(jerk_density("cuda"), nodes=25).mean, integrate(jerk_density("cpu"), nodes=25).mean, 1e-4)


@pytest.mark.gpu
@CUDA
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("jerk, switch", SamplerSettings()),
        ("own", SamplerSettings()),
        ("points", SamplerSettings(noise="independent", step=0.2)),
    ],
)
def test_on_a_gpu_sample(name: str, settings: SamplerSettings) -> None:
    found = []
    for device in ("cpu", "cuda"):
        generator = torch.Generator(device=device).manual_seed(1)
        found.append(sample(DENSITIES[name](device), settings, generator=generator))
    here, there = found
    assert there.draws.device.type == "cuda"
    assert ((there.mean.cpu() - here.mean).abs() < 0.15 * here.sd).all()
    assert ((there.sd.cpu() / here.sd).log().abs() < 0.15).all()
    assert there.converged.tolist() == here.converged.tolist()


@pytest.mark.gpu
@CUDA
def test_on_a_gpu_modes_of_a_hundred_thousand_windows() -> None:
    """cuSOLVER decomposes no such number of matrices at once."""
    density = jerk_density("cuda")
    z = find_mode(density.select(torch.zeros(100_000, dtype=torch.long, device="cuda"))).z
    same(z[::33_333], find_mode(jerk_density("cpu")).z[:1].expand(4, 3), 1e-4)


@pytest.mark.gpu
@CUDA
@pytest.mark.parametrize(
    ("optimizer", "options"),
    [(SGLD, {}), (SGLD, {"noise": "averaged", "noise_dtype": torch.float32}), (SGLD, {"foreach": True})],
)
def test_on_a_gpu_optimizers(optimizer: Any, options: dict[str, Any]) -> None:
    """A step without noise is the processor's; with noise the law is; and a state gives the same draws again."""

    def walk(device: str, temperature: float, steps: int, state: Any = None) -> tuple[torch.Tensor, Any]:
        theta = torch.linspace(-1, 1, 20_000, dtype=F64, device=device).requires_grad_()
        generator = torch.Generator(device=device).manual_seed(2)
        by = optimizer([theta], lr=0.4, temperature=temperature, generator=generator, **options)
        if state is not None:
            by.load_state_dict(state)
        for _ in range(steps):
            by.step(lambda: 0.5 * (theta - 1).square().sum())
        return theta.detach(), by

    same(walk("cuda", 0.0, 5)[0], walk("cpu", 0.0, 5)[0])
    (there, by), (here, _) = walk("cuda", 1.0, 60), walk("cpu", 1.0, 60)
    assert there.device.type == "cuda"
    # standard errors of 20,000 independent chains: 0.007 of a mean, 0.005 of an SD
    assert abs(float(there.mean()) - float(here.mean())) < 0.06
    assert abs(float(there.std() / here.std()) - 1) < 0.05
    state = by.state_dict()
    assert walk("cuda", 1.0, 3, state)[0].tolist() == walk("cuda", 1.0, 3, state)[0].tolist()


@pytest.mark.gpu
@CUDA
@pytest.mark.parametrize("name", ["jerk, quadrant", "even rows"])
def test_on_a_gpu_importance(name: str) -> None:
    found = []
    for device in ("cpu", "cuda"):
        generator = torch.Generator(device=device).manual_seed(3)
        drawn = weighted_draws(DENSITIES[name](device), generator=generator)
        equal = drawn.equal(10, generator)
        assert {drawn.z.device.type, drawn.weight.device.type, equal.device.type} == {device}
        mean = (drawn.weight[..., None] * drawn.z).sum(0)
        spread = (drawn.weight[..., None] * (drawn.z - mean).square()).sum(0).sqrt()
        found.append((mean.cpu(), spread.cpu()))
    (here, sd), (there, other) = found
    # 400 effective draws on either side: a mean errs by 0.07 SDs of their difference
    assert ((there - here).abs() < 0.35 * sd).all()
    assert ((other / sd).log().abs() < 0.3).all()
