"""The loop over windows against one inference on all of them, and its response to a vehicle that changes.

``python -m benchmarks.pooled [--only constant|carried|change] [--vehicles 200] [--windows 10] [--seed 20240602]``

Truths come from the first prior, windows have 200 points. `constant`: means, SDs and coverage of the last belief beside
the posterior given all windows (quadrature, one sigma). `carried`: the parts of `posterior` mode's difference due to
the normal approximation and to the sampler's noise. `change`: a step to a fresh draw from the prior before window 6,
and a drift of 3 % a window in T_L and K_L.

A vehicle that stays as it is gives windows whose sums add up, so the posterior given all of them is one window's, with
one sigma throughout (:func:`pool`), or with a sigma of its own for each window (:class:`FreeNoise`, as ``lambda`` mode
supposes). Both are integrated by quadrature. For a vehicle that changes there is no such reference; there the error and
the coverage are reported (:func:`track_loop`).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.jerk import JerkDensity, JerkStatistics
from avtorch.inference.priors import Joint, Prior, default_actuation_prior, default_jerk_noise_prior
from avtorch.inference.quadrature import Quadrature, integrate
from avtorch.inference.sampler import SamplerSettings
from avtorch.inference.sequential import CarriedBy, SequentialInference
from benchmarks.sine_windows import Amplitude, statistics

SEED, AMPLITUDES = 20240602, (1.0, 0.3, 0.1)
NAMES = ("T_L", "K_L", "sigma")
MODES: tuple[CarriedBy, ...] = ("lambda", "posterior", "forgetting")


def pool(windows: Sequence[JerkStatistics]) -> JerkStatistics:
    """Sums over all windows of each vehicle, as if they were one long window."""
    if not windows:
        raise InputError("windows: found none, need one or more")
    return JerkStatistics(*(torch.stack([getattr(w, f.name) for w in windows]).sum(0) for f in fields(JerkStatistics)))


class FreeNoise:
    """Posterior of ``(T_L [s], K_L [-])`` of each vehicle from several windows, each with a sigma of its own.

    Given the vehicle the windows' sigmas are independent, so each is integrated out by itself: Gauss-Hermite around the
    sigma that fits the residual best, whose log is normal to within ``1/sqrt(n)``.

    Args:
        windows: the sums of each window, every vehicle in each.
        actuation: prior of ``log(T_L, K_L)``.
        noise: prior of each ``log sigma``.
    """

    names = ("T_L", "K_L")

    def __init__(
        self, windows: Sequence[JerkStatistics], *, actuation: Prior | None = None, noise: Prior | None = None
    ) -> None:
        self.sums = list(windows)
        self.total = pool(windows)
        self.actuation = default_actuation_prior() if actuation is None else actuation
        self.noise = default_jerk_noise_prior() if noise is None else noise
        nodes, weights = np.polynomial.hermite.hermgauss(21)
        self._nodes = torch.from_numpy(np.sqrt(2) * nodes)
        self._log_weights = torch.from_numpy(np.log(np.sqrt(2) * weights) + nodes**2)

    @property
    def windows(self) -> int:
        """Number of vehicles: each has one posterior."""
        return len(self.total.n)

    def select(self, index: Tensor) -> FreeNoise:
        return FreeNoise(
            [w.select(index) for w in self.sums], actuation=self.actuation.select(index), noise=self.noise.select(index)
        )

    def constrain(self, z: Tensor) -> Tensor:
        return z.exp()

    def initial(self) -> Tensor:
        return JerkDensity(self.total).initial()[:, :2]

    def log_prob(self, z: Tensor) -> Tensor:
        """Log density at ``z`` ``(..., window, 2)``; returns ``(..., window)``."""
        b, g = (-z[..., 0]).exp(), (z[..., 1] - z[..., 0]).exp()
        log_prob = self.actuation.log_prob(z)
        for s in self.sums:
            squares = s.jj + 2 * b * s.aj - 2 * g * s.uj + b.square() * s.aa - 2 * b * g * s.au + g.square() * s.uu
            # round-off may make a residual negative
            squares = squares.clamp_min(1e-12 * s.jj)
            width = (2 * s.n).rsqrt()
            log_sigma = 0.5 * (squares / s.n).log().unsqueeze(-1) + width.unsqueeze(-1) * self._nodes
            chi2 = squares.unsqueeze(-1) * (-2 * log_sigma).exp()
            noise = self.noise.log_prob(log_sigma.unsqueeze(-1))
            inside = -0.5 * chi2 - s.n.unsqueeze(-1) * (log_sigma + 0.5 * np.log(2 * np.pi)) + noise
            log_prob = log_prob + (inside + self._log_weights).logsumexp(-1) + width.log()
        return log_prob


@dataclass(frozen=True)
class Track:
    """A loop's beliefs beside the truth, all ``(window, vehicle, parameter)`` in the parameters' own units.

    ``converged`` ``(window, vehicle)``: where it is false the belief is the one before.
    """

    names: tuple[str, ...]
    truth: Tensor
    mean: Tensor
    sd: Tensor
    q05: Tensor
    q95: Tensor
    converged: Tensor

    @property
    def covered(self) -> Tensor:
        """Whether the 90 % interval holds the truth, ``(window, vehicle, parameter)`` bool."""
        return (self.q05 <= self.truth) & (self.truth <= self.q95)

    @property
    def relative_error(self) -> Tensor:
        """``|mean - truth| / truth``."""
        return (self.mean - self.truth).abs() / self.truth


@dataclass(frozen=True)
class PooledComparison:
    """A loop's last belief against the posterior given all windows, every field ``(vehicle, parameter)``.

    Attributes:
        shift: difference of means in the pooled posterior's SDs.
        sd_ratio: SD of the loop over that of the pooled posterior.
        covered: whether the loop's 90 % interval holds the truth.
    """

    names: tuple[str, ...]
    shift: Tensor
    sd_ratio: Tensor
    covered: Tensor

    @classmethod
    def of(cls, track: Track, pooled: Quadrature) -> PooledComparison:
        """Of the parameters that both have."""
        d = len(pooled.names)
        return cls(
            pooled.names,
            (track.mean[-1, :, :d] - pooled.mean) / pooled.sd,
            track.sd[-1, :, :d] / pooled.sd,
            track.covered[-1, :, :d],
        )


def constant(z: Tensor, windows: int) -> Tensor:
    """A path ``(window, vehicle, 3)`` of vehicles ``z = log(T_L, K_L, sigma)`` ``(vehicle, 3)`` that stay."""
    return z.expand(windows, -1, -1)


def step(z: Tensor, later: Tensor, windows: int, *, at: int) -> Tensor:
    """A path that is ``later`` from window ``at`` on; the noise stays."""
    path = constant(z, windows).clone()
    path[at:, :, :2] = later[:, :2]
    return path


def drift(z: Tensor, rate: Tensor, windows: int) -> Tensor:
    """A path along which ``log(T_L, K_L)`` move by ``rate`` ``(vehicle, 2)`` a window; the noise stays."""
    path = constant(z, windows).clone()
    path[..., :2] += rate * torch.arange(windows, dtype=z.dtype)[:, None, None]
    return path


def windows_of(
    path: Tensor, *, rows: int = 200, amplitude: Amplitude = 1.0, generator: torch.Generator | None = None
) -> list[JerkStatistics]:
    """A window's sums for each entry of ``path`` ``(window, vehicle, 3)``; see :func:`statistics`."""
    return [statistics(z, rows=rows, amplitude=amplitude, generator=generator) for z in path]


def track_loop(
    path: Tensor, windows: Sequence[JerkStatistics], *, mode: CarriedBy, seed: int = 0, **loop: Any
) -> Track:
    """Run the loop over ``windows``, all of which are used, and keep its belief after each.

    Args:
        path: the truth, ``log(T_L, K_L, sigma)``, ``(window, vehicle, 3)``.
        loop: further arguments of :class:`SequentialInference`.

    Raises:
        InputError: if path and windows differ in number.
    """
    if len(path) != len(windows):
        raise InputError(f"path, windows: found {len(path)} and {len(windows)}, need as many")
    vehicles = path.shape[1]
    inference = SequentialInference(vehicles=vehicles, mode=mode, kept=2, seed=seed, **loop)
    every = torch.ones(vehicles, dtype=torch.bool)
    beliefs = [inference.update(_density(seen), every) for seen in windows]
    columns = {key: torch.stack([getattr(b, key) for b in beliefs]) for key in ("mean", "sd", "q05", "q95")}
    return Track(beliefs[0].names, path.exp(), converged=torch.stack([b.converged for b in beliefs]), **columns)


def _density(seen: JerkStatistics) -> Callable[[Tensor, Prior], JerkDensity]:
    return lambda index, prior: JerkDensity(seen.select(index), prior)


def truth_given_all(
    windows: Sequence[JerkStatistics], *, shared_noise: bool = True, nodes: int = 31, batch: int = 20
) -> Quadrature:
    """Posterior of each vehicle given all its windows, by quadrature.

    With ``shared_noise`` of ``(T_L, K_L, sigma)``, one sigma for all windows; else of ``(T_L, K_L)``, a sigma each.
    """
    first = Joint(default_actuation_prior(), default_jerk_noise_prior())
    density = JerkDensity(pool(windows), first) if shared_noise else FreeNoise(windows)
    parts = []
    for index in torch.arange(density.windows).split(batch):
        few = [w.select(index) for w in windows]
        parts.append(integrate(JerkDensity(pool(few), first) if shared_noise else FreeNoise(few), nodes=nodes))
    columns = [f.name for f in fields(Quadrature)][1:]
    return Quadrature(density.names, *(torch.cat([getattr(p, name) for p in parts]) for name in columns))


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
