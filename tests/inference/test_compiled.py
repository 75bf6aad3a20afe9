"""The compiled walk against the reference, `SGLD(torch.optim.Optimizer)`: the same step, the same law, and when it is
chosen."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from avtorch.inference import (
    SGLD,
    JerkDensity,
    SamplerSettings,
    find_mode,
    sample,
)
from avtorch.inference import compiled as module
from avtorch.inference.compiled import words
from avtorch.inference.coordinates import Coordinates
from avtorch.inference.sampler import walk
from tests.bars import BAR
from tests.inference.compiled_cases import KINDS, Gaussian, densities, generator, walk_noise

kernels = pytest.importorskip("avtorch.inference.kernels", exc_type=ImportError)

F64 = torch.float64


class Fed(SGLD):
    """The reference with the kernel's noise in place of its own."""

    def __init__(self, params, step, noise, kind):
        self.left = iter(noise)
        super().__init__(params, step, noise=kind)

    def normal_like(self, p, dtype=None):
        return next(self.left)


def fed(settings, seed, start, windows):
    """The same settings with `Fed` in place of the compiled walk, given the seed and what the start takes of it."""
    g = generator(seed)
    if start:
        torch.randn(settings.chains, windows, 3, dtype=F64, generator=g)
    steps = settings.burn_in + settings.draws * settings.thinning
    noise = np.empty((steps + 1, 3, windows, settings.chains))
    walk_noise(kernels, noise, *words(g))
    each = torch.from_numpy(noise).permute(0, 3, 2, 1)
    each = list(each) if settings.noise == "averaged" else list(each[1:])
    # the averaged noise asks for the fresh number first, and for what it starts from second
    if settings.noise == "averaged":
        each[0], each[1] = each[1], each[0]
    return lambda params, step, _: Fed(params, step, each, settings.noise)


@pytest.mark.parametrize("noise", ["independent", "averaged"])
@pytest.mark.parametrize("kind", KINDS)
def test_with_the_same_noise_a_walk_is_the_reference_walk(kind, noise, make_windows):
    """Every draw of 50 steps, in whitened coordinates, to round-off: sums of 1e4 terms carry 1e-12 of a slope each."""
    density = densities(make_windows)[kind]
    mode, slow = find_mode(density), torch.ones(3, dtype=F64)
    settings = SamplerSettings(
        chains=45, draws=10, burn_in=10, thinning=4, step=0.5, noise=noise, spread=2.0, walk="auto"
    )
    z = walk(density, mode, settings, slowdown=slow, generator=generator(3))
    eager = SamplerSettings(
        **{**vars(settings), "optimizer": fed(settings, 3, True, 3)},
    )
    reference = walk(density, mode, eager, slowdown=slow, generator=generator(3))
    sd = mode.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert z.std() > 0
    assert float(((z - reference) / sd).abs().max()) < 1e-8


def test_one_step_is_the_reference_step(make_windows):
    """Far out, where the burn-in's limit cuts the slope, and beyond the burn-in, where it does not."""
    density = densities(make_windows)["first"]
    mode, slow = find_mode(density), torch.ones(3, dtype=F64)
    for burn_in, spread, fine in ((3, 6.0, 1e-10), (0, 0.0, 1e-12)):
        settings = SamplerSettings(chains=64, draws=4, burn_in=burn_in, thinning=1, step=0.01, spread=spread)
        z = walk(density, mode, settings, slowdown=slow, generator=generator(4))[:, 0]
        eager = SamplerSettings(**{**vars(settings), "optimizer": fed(settings, 4, spread > 0, 3)})
        reference = walk(density, mode, eager, slowdown=slow, generator=generator(4))[:, 0]
        w, other = (torch.linalg.solve(mode.scale, (x - mode.z)[..., None]) for x in (z, reference))
        torch.testing.assert_close(w, other, rtol=fine, atol=fine)


@pytest.mark.statistical
@pytest.mark.parametrize("noise", ["independent", "averaged"])
@pytest.mark.parametrize("step", [0.4, 1.2, 2.0])
def test_both_keep_the_known_law_of_a_gaussian(noise, step, rotating_seed, draws_factor):
    """Covariance after 60 whitened steps: `1/(1 - h/4)` or 1 in every direction, by independent chains."""
    root = torch.tensor([[1.0, 0.0, 0.0], [0.8, 0.7, 0.0], [-0.3, 0.2, 2.0]], dtype=F64)
    density = Gaussian(torch.stack([root @ root.mT, torch.eye(3, dtype=F64)]))
    mode, slow = find_mode(density), torch.ones(2, dtype=F64)
    variance = 1 / (1 - step / 4) if noise == "independent" else 1.0
    chains = 4000 * draws_factor
    for way in ("auto", "eager"):
        settings = SamplerSettings(
            chains=chains, draws=4, burn_in=15, thinning=15, step=step, noise=noise, spread=1.0, walk=way
        )
        z = walk(density, mode, settings, slowdown=slow, generator=generator(rotating_seed))[:, -1]
        w = torch.linalg.solve(mode.scale, (z - mode.z)[..., None])[..., 0]
        mean = w.mean(0) / (variance / chains) ** 0.5
        covariance = torch.einsum("cwi,cwj->wij", w, w) / chains
        eye = torch.eye(3, dtype=F64)
        # a square has variance 2, a product of independent ones 1
        error = (covariance - variance * eye) / (variance * ((1 + eye) / chains).sqrt())
        assert float(mean.abs().max()) < BAR, way
        assert float(error.abs().max()) < BAR, way


@pytest.mark.statistical
def test_both_have_the_same_law_on_windows(make_windows, rotating_seed, draws_factor):
    """Means, variances and tails of independent chains at step 2, on weak, skewed windows and strong ones."""
    density = JerkDensity(make_windows(1, [0.1, 0.3, 1.0, 2.0], T=[0.15, 0.7, 0.3, 1.5]).statistics)
    mode, chains = find_mode(density), 4000 * draws_factor
    last = {}
    for way in ("auto", "eager"):
        settings = SamplerSettings(chains=chains, draws=4, burn_in=100, thinning=20, walk=way)
        z = walk(density, mode, settings, generator=generator(rotating_seed))[:, -1]
        last[way] = torch.linalg.solve(mode.scale, (z - mode.z)[..., None])[..., 0]
    for power in (1, 2, 4):
        mine, other = (x.abs() ** power if power > 1 else x for x in last.values())
        error = (mine.var(0) / chains + other.var(0) / chains).sqrt()
        assert float(((mine.mean(0) - other.mean(0)) / error).abs().max()) < BAR
    for w in range(4):
        for i in range(3):
            p = stats.ks_2samp(last["auto"][:, w, i].numpy(), last["eager"][:, w, i].numpy()).pvalue
            assert p > 2 * stats.norm.sf(BAR)


def test_a_seed_gives_the_same_draws_whatever_the_threads(make_windows, monkeypatch):
    monkeypatch.setattr(module, "ALONE", 0)
    density, settings = densities(make_windows)["first"], SamplerSettings(chains=100, walk="auto")
    before, draws = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 16):
            torch.set_num_threads(threads)
            draws.append(sample(density, settings, generator=generator(7)).draws)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(draws[0], other) for other in draws[1:])
    assert not torch.equal(draws[0], sample(density, settings, generator=generator(8)).draws)


def test_a_chain_does_not_depend_on_how_many_there_are(make_windows):
    density = densities(make_windows)["first"]
    mode = find_mode(density)
    many, few = (walk(density, mode, SamplerSettings(chains=n, walk="auto"), generator=generator(2)) for n in (100, 33))
    assert torch.equal(many[:33], few)


def test_coordinates_reach_the_kernels_whole(make_windows):
    """The potential in whitened coordinates is that in `z`."""
    density = densities(make_windows)["some started"]
    mode = find_mode(density)
    exponents, offsets, coupling, linear, quadratic, own = (
        torch.from_numpy(x) for x in module.whitened(density.exponential_form, Coordinates.of(mode))
    )
    w = torch.randn(10, 3, 3, generator=generator(1), dtype=F64)
    e = (torch.einsum("wij,cwj->cwi", exponents, w) + offsets).exp()
    pairs = torch.einsum("cwi,wij,cwj->cw", e, coupling, e)
    square = torch.einsum("cwi,wij,cwj->cw", w, quadratic, w)
    single = (torch.einsum("wti,cwi->cwt", own[..., :3], w) + own[..., 3]).exp()
    rest = (own[..., 4] * single + 0.5 * own[..., 5] * single**2).sum(-1)
    potential = (linear * w).sum(-1) + 0.5 * (square + pairs) + rest
    z = Coordinates.of(mode).z(w)
    shift = potential + density.log_prob(z)
    torch.testing.assert_close(shift, shift[:1].expand_as(shift), rtol=0, atol=1e-7)
