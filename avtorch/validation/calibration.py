"""Simulation-based calibration of one window and of the whole loop: do intervals cover the truth as often as stated?

Draw a truth from the prior, simulate a window from it, sample its posterior: the truth is then one more draw from that
posterior, so its rank among them is uniform (Talts et al. 2018). This holds for any function of truth and data, and the
log likelihood of the data reveals faults that the ranks of single parameters do not (Modrak et al. 2023). It also holds
given earlier data, if the truth is drawn from the posterior at that point (posterior SBC, Sailynoja et al. 2025): this
tests a loop whose prior assumes that the vehicle changes. Ranks stay uniform under any selection that depends on data
alone (excited windows, settled chains).

The package ``simuk`` does SBC for PyMC, Bambi and NumPyro models, one fit after another in a Python loop. Our densities
are not such models, and all replications are windows of one tensor; so the ranks are computed here, in a few lines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.excitation import ExcitationRule
from avtorch.inference.jerk import JerkDensity
from avtorch.inference.priors import Joint, Prior, default_actuation_prior, default_jerk_noise_prior
from avtorch.inference.quadrature import integrate
from avtorch.inference.sampler import sample
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.inference.sequential import Mode, SequentialInference
from avtorch.validation.ranks import RankCalibration
from avtorch.validation.simulation import Amplitude, statistics

VARIED = (0.1, 2.0)
"""Amplitudes [m/s^2] from weak to strong excitation."""

QUADRATURE_BATCH = 20
"""Windows integrated at once: more would exceed the cache."""


Sampler = Callable[[JerkDensity, torch.Generator], tuple[Tensor, Tensor]]
"""Draws ``(draw, window, parameter)``, evenly usable once thinned, and where they can be used, ``(window,)`` bool."""


def sgld(settings: SamplerSettings | None = None) -> Sampler:
    """The sampler under test: Algorithm 1 by :func:`sample`."""

    def draw(density: JerkDensity, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        posterior = sample(density, settings, generator=generator)
        return posterior.flat, posterior.converged

    return draw


def sbc(
    replications: int = 4000,
    *,
    rows: int = 200,
    amplitude: Amplitude = VARIED,
    prior: Prior | None = None,
    sampler: Sampler | None = None,
    draws: int = 99,
    inflate: float = 1.0,
    seed: int = 0,
    batch: int = 500,
) -> RankCalibration:
    """Calibration of a single window's posterior.

    Args:
        replications: truths drawn from the prior, each with a window of its own.
        rows, amplitude: length [samples of 10 ms] and excitation [m/s^2] of the windows, see :func:`statistics`.
        prior: of ``z = log(T_L, K_L, sigma)``; the library's first prior by default.
        sampler: what is tested; SGLD with default settings by default.
        draws: draws that a rank counts, spread over chains and time to be nearly independent.
        inflate: stretch the draws about their mean in ``z`` by this factor, a fault that the tests must detect.
        batch: windows sampled at once.

    Raises:
        InputError: for ``draws`` that 20 bins do not divide, or ``inflate``, ``replications``, ``batch`` not positive.
    """
    _check(replications, draws, inflate, batch)
    sampler = sgld() if sampler is None else sampler
    own = torch.Generator().manual_seed(_other(seed))
    parts = []
    for density, truth in _drawn(replications, batch, rows, amplitude, prior, seed):
        posterior, usable = sampler(density, own)
        parts.append(RankCalibration.of(density, truth, posterior, usable, draws=draws, inflate=inflate))
    return _joined(parts)


def sbc_quadrature(
    replications: int = 2000,
    *,
    rows: int = 200,
    amplitude: Amplitude = VARIED,
    prior: Prior | None = None,
    draws: int = 99,
    nodes: int = 31,
    seed: int = 0,
    batch: int = 500,
) -> RankCalibration:
    """The same by quadrature, for the parameters only: the calibration of an exact posterior on the windows of
    :func:`sbc`.

    The windows are the same if seed, ``batch`` and all that shapes them are; ``dropped`` stays 0: windows for which
    ``nodes`` are too few are included in the figures. Ranks are ``below`` in ``draws + 1`` steps.

    Raises:
        InputError: as :func:`sbc`.
    """
    _check(replications, draws, 1.0, batch)
    parts = []
    for density, truth in _drawn(replications, batch, rows, amplitude, prior, seed):
        few = [density.select(index) for index in torch.arange(density.windows).split(QUADRATURE_BATCH)]
        values = truth.exp().split(QUADRATURE_BATCH)
        below = torch.cat([integrate(d, nodes=nodes).cdf(v) for d, v in zip(few, values, strict=True)])
        ranks = (below * (draws + 1)).long().clamp(0, draws)
        parts.append(RankCalibration(density.names, ranks, draws, below))
    return _joined(parts)


def _drawn(
    replications: int, batch: int, rows: int, amplitude: Amplitude, prior: Prior | None, seed: int
) -> Iterator[tuple[JerkDensity, Tensor]]:
    """Batches of windows and the truths ``z`` they were drawn from; nothing else draws from their generator."""
    prior = Joint(default_actuation_prior(), default_jerk_noise_prior()) if prior is None else prior
    generator = torch.Generator().manual_seed(seed)
    for count in _batches(replications, batch):
        truth = prior.sample(1, count, generator=generator)[0]
        yield JerkDensity(statistics(truth, rows=rows, amplitude=amplitude, generator=generator), prior), truth


def _other(seed: int, number: int = 0) -> int:
    """A seed for the sampler, whose noise must not be that of the windows."""
    return (seed + 1) * 1_000_003 + number


def sbc_loop(
    replications: int = 4000,
    *,
    windows: int = 5,
    mode: Mode = "posterior",
    truth: Literal["constant", "claimed"] | None = None,
    rows: int = 200,
    amplitude: Amplitude = VARIED,
    rule: ExcitationRule | None = None,
    draws: int = 99,
    inflate: float = 1.0,
    seed: int = 0,
    batch: int = 500,
    **loop: Any,
) -> list[RankCalibration]:
    """Calibration of the sequential loop after each of its windows; replications are its vehicles.

    With ``truth="constant"`` a vehicle is drawn once from the first prior and stays. Ranks are then uniform after every
    window if the loop passes on all information, as ``posterior`` mode claims up to its normal approximation. With
    ``truth="claimed"`` each window's vehicle is drawn from the loop's current prior for it, as if vehicles changed the
    way that ``lambda`` and ``forgetting`` assume (posterior SBC); ranks are then uniform if every update is right given
    its prior. A constant truth contradicts the assumption of these modes, and its ranks are not uniform: the loop's
    posteriors are too wide.

    Args:
        truth: by default ``"constant"`` in ``posterior`` mode, else ``"claimed"``.
        rule: windows that it finds not excited are not used; by default all are.
        loop: further arguments of :class:`SequentialInference`.

    Returns:
        One calibration a window, of the vehicles that used it.

    Raises:
        InputError: as :func:`sbc`, or for ``truth`` of another name.
    """
    _check(replications, draws, inflate, batch)
    if truth not in (None, "constant", "claimed"):
        raise InputError(f"truth: found {truth!r}, need 'constant' or 'claimed'")
    constant = mode == "posterior" if truth is None else truth == "constant"
    generator = torch.Generator().manual_seed(seed)
    parts: list[list[RankCalibration]] = [[] for _ in range(windows)]
    for number, count in enumerate(_batches(replications, batch)):
        kept = 10 * (draws + 1) - 1
        inference = SequentialInference(vehicles=count, mode=mode, kept=kept, seed=_other(seed, number), **loop)
        z = inference.prior().sample(1, count, generator=generator)[0]
        for window in range(windows):
            prior = inference.prior()
            if not constant:
                z = prior.sample(1, count, generator=generator)[0]
            seen = statistics(z, rows=rows, amplitude=amplitude, generator=generator)
            excited = torch.ones(count, dtype=torch.bool) if rule is None else rule(seen, rows)
            belief = inference.update(lambda index, own, seen=seen: JerkDensity(seen.select(index), own), excited)
            used = excited.nonzero().squeeze(-1)
            density = JerkDensity(seen.select(used), prior.select(used))
            parts[window].append(
                RankCalibration.of(
                    density, z[used], belief.draws[:, used], belief.converged[used], draws=draws, inflate=inflate
                )
            )
    return [_joined(part) for part in parts]


def _check(replications: int, draws: int, inflate: float, batch: int) -> None:
    if replications < 1 or batch < 1:
        raise InputError(f"replications, batch: found {replications}, {batch}, need 1 or more")
    if draws < 19 or (draws + 1) % 20:
        raise InputError(f"draws: found {draws}, need a multiple of 20 less 1, for 20 equal bins of ranks")
    if not inflate > 0:
        raise InputError(f"inflate: found {inflate}, need a positive factor")


def _batches(total: int, size: int) -> list[int]:
    return [min(size, total - first) for first in range(0, total, size)]


def _joined(parts: list[RankCalibration]) -> RankCalibration:
    first = parts[0]
    ranks, below = (torch.cat([getattr(p, key) for p in parts]) for key in ("ranks", "below"))
    return RankCalibration(first.names, ranks, first.draws, below, sum(p.dropped for p in parts))
