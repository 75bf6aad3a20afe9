"""The loop over windows against one inference on all of them, and its response to a vehicle that changes.

``python -m benchmarks.pooled [--only constant|carried|change] [--vehicles 200] [--windows 10] [--seed 20240602]``

Truths come from the first prior, windows have 200 points. `constant`: means, SDs and coverage of the last belief beside
the posterior given all windows (quadrature, one sigma). `carried`: the parts of `posterior` mode's difference due to
the normal approximation and to the sampler's noise. `change`: a step to a fresh draw from the prior before window 6,
and a drift of 3 % a window in T_L and K_L.
"""

from __future__ import annotations

import argparse
import time

import torch
from torch import Tensor

from avtorch.inference.priors import Joint, default_actuation_prior, default_jerk_noise_prior
from avtorch.inference.sampler import SamplerSettings
from avtorch.validation.pooled import (
    MODES,
    PooledComparison,
    Track,
    constant,
    drift,
    step,
    track_loop,
    truth_given_all,
    windows_of,
)

SEED, AMPLITUDES = 20240602, (1.0, 0.3, 0.1)
NAMES = ("T_L", "K_L", "sigma")


def vehicles_of(count: int, generator: torch.Generator) -> Tensor:
    """Truths ``log(T_L, K_L, sigma)``, ``(vehicle, 3)``."""
    return Joint(default_actuation_prior(), default_jerk_noise_prior()).sample(1, count, generator=generator)[0]


def three(values: Tensor, form: str = "7.3f") -> str:
    return " ".join(f"{x:{form}}" for x in values.tolist())


def row(label: str, found: PooledComparison) -> None:
    middle = found.sd_ratio.median(0).values
    rms, worst = found.shift.square().mean(0).sqrt(), found.shift.abs().quantile(0.95, dim=0)
    shares = 100 * found.covered.double().mean(0)
    print(f"  {label:24}{three(rms)}  {three(worst)}  {three(middle)}  {three(shares, '6.1f')}", flush=True)


def heading(what: str) -> None:
    print(f"\n{what}")
    columns = ("RMS shift [pooled SDs]", "95 % of |shift|", "median SD ratio", "90 % coverage")
    print(f"  {'(T_L, K_L, sigma)':24}" + "".join(f"{c:25}" for c in columns))


def stays(count: int, windows: int, seed: int) -> None:
    heading(f"Constant truth: after {windows} windows against the posterior given all, {count} vehicles")
    for amplitude in AMPLITUDES:
        g = torch.Generator().manual_seed(seed)
        path = constant(vehicles_of(count, g), windows)
        observed = windows_of(path, amplitude=amplitude, generator=g)
        pooled = truth_given_all(observed)
        shares = 100 * ((pooled.cdf(path[-1].exp()) - 0.5).abs() <= 0.45).double().mean(0)
        worst = float(pooled.error.max())
        print(f"  amplitude {amplitude:g} m/s^2; pooled: 90 % coverage {three(shares, '.1f')}, grid error {worst:.1g}")
        for mode in MODES:
            track = track_loop(path, observed, mode=mode, seed=seed)
            row(mode, PooledComparison.of(track, pooled))
            if not bool(track.converged.all()):
                print(f"    {int((~track.converged).sum())} windows not converged")
        free = truth_given_all(observed, shared_noise=False)
        shift = ((free.mean - pooled.mean[:, :2]) / pooled.sd[:, :2]).square().mean(0).sqrt()
        ratio = (free.sd / pooled.sd[:, :2]).median(0).values
        print(f"  {'pooled, sigma a window':24}{three(shift)}          {'':25}{three(ratio)}")
        last = torch.tensor([len(observed) - 1])
        alone = truth_given_all([observed[int(last)]])
        ratio = (alone.sd / pooled.sd).median(0).values
        shift = ((alone.mean - pooled.mean) / pooled.sd).square().mean(0).sqrt()
        print(f"  {'last window alone':24}{three(shift)}  {'':25}{three(ratio)}", flush=True)


def carried(count: int, windows: int, seed: int) -> None:
    heading(f"Posterior mode: the normal carried on, against the sampler's noise; {count} vehicles, {windows} windows")
    for amplitude in AMPLITUDES:
        g = torch.Generator().manual_seed(seed)
        path = constant(vehicles_of(count, g), windows)
        observed = windows_of(path, amplitude=amplitude, generator=g)
        pooled = truth_given_all(observed)
        print(f"  amplitude {amplitude:g} m/s^2")
        default = SamplerSettings()
        for factor in (1, 16):
            settings = SamplerSettings(chains=factor * default.chains)
            row(
                f"{settings.chains} chains",
                PooledComparison.of(track_loop(path, observed, mode="posterior", settings=settings), pooled),
            )


def change(count: int, windows: int, seed: int) -> None:
    at = windows // 2
    print(f"\nA vehicle that changes: {count} vehicles, {windows} windows; medians of |mean - truth|/truth and")
    print("coverage of the 90 % interval [%], T_L and K_L, window by window")
    for amplitude in (1.0, 0.1):
        g = torch.Generator().manual_seed(seed)
        z, later = vehicles_of(count, g), vehicles_of(count, g)
        rate = 0.03 * (1 - 2 * torch.randint(2, (count, 2), generator=g)).to(z)
        paths = {
            "none": constant(z, windows),
            f"step before window {at + 1}": step(z, later, windows, at=at),
            "drift of 3 % a window": drift(z, rate, windows),
        }
        for name, path in paths.items():
            observed = windows_of(path, amplitude=amplitude, generator=g)
            print(f"  amplitude {amplitude:g} m/s^2, {name}")
            for mode in MODES:
                show(mode, track_loop(path, observed, mode=mode, seed=seed))


def show(mode: str, track: Track) -> None:
    error, inside = track.relative_error.median(1).values, 100 * track.covered.double().mean(1)
    for i, name in enumerate(NAMES[:2]):
        print(f"    {mode:11}{name:5}error    " + " ".join(f"{x:6.3f}" for x in error[:, i].tolist()))
        print(f"    {'':11}{'':5}coverage " + " ".join(f"{x:6.1f}" for x in inside[:, i].tolist()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("constant", "carried", "change"))
    parser.add_argument("--vehicles", type=int, default=200)
    parser.add_argument("--windows", type=int, default=10)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--quick", action="store_true", help="40 vehicles")
    options = parser.parse_args()
    count = 40 if options.quick else options.vehicles
    sections = {
        "constant": lambda: stays(count, options.windows, options.seed),
        # sixteen times the chains: fewer vehicles
        "carried": lambda: carried(max(count // 8, 10), options.windows, options.seed),
        "change": lambda: change(count, options.windows, options.seed),
    }
    for name, section in sections.items():
        if options.only in (None, name):
            begun = time.perf_counter()
            section()
            print(f"  ({time.perf_counter() - begun:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
