"""The log density where only noisy acceleration and/or speed are measured: nothing is ever differenced."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.errors import InputError
from avtorch.inference.kernel_loading import Unavailable, load_kernels
from avtorch.inference.latent_compiled import compiled_values
from avtorch.inference.latent_filter import latent_log_likelihood
from avtorch.inference.latent_rows import row_values
from avtorch.inference.latent_steady import EvenRows, steady_log_likelihood
from avtorch.inference.latent_values import steady_values
from avtorch.inference.latent_window import LatentWindow
from avtorch.inference.priors import Joint, LogNormalPrior, Prior, default_actuation_prior, prior_on

#: Rows count as even while their times are this close to an even grid: a quarter of a step, and 2.5 ms. The error in
#: speed is 2.5 mm/s per m/s², below the noise of a wheel speed. Other rows use the row-by-row filter, which is exact
#: for any times and slower by the number of rows.
EVEN_STEPS, EVEN_S = 0.25, 0.0025
#: Floor added in squares to the sensors' noise parameters [m/s, m/s²]: no sensor in a car resolves less. Without it the
#: noise fitted to a noise-free simulated log would shrink until the filter loses all digits.
FINEST = 1e-4
#: Medians and log SDs of the noise parameters, for a test car and a production car alike.
#: process_noise [m/s²/√s], the actuator's own roughness: at a lag of 0.3 s the median makes 0.06 m/s², and 95 %
#: lie within a factor 7. road_noise [m/s/√s]: body vibration; the median makes 1 mm/s from row to row at 100 Hz.
#: speed_noise [m/s]: from a good inertial unit to a coarse wheel speed. accel_noise [m/s²]: likewise.
#: coloured_sd [m/s²] and coloured_time [s]: forces that GLVD lacks, such as slope (1 % is 0.1 m/s²), gusts (0.1 to
#: 0.4 m/s² for 1 to 5 s), curves and gear changes; the prior must allow these values, or the posterior of T_L and K_L
#: would be too narrow.
NOISE_PRIOR: dict[str, tuple[float, float]] = {
    "process_noise": (0.15, 1.0),
    "road_noise": (0.01, 1.0),
    "speed_noise": (0.01, 1.5),
    "accel_noise": (0.05, 1.0),
    "coloured_sd": (0.15, 0.7),
    "coloured_time": (1.5, 0.5),
}


def default_noise_prior(names: Sequence[str]) -> LogNormalPrior:
    """Weak log-normal priors of the latent form's noise parameters (`NOISE_PRIOR`), in the order of ``names``."""
    median, log_sd = zip(*(NOISE_PRIOR[name] for name in names), strict=True)
    return LogNormalPrior(torch.tensor(median, dtype=torch.float64), torch.tensor(log_sd, dtype=torch.float64))


def latent_names(*, accel: bool, speed: bool) -> tuple[str, ...]:
    """Parameters of the latent form: the actuation pair, then the noise of what is measured."""
    sensors = (*(("road_noise", "speed_noise") if speed else ()), *(("accel_noise",) if accel else ()))
    return ("T_L", "K_L", "process_noise", *sensors, "coloured_sd", "coloured_time")


def run_log_likelihood(
    p: dict[str, Float[Tensor, "*draw run"]], runs: LatentWindow, even: EvenRows | None
) -> Float[Tensor, "*draw run"]:
    """Log likelihood ``(..., run)`` of parameters by name, each ``(..., run)``; ``even`` is ``even_rows(runs)``.

    Where no gradient is asked for, the same number comes from the routes without a graph, on the processor.
    """
    noise = {name: (p[name].square() + FINEST**2).sqrt() for name in ("accel_noise", "speed_noise") if name in p}
    noise |= {name: p[name] for name in ("road_noise",) if name in p}
    five = (p["T_L"], p["K_L"], p["process_noise"], p["coloured_sd"], p["coloured_time"])
    # the routes without a graph are NumPy's or compiled
    elsewhere = runs.time.device.type != "cpu"
    differentiated = elsewhere or (torch.is_grad_enabled() and any(x.requires_grad for x in (*five, *noise.values())))
    if not differentiated and not isinstance(kernels := load_kernels("latent_kernels"), Unavailable):
        return compiled_values(kernels, *five, runs, even, **noise)
    if even is not None:
        return (steady_log_likelihood if differentiated else steady_values)(*five, even, **noise)
    if not differentiated:
        return _row_by_row(five, runs, noise)
    measured = {"accel": runs.accel, "speed": runs.speed}
    return latent_log_likelihood(*five, runs.time, runs.u, mask=runs.mask, **measured, **noise)


def _row_by_row(five: Sequence[Tensor], runs: LatentWindow, noise: dict[str, Tensor]) -> Tensor:
    lead, counts = five[0].shape[:-1], runs.mask.sum(-1).tolist()
    signals = {name: x for name, x in (("accel", runs.accel), ("speed", runs.speed)) if x is not None}
    same = len(counts) > 1 and all(bool((x == x[:1]).all()) for x in (runs.time, runs.u, runs.mask))
    columns = []
    # runs under the same clock and command are taken together, the runs as further draws
    for run in [slice(0, len(counts))] if same else [slice(r, r + 1) for r in range(len(counts))]:
        rows = counts[run.start]
        own = {name: x[..., run].reshape(-1) for name, x in noise.items()}
        T_L, K_L, rough, sd, slow = (x[..., run].reshape(-1) for x in five)
        measured = {
            name: x[run, :rows].expand(*lead, -1, -1).reshape(-1, rows) if same else x[run, :rows]
            for name, x in signals.items()
        }
        time, u = runs.time[run.start, :rows], runs.u[run.start, :rows]
        values = row_values(T_L, K_L, rough, sd, slow, time, u, **measured, **own)
        columns.append(values.reshape(*lead, -1))
    return torch.cat(columns, -1)


def even_rows(runs: LatentWindow, *, most_steps: float = EVEN_STEPS, most_s: float = EVEN_S) -> EvenRows | None:
    """The layout of the fast route, or None where a row of some run is further off an even grid than both bounds."""
    count = runs.mask.sum(-1)
    index = torch.arange(runs.time.shape[1], dtype=torch.float64, device=runs.time.device)
    last = runs.time.gather(1, (count - 1)[:, None])[:, 0]
    dt = (last - runs.time[:, 0]) / (count - 1).clamp(min=1)
    # A run of a single row has no step; any value will do.
    dt = torch.where(count > 1, dt, dt[count > 1].median() if bool((count > 1).any()) else 0.01)
    off = (runs.time - runs.time[:, :1] - dt[:, None] * index).abs() * runs.mask
    if bool((off > (most_steps * dt[:, None]).clamp(max=most_s)).any()):
        return None
    return EvenRows.build(dt, runs.u, runs.mask, accel=runs.accel, speed=runs.speed)


class LatentDensity:
    """Posterior of ``T_L`` [s], ``K_L`` [-] and the noise of every window (latent form).

    ``names`` is ``latent_names``; the density is in ``z = log(parameter)``. Even rows take the fast route, others the
    row-by-row filter; both give the same number. Gaps and unused rows split a window into runs, whose likelihoods add.

    ``temper`` in (0, 1] is a power on the likelihood, for logs whose windows still spread wider than their posteriors
    (a gain that differs between throttle and brake, say); SDs grow about as ``temper^-1/2``. 1 is the law as written.
    """

    quick_values = True

    def __init__(self, data: LatentWindow, prior: Prior | None = None, *, temper: float = 1.0) -> None:
        if not 0 < temper <= 1:
            raise InputError(f"temper: {temper} is not in (0, 1]")
        self.temper = temper
        self.data = data
        self.names = latent_names(accel=data.accel is not None, speed=data.speed is not None)
        own = Joint(default_actuation_prior(), default_noise_prior(self.names[2:])) if prior is None else prior
        self.prior = prior_on(own, data.time.device)
        self._runs, self._owner = data.runs()
        self._even = even_rows(self._runs)

    @property
    def windows(self) -> int:
        return self.data.windows

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> LatentDensity:
        """The windows named by ``index``."""
        return LatentDensity(self.data.select(index), self.prior.select(index), temper=self.temper)

    def log_likelihood(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        """``z`` ``(..., window, parameter)``; returns ``(..., window)`` [nats], not tempered."""
        p = dict(zip(self.names, z[..., self._owner, :].exp().unbind(-1), strict=True))
        per_run = run_log_likelihood(p, self._runs, self._even)
        if len(self._owner) == self.windows:
            return per_run
        return per_run.new_zeros(*per_run.shape[:-1], self.windows).index_add(-1, self._owner, per_run)

    def approximation(self) -> LatentDensity:
        """The same law with rows moved to an even grid where none of them moves by a step, for `weighted_draws`: this
        density itself where its rows are even, or too uneven."""
        if self._even is not None:
            return self
        even = even_rows(self._runs, most_steps=1.0, most_s=torch.inf)
        if even is None:
            return self
        near = copy(self)
        near._even = even
        return near

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        return self.temper * self.log_likelihood(z) + self.prior.log_prob(z)

    def initial(self) -> Float[Tensor, "window parameter"]:
        """The best of a coarse grid over lag, gain and process noise, the rest at the prior's centre."""
        center = self.prior.center().expand(self.windows, len(self.names))
        lag = torch.tensor([0.1, 0.2, 0.4, 0.8, 1.6], dtype=torch.float64)
        gain = torch.tensor([0.5, 0.75, 1.0], dtype=torch.float64)
        rough = torch.tensor([0.02, 0.1, 0.5], dtype=torch.float64)
        grid = torch.cartesian_prod(lag, gain, rough).log().to(center.device)
        z = center.expand(len(grid), *center.shape).clone()
        z[..., :3] = grid[:, None, :]
        if self.data.speed is not None:
            z[..., self.names.index("speed_noise")] = _speed_noise(self._runs, self._owner, self.windows).log()
        with torch.no_grad():
            score = self.log_prob(z)
        best = torch.where(score.isfinite(), score, -torch.inf).argmax(0)
        return z[best, torch.arange(self.windows, device=z.device)]


def _speed_noise(runs: LatentWindow, owner: Int[Tensor, " run"], windows: int) -> Float[Tensor, " window"]:
    """Rough speed noise [m/s] ``(window,)`` from second differences of the speed: a start, not an estimate."""
    assert runs.speed is not None
    bend = runs.speed.diff(n=2).abs() * runs.mask[:, 2:]
    rows = runs.mask[:, 2:].sum(-1).clamp(min=1)
    # Mean of abs(N(0, 6 r²)) is r sqrt(12/pi).
    each = bend.sum(-1) / rows / (12.0 / torch.pi) ** 0.5
    # A later run of a window overwrites an earlier one; any will do.
    return each.new_full((windows,), 0.01).index_copy(0, owner, each).clamp(1e-4, 1.0)
