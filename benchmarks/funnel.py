"""Cars of one model whose drives say little: the posterior is a funnel, and samplers are held to a grid.

``python -m benchmarks.funnel [--cars 12] [--seed 5]``

A car's log lag varies about its model's mean by `between`; each has one drive, whose estimate has a standard deviation.
The less the drives say, the narrower the cars' posterior gets as `between` shrinks, and no one step fits both ends
(Neal 2003, "Slice sampling", section 8; Betancourt and Girolami 2015). avtorch integrates the cars out: two parameters,
which a grid has exactly. Beside its SGLD walk NUTS in Pyro's own words, with the cars as they are (centred) or as
distances from the mean (non-centred), and WALNUTS, whose step changes within a trajectory, on both.

A line a sampler: error of the mean in posterior standard deviations and ratio of standard deviations, the worse of mean
and log `between`; bulk effective draws of log `between`, a second's worth of them, processor time. Tools that are
missing are left out (`pip install 'avtorch[bench]'`).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Gamma, Normal
from torch.distributions.constraints import positive, real

from avtorch.arrays import FloatArray
from avtorch.fleet.population import MEAN_SD, SPREAD
from avtorch.inference import sample
from avtorch.inference.chains import effective_sample_size
from benchmarks.torch_density import TorchDensity

F64 = torch.float64
BETWEEN = 0.05  # of the truth
SDS = {"drives that say little": 0.25, "drives that say much": 0.02}
CHAINS, WARMUP, DRAWS = 4, 1000, 2000
DEAR = 4
"""So many times fewer iterations has Pyro: each costs a hundred of the others'."""


def fleet(cars: int, sd: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Estimates of a logarithm (car,) and their standard deviations."""
    rng = np.random.default_rng(seed)
    sds = sd * rng.uniform(0.7, 1.4, cars)
    return -1.0 + BETWEEN * rng.standard_normal(cars) + sds * rng.standard_normal(cars), sds


def margin(y: FloatArray, sd: FloatArray) -> TorchDensity:
    """The density of mean and `between` with the cars integrated out."""
    values, errors = torch.as_tensor(y), torch.as_tensor(sd)

    def log_density(p: dict[str, Tensor]) -> Tensor:
        spread = (p["between"][..., None].square() + errors.square()).sqrt()
        prior = Normal(0.0, MEAN_SD).log_prob(p["mean"]) + Gamma(2.0, 2 / SPREAD).log_prob(p["between"])
        return prior + Normal(p["mean"][..., None], spread).log_prob(values).sum(-1)

    begin = {"mean": float(y.mean()), "between": max(float(y.std()), 0.02)}
    return TorchDensity(log_density, {"mean": real, "between": positive}, start=begin)


def by_grid(density: TorchDensity) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of (mean, log between)."""
    mean = torch.linspace(-3.0, 1.0, 1201, dtype=F64)
    log_between = torch.linspace(-14.0, 2.0, 1601, dtype=F64)
    z = torch.stack(torch.meshgrid(mean, log_between, indexing="ij"), -1)
    p = torch.stack([density.log_prob(row[:, None])[:, 0] for row in z])
    p = (p - p.max()).exp()
    p /= p.sum()
    centre = (p[..., None] * z).sum((0, 1))
    return centre.numpy(), (p[..., None] * (z - centre) ** 2).sum((0, 1)).sqrt().numpy()


def by_sgld(y: FloatArray, sd: FloatArray, seed: int) -> FloatArray:
    found = sample(margin(y, sd), generator=torch.Generator().manual_seed(seed)).draws[:, :, 0].numpy()
    return np.stack([found[..., 0], np.log(found[..., 1])], -1).swapaxes(0, 1)


def by_nuts(y: FloatArray, sd: FloatArray, seed: int, *, centred: bool) -> FloatArray:
    import pyro
    from pyro import distributions as dist
    from pyro.infer import MCMC, NUTS

    values, errors = torch.as_tensor(y), torch.as_tensor(sd)

    def model() -> None:
        mean = pyro.sample("mean", dist.Normal(torch.zeros((), dtype=F64), MEAN_SD))
        between = pyro.sample("between", dist.Gamma(torch.full((), 2.0, dtype=F64), 2 / SPREAD))
        if centred:
            cars = pyro.sample("cars", dist.Normal(mean, between).expand([len(y)]).to_event(1))
        else:
            cars = mean + between * pyro.sample("away", dist.Normal(torch.zeros(len(y), dtype=F64), 1.0).to_event(1))
        pyro.sample("y", dist.Normal(cars, errors).to_event(1), obs=values)

    out = []
    for chain in range(CHAINS // 2):
        pyro.set_rng_seed(seed + chain)
        run = MCMC(NUTS(model, target_accept_prob=0.9), DRAWS // DEAR, WARMUP // DEAR, disable_progbar=True)
        run.run()
        found = run.get_samples()
        out.append(torch.stack([found["mean"], found["between"].log()], -1).numpy())
    return np.stack(out)


def by_walnuts(y: FloatArray, sd: FloatArray, seed: int, *, centred: bool) -> FloatArray:
    import walnutpie

    rate, precision = 2 / SPREAD, sd**-2.0

    @np.errstate(all="ignore")  # a step too far overflows, and is refused
    def density(z: FloatArray) -> tuple[float, FloatArray]:
        mean, between = z[0], np.exp(z[1])
        away = (z[2:] - mean) / between if centred else z[2:]
        cars = mean + between * away
        pull = (y - cars) * precision
        value = -0.5 * (mean / MEAN_SD) ** 2 + 2 * z[1] - rate * between - 0.5 * (away @ away + (y - cars) @ pull)
        gradient = np.empty_like(z)
        gradient[0], gradient[1] = -mean / MEAN_SD**2, 2 - rate * between
        if centred:
            value -= len(y) * z[1]
            gradient[0] += away.sum() / between
            gradient[1] += away @ away - len(y)
            gradient[2:] = pull - away / between
        else:
            gradient[0] += pull.sum()
            gradient[1] += between * (pull @ away)
            gradient[2:] = between * pull - away
        return float(value), gradient

    begin = np.zeros(len(y) + 2)
    begin[0], begin[1], begin[2:] = y.mean(), np.log(SPREAD), y if centred else 0.0
    found = walnutpie.walnuts_pyfunc(
        density, inits=begin, num_chains=CHAINS, seed=seed,
        min_warmup_iter=WARMUP, max_warmup_iter=WARMUP, min_sampling_iter=DRAWS, max_sampling_iter=DRAWS,
    )  # fmt: skip
    return np.stack([np.asarray(chain)[:, -len(begin) :][:, :2] for chain in found])


SAMPLERS: dict[str, Callable[[FloatArray, FloatArray, int], FloatArray]] = {
    "avtorch SGLD, cars integrated out": by_sgld,
    "NUTS (Pyro), centred": lambda *given: by_nuts(*given, centred=True),
    "NUTS (Pyro), non-centred": lambda *given: by_nuts(*given, centred=False),
    "WALNUTS, centred": lambda *given: by_walnuts(*given, centred=True),
    "WALNUTS, non-centred": lambda *given: by_walnuts(*given, centred=False),
}
"""Draws (chain, draw, 2) of the mean and log `between`, from estimates, their standard deviations and a seed."""


def _effective(values: FloatArray) -> float:
    """Effective draws of (chain, draw): ArviZ's, which short chains hide their autocorrelation from."""
    if values.shape[1] < 50:
        return float(effective_sample_size(torch.as_tensor(values)))
    import arviz

    return float(arviz.ess(values))


def rows(cars: int, sd: float, seed: int) -> Iterator[str]:
    """A line a sampler."""
    y, sds = fleet(cars, sd, seed)
    exact, spread = by_grid(margin(y, sds))
    for name, draw in SAMPLERS.items():
        began = time.process_time()
        try:
            draws = draw(y, sds, seed)
        except ImportError as missing:
            yield f"| {name} | {missing.name} is not installed | | | | |"
            continue
        seconds = time.process_time() - began
        each = draws.reshape(-1, 2)
        off = np.abs(each.mean(0) - exact) / spread
        ratio = each.std(0) / spread
        ess = _effective(draws[..., 1])
        yield (
            f"| {name} | {off.max():.3f} | {ratio[np.abs(np.log(ratio)).argmax()]:.3f} | {ess:.0f} "
            f"| {ess / seconds:.0f} | {seconds:.1f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cars", type=int, default=12)
    parser.add_argument("--seed", type=int, default=5)
    asked = parser.parse_args()
    for title, sd in SDS.items():
        print(f"{title} (standard deviation {sd:g}, of the cars {BETWEEN:g})\n")
        print("| sampler | error of a mean [SD] | ratio of SDs | effective draws | a second | processor time [s] |")
        print("|---|---:|---:|---:|---:|---:|")
        for row in rows(asked.cars, sd, asked.seed):
            print(row, flush=True)
        print()


if __name__ == "__main__":
    main()
