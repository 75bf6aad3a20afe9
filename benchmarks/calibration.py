"""Are the posteriors calibrated? SBC of one window and of the loop, coverage beside quadrature's, power of the tests.

``python -m benchmarks.calibration [--only single|loop|coverage|power] [--replications N] [--seed S] [--quick]``

The seed was fixed before the first run with these figures, and the level of all verdicts is 0.01. A verdict is the
least p-value of all quantities and tests times their number; of a loop, times the number of windows, too.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.jerk import ExcitationRule, JerkDensity
from avtorch.inference.priors import Prior
from avtorch.inference.sampler import sample
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.inference.sequential import CarriedBy, SequentialInference
from benchmarks.rank_calibration import (
    LEVELS,
    RankCalibration,
    batches,
    check_sizes,
    drawn_windows,
    joined,
    sbc_quadrature,
)
from benchmarks.sine_windows import ROWS, Amplitude, statistics

LEVEL, SEED = 0.01, 20240601
STRONG, WEAK, VARIED = 1.0, 0.1, (0.1, 2.0)
NAMES = ("T_L", "K_L", "sigma")
#: Replications at which the power of the tests is measured.
SIZES = (250, 500, 1000, 2000, 4000)


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
        amplitude: excitation of the windows [m/s^2], see :func:`statistics`.
        prior: of ``z = log(T_L, K_L, sigma)``; the library's first prior by default.
        sampler: what is tested; SGLD with default settings by default.
        draws: draws that a rank counts, spread over chains and time to be nearly independent.
        inflate: stretch the draws about their mean in ``z`` by this factor, a fault that the tests must detect.
        batch: windows sampled at once.

    Raises:
        InputError: for ``draws`` that 20 bins do not divide, or ``inflate``, ``replications``, ``batch`` not positive.
    """
    check_sizes(replications, draws, inflate, batch)
    sampler = sgld() if sampler is None else sampler
    own = torch.Generator().manual_seed(_other(seed))
    parts = []
    for density, truth in drawn_windows(replications, batch, amplitude, prior, seed):
        posterior, usable = sampler(density, own)
        parts.append(RankCalibration.of(density, truth, posterior, usable, draws=draws, inflate=inflate))
    return joined(parts)


def _other(seed: int, number: int = 0) -> int:
    """A seed for the sampler, whose noise must not be that of the windows."""
    return (seed + 1) * 1_000_003 + number


def sbc_loop(
    replications: int = 4000,
    *,
    windows: int = 5,
    mode: CarriedBy = "posterior",
    truth: Literal["constant", "claimed"] | None = None,
    amplitude: Amplitude = VARIED,
    rule: ExcitationRule | None = None,
    seed: int = 0,
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
    check_sizes(replications)
    if truth not in (None, "constant", "claimed"):
        raise InputError(f"truth: found {truth!r}, need 'constant' or 'claimed'")
    constant = mode == "posterior" if truth is None else truth == "constant"
    generator = torch.Generator().manual_seed(seed)
    parts: list[list[RankCalibration]] = [[] for _ in range(windows)]
    for number, count in enumerate(batches(replications)):
        inference = SequentialInference(vehicles=count, mode=mode, kept=999, seed=_other(seed, number), **loop)
        z = inference.prior().sample(1, count, generator=generator)[0]
        for window in range(windows):
            prior = inference.prior()
            if not constant:
                z = prior.sample(1, count, generator=generator)[0]
            seen = statistics(z, amplitude=amplitude, generator=generator)
            excited = torch.ones(count, dtype=torch.bool) if rule is None else rule(seen, ROWS)
            belief = inference.update(lambda index, own, seen=seen: JerkDensity(seen.select(index), own), excited)
            used = excited.nonzero().squeeze(-1)
            density = JerkDensity(seen.select(used), prior.select(used))
            parts[window].append(RankCalibration.of(density, z[used], belief.draws[:, used], belief.converged[used]))
    return [joined(part) for part in parts]


def verdict(p_value: float) -> str:
    return f"p = {p_value:.3g}: {'REJECTED' if p_value < LEVEL else 'not rejected'} at {LEVEL:g}"


def table(found: RankCalibration) -> None:
    """p-values and coverage of every quantity."""
    p = found.p_values
    print(f"    {'quantity':16}{'chi2':>9}{'ecdf':>9}{'disp.':>9}   coverage " + " ".join(f"{x:>8.0%}" for x in LEVELS))
    for i, name in enumerate(found.names):
        ps = "".join(f"{float(p[key][i]):9.3g}" for key in ("chi2", "ecdf", "dispersion"))
        shares = " ".join(f"{100 * float(found.coverage[level][i]):8.2f}" for level in LEVELS)
        print(f"    {name:16}{ps}            {shares}")
    errors = " ".join(f"{100 * found.coverage_error(level):8.2f}" for level in LEVELS)
    print(f"    {'binomial error':16}{'':27}            {errors}")


def single(replications: int, seed: int) -> None:
    print(f"\nSBC of one window, SGLD with default settings, {replications} replications of 200 points, seed {seed}")
    for label, amplitude in (("0.1 to 2", VARIED), ("0.1", WEAK), ("0.02", 0.02)):
        found = sbc(replications, amplitude=amplitude, seed=seed)
        print(f"  amplitude {label} m/s^2, {found.dropped} not converged: {verdict(found.p_value)}")
        table(found)
    stretched = sbc(replications, inflate=1.1, seed=seed)
    print(f"  amplitude 0.1 to 2 m/s^2, draws stretched by 1.1: {verdict(stretched.p_value)}")
    table(stretched)


def loop(replications: int, seed: int, windows: int) -> None:
    print(f"\nSBC of the loop, {replications} vehicles, {windows} windows each, seed {seed}")
    cases: list[tuple[CarriedBy, str, object, ExcitationRule | None]] = [
        ("posterior", "constant", VARIED, None),
        ("posterior", "constant", WEAK, None),
        ("posterior", "claimed", VARIED, None),
        ("lambda", "claimed", VARIED, None),
        ("lambda", "claimed", VARIED, ExcitationRule()),
        ("lambda", "claimed", WEAK, None),
        ("forgetting", "claimed", VARIED, None),
        ("forgetting", "claimed", WEAK, None),
        ("lambda", "constant", WEAK, None),
        ("forgetting", "constant", WEAK, None),
    ]
    for mode, truth, amplitude, rule in cases:
        found = sbc_loop(
            replications,
            windows=windows,
            mode=mode,
            truth=truth,  # pyright: ignore[reportArgumentType]
            amplitude=amplitude,  # pyright: ignore[reportArgumentType]
            rule=rule,
            seed=seed,
        )
        p = [c.p_value for c in found]
        all_in_all = min(1.0, min(p) * len(p))
        which = "excited windows" if rule else "all windows"
        amplitudes = "/".join(f"{x:g}" for x in (amplitude if isinstance(amplitude, tuple) else (amplitude,)))
        print(f"  {mode}, truth {truth}, amplitude {amplitudes}, {which}: {verdict(all_in_all)}")
        print("    p by window  " + " ".join(f"{x:8.3g}" for x in p))
        print("    used         " + " ".join(f"{c.replications:8d}" for c in found))
        print("    not converged" + " ".join(f"{c.dropped:8d}" for c in found))
        for i, name in enumerate(found[0].names[:3]):
            print(f"    90 % {name:8}" + " ".join(f"{100 * float(c.coverage[0.9][i]):8.2f}" for c in found))
        worst = min(range(len(found)), key=lambda k: found[k].p_value)
        if all_in_all < LEVEL:
            print(f"    window {worst + 1}:")
            table(found[worst])


def coverage(replications: int, seed: int) -> None:
    print(f"\nCoverage in %, SGLD beside quadrature on the same {replications} windows, seed {seed}")
    heads = "".join(f"{name:>13}{'quad.':>8}" for name in NAMES)
    print(f"  {'amplitude':10}{'level':>6}  {heads}")
    for label, amplitude in (("0.1 to 2", VARIED), ("0.1", WEAK)):
        ours = sbc(replications, amplitude=amplitude, seed=seed)
        exact = sbc_quadrature(replications, amplitude=amplitude, seed=seed)
        if ours.dropped:
            print(f"  {ours.dropped} windows not converged: coverage of the others")
        for level in LEVELS:
            pairs = zip(ours.coverage[level][:3], exact.coverage[level], strict=True)
            row = "".join(f"{100 * float(a):13.2f}{100 * float(b):8.2f}" for a, b in pairs)
            print(f"  {label:10}{level:6.0%}  {row}")
        for name, found in (("SGLD", ours), ("quadrature", exact)):
            p = torch.stack(list(found.p_values.values()))[:, :3].amin(0).tolist()
            print(f"  least p of uniform ranks, {name:10} " + " ".join(f"{x:.3g}" for x in p))
        gap = (ours.coverage[0.9][:3] - exact.coverage[0.9]).abs().max()
        bound = "within" if gap <= 0.015 else "NOT within"
        print(f"  largest difference at 90 %: {100 * float(gap):.2f} points, {bound} 1.5")


def power(replications: int, seed: int) -> None:
    print(f"\nPower: share of runs rejected at {LEVEL:g}, in disjoint runs out of {replications} replications")
    heads = ("verdict", "chi2", "ecdf", "disp.", "T K s")
    print(f"  {'SDs':>7}{'run of':>8}{'runs':>6}" + "".join(f"{head:>9}" for head in heads))
    for inflate in (1.0, 1.05, 1.1, 1 / 1.1):
        # other windows than those of the published run
        found = sbc(replications, inflate=inflate, seed=seed + 1)
        for size in SIZES:
            runs = torch.arange(found.replications).split(size)
            runs = [run for run in runs if len(run) == size]
            hits = torch.zeros(5)
            for run in runs:
                p = found.select(run).p_values
                everything = torch.stack(list(p.values()))
                each = [float(x.min()) * len(x) for x in p.values()]
                own = everything[:, :3]
                values = [float(everything.min()) * everything.numel(), *each, float(own.min()) * own.numel()]
                hits += torch.tensor([value < LEVEL for value in values])
            shares = "".join(f"{float(h) / max(len(runs), 1):9.2f}" for h in hits)
            print(f"  {inflate:7.3f}{size:8d}{len(runs):6d}{shares}")
        print(f"  {inflate:7.3f}{found.replications:8d}     1  {verdict(found.p_value)}", flush=True)
    print("  T K s: without the log likelihood and the log posterior among the quantities")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("single", "loop", "coverage", "power"))
    parser.add_argument("--replications", type=int, default=4000)
    parser.add_argument("--windows", type=int, default=5)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--quick", action="store_true", help="500 replications, 3 windows, power from 4000")
    options = parser.parse_args()
    count, windows = (500, 3) if options.quick else (options.replications, options.windows)
    sections = {
        "single": lambda: single(count, options.seed),
        "loop": lambda: loop(count, options.seed, windows),
        "coverage": lambda: coverage(count if options.quick else max(count // 2, 2000), options.seed),
        "power": lambda: power(4000 if options.quick else 5 * count, options.seed),
    }
    for name, section in sections.items():
        if options.only in (None, name):
            begun = time.perf_counter()
            section()
            print(f"  ({time.perf_counter() - begun:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
