"""The latent form: only noisy acceleration and/or speed are measured, and nothing is ever differenced.

Which windows of a stream are excited is a fixed rule, independent of the posterior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int, Real
from avtorch.errors import InputError
from avtorch.inference.compiled import load_kernels
from avtorch.inference.device import Device
from avtorch.inference.form import Rows, WindowLikelihood
from avtorch.inference.latent_model import ACCEL_SD0, SPEED_SD0, latent_log_likelihood
from avtorch.inference.priors import Joint, LogNormalPrior, Prior, default_actuation_prior
from avtorch.inference.sampler_settings import SamplerSettings

#: A step longer than this many median steps is a gap: the filter starts afresh behind it.
GAP = 2.5


@dataclass(frozen=True)
class LatentWindow:
    """Rows of one or many windows, ``(window, time)`` float64, shorter ones padded at the end with ``mask`` False.

    ``time`` [s]; ``u`` [m/s²] held from its row to the next; ``accel`` [m/s²] and/or ``speed`` [m/s] as measured, or
    None; ``mask`` True where a row may be used (engaged, moving).
    """

    time: Float[Tensor, "window time"]
    u: Float[Tensor, "window time"]
    accel: Float[Tensor, "window time"] | None
    speed: Float[Tensor, "window time"] | None
    mask: Bool[Tensor, "window time"]

    def __post_init__(self) -> None:
        if self.accel is None and self.speed is None:
            raise InputError("accel, speed: neither was given; the latent form needs at least one measured signal")
        if self.time.ndim != 2:
            raise InputError(f"time: has {self.time.ndim} dimensions; expected 2, (window, time)")
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and value.shape != self.time.shape:
                raise InputError(f"{field.name}: has shape {tuple(value.shape)}; time has {tuple(self.time.shape)}")
        if bool(((self.time.diff() <= 0) & self.mask[:, 1:] & self.mask[:, :-1]).any()):
            raise InputError("time: does not increase from row to row")
        for name in ("u", "accel", "speed"):
            value = getattr(self, name)
            if value is not None and not bool(torch.isfinite(value[self.mask]).all()):
                raise InputError(f"{name}: is not finite in every row that is used")

    @property
    def windows(self) -> int:
        return self.time.shape[0]

    @classmethod
    def single(
        cls,
        time: Real[Tensor, " time"],
        u: Real[Tensor, " time"],
        *,
        accel: Real[Tensor, " time"] | None = None,
        speed: Real[Tensor, " time"] | None = None,
        mask: Bool[Tensor, " time"] | Real[Tensor, " time"] | None = None,
    ) -> LatentWindow:
        """One window from rows ``(time,)``."""

        def row(value: Tensor | None) -> Tensor | None:
            return None if value is None else torch.as_tensor(value, dtype=torch.float64)[None]

        t = torch.as_tensor(time, dtype=torch.float64)[None]
        c = torch.as_tensor(u, dtype=torch.float64)[None]
        used = torch.ones_like(t, dtype=torch.bool) if mask is None else torch.as_tensor(mask, dtype=torch.bool)[None]
        return cls(t, c, row(accel), row(speed), used)

    @classmethod
    def stack(cls, windows: Sequence[LatentWindow]) -> LatentWindow:
        """Many windows as one, padded to the longest."""
        longest = max(w.time.shape[1] for w in windows)

        def pad(value: Tensor) -> Tensor:
            return torch.nn.functional.pad(value, (0, longest - value.shape[1]))

        def measured(name: str) -> Tensor | None:
            given = [pad(v) for w in windows if (v := getattr(w, name)) is not None]
            if 0 < len(given) < len(windows):
                raise InputError(f"{name}: measured in some windows only; give it for all of them or for none")
            return torch.cat(given) if given else None

        time, u, mask = (torch.cat([pad(getattr(w, name)) for w in windows]) for name in ("time", "u", "mask"))
        return cls(time, u, measured("accel"), measured("speed"), mask)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> LatentWindow:
        """The windows named by ``index``."""
        return self._each(lambda rows: rows[index])

    def to(self, device: Device) -> LatentWindow:
        """The same rows on another device."""
        return self._each(lambda rows: rows.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> LatentWindow:
        accel, speed = (None if x is None else change(x) for x in (self.accel, self.speed))
        return LatentWindow(change(self.time), change(self.u), accel, speed, change(self.mask))

    def runs(self) -> tuple[LatentWindow, Int[Tensor, " run"]]:
        """Stretches without a gap or an unused row, one a row, and the window ``(run,)`` each comes from.

        After a gap, a standstill or a driver's override the acceleration is unknown, so each run starts afresh.
        """
        pieces: list[Tensor] = []
        owner: list[int] = []
        for w in range(self.windows):
            rows = self.mask[w].nonzero()[:, 0]
            if not len(rows):
                continue
            step = self.time[w, rows].diff()
            usual = step.median() if len(step) else torch.tensor(0.0)
            cut = ((rows.diff() > 1) | (step > GAP * usual)).nonzero()[:, 0] + 1
            found = torch.tensor_split(rows, cut.cpu())
            pieces += found
            owner += [w] * len(found)
        if not pieces:
            raise InputError("mask: no row of any window may be used")
        of = torch.tensor(owner, device=self.time.device)
        rows = torch.nn.utils.rnn.pad_sequence(pieces, batch_first=True)
        mask = torch.nn.utils.rnn.pad_sequence([torch.ones_like(x, dtype=torch.bool) for x in pieces], batch_first=True)
        return self._each(lambda x: torch.where(mask, x[of[:, None], rows], x.new_zeros(()))), of


#: Rows count as even while their times are this close to an even grid: a quarter of a step, and 2.5 ms. The error in
#: speed is 2.5 mm/s per m/s², below the noise of a wheel speed. For even rows the model is discretised once, for others
#: at every row.
EVEN_STEPS, EVEN_S = 0.25, 0.0025
#: Floor added in squares to the sensors' noise parameters [m/s, m/s²]: no sensor in a car resolves less. Without it the
#: noise fitted to a noise-free simulated log would shrink until the filter loses all digits.
FINEST = 1e-4
#: Of the log parameters, for central differences of the log density: what they cut off is some 1e-9 of the third
#: derivative, and a round-off of 1e-9 nats becomes 5e-6.
SPACING = 1e-4
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
    p: dict[str, Float[Tensor, "*draw run"]], runs: LatentWindow, steps: Float[Tensor, " run"] | None
) -> Float[Tensor, "*draw run"]:
    """Log likelihood ``(..., run)`` of parameters by name, each ``(..., run)``; ``steps`` is ``even_steps(runs)``.

    Where a gradient is asked for by the filter in torch, otherwise the same number by the compiled one.
    """
    sensors = ("accel_noise", "speed_noise")
    p = {name: (x.square() + FINEST**2).sqrt() if name in sensors else x for name, x in p.items()}
    graph = torch.is_grad_enabled() and any(x.requires_grad for x in p.values())
    values = None if graph else compiled_log_likelihood(p, runs, steps)
    if values is not None:
        return values
    time = runs.time
    if steps is not None:
        time = steps[:, None] * torch.arange(time.shape[1], dtype=torch.float64, device=time.device)
    return latent_log_likelihood(**p, time=time, u=runs.u, mask=runs.mask, accel=runs.accel, speed=runs.speed)


@torch.no_grad()
def compiled_log_likelihood(
    p: dict[str, Float[Tensor, "*draw run"]], runs: LatentWindow, steps: Float[Tensor, " run"] | None
) -> Float[Tensor, "*draw run"] | None:
    """As :func:`run_log_likelihood`, with no gradient, on the processor; NaN where digits are lost.

    None where nothing can be compiled here.
    """
    kernels = load_kernels("latent_kernels")
    if kernels is None:
        return None
    like = p["T_L"]
    zero, device = torch.zeros_like(like), like.device
    names = ("T_L", "K_L", "process_noise", "road_noise", "coloured_sd", "coloured_time")
    variances = [p.get(name, zero).square() for name in ("speed_noise", "accel_noise")]
    given = torch.stack([*(p.get(name, zero) for name in names), *variances])
    given = given.reshape(8, -1, like.shape[-1]).movedim(-1, 0).cpu().contiguous().numpy()
    rows = runs if device.type == "cpu" else runs.to("cpu")
    speed = None if "speed_noise" not in p or rows.speed is None else (rows.speed - rows.speed[:, :1]).numpy()
    accel = None if "accel_noise" not in p or rows.accel is None else rows.accel.numpy()
    time, u, none = rows.time.numpy(), rows.u.numpy(), np.empty(0)
    found = np.empty((len(u), given.shape[2]))
    for run, count in enumerate(rows.mask.sum(-1).tolist()):
        dt = np.diff(time[run, :count]) if steps is None else np.full(count - 1, float(steps[run]))
        signals = (none if x is None else x[run, :count] for x in (speed, accel))
        parameters = (given[run, :6], given[run, 6:], SPEED_SD0, ACCEL_SD0)
        kernels.filtered(found[run], *parameters, dt, steps is not None, u[run, :count], *signals)
    return torch.from_numpy(found.T.copy()).reshape(like.shape).to(device)


def even_steps(runs: LatentWindow) -> Float[Tensor, " run"] | None:
    """The step ``(run,)`` [s] of even rows, or None where a row is further off its run's grid than both bounds."""
    count = runs.mask.sum(-1)
    index = torch.arange(runs.time.shape[1], dtype=torch.float64, device=runs.time.device)
    last = runs.time.gather(1, (count - 1)[:, None])[:, 0]
    dt = (last - runs.time[:, 0]) / (count - 1).clamp(min=1)
    # A run of a single row has no step; any value will do.
    dt = torch.where(count > 1, dt, dt[count > 1].median() if bool((count > 1).any()) else 0.01)
    off = (runs.time - runs.time[:, :1] - dt[:, None] * index).abs() * runs.mask
    return None if bool((off > (EVEN_STEPS * dt[:, None]).clamp(max=EVEN_S)).any()) else dt


class LatentDensity:
    """Posterior of ``T_L`` [s], ``K_L`` [-] and the noise of every window (latent form).

    ``names`` is ``latent_names``; the density is in ``z = log(parameter)``. Gaps and unused rows split a window into
    runs, whose likelihoods add.
    """

    quick_values = True

    def __init__(self, data: LatentWindow, prior: Prior | None = None) -> None:
        self.data = data
        self.names = latent_names(accel=data.accel is not None, speed=data.speed is not None)
        own = Joint(default_actuation_prior(), default_noise_prior(self.names[2:])) if prior is None else prior
        self.prior = own.to(data.time.device)
        self._runs, self._owner = data.runs()
        self._steps = even_steps(self._runs)

    @property
    def windows(self) -> int:
        return self.data.windows

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> LatentDensity:
        """The windows named by ``index``."""
        return LatentDensity(self.data.select(index), self.prior.select(index))

    def log_likelihood(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        """``z`` ``(..., window, parameter)``; returns ``(..., window)`` [nats]."""
        p = dict(zip(self.names, z[..., self._owner, :].exp().unbind(-1), strict=True))
        per_run = run_log_likelihood(p, self._runs, self._steps)
        if len(self._owner) == self.windows:
            return per_run
        return per_run.new_zeros(*per_run.shape[:-1], self.windows).index_add(-1, self._owner, per_run)

    def log_prob(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window"]:
        return self.log_likelihood(z) + self.prior.log_prob(z)

    @torch.no_grad()
    def score(self, z: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "*draw window parameter"]:
        """Gradient of :meth:`log_prob` by central differences `SPACING` apart: compiled values cost so little that all
        of them take a fraction of the time of a graph, and they are good to 1e-5 of a posterior SD."""
        d = z.shape[-1]
        shifts = SPACING * torch.eye(d, dtype=z.dtype, device=z.device).reshape(d, *[1] * (z.dim() - 1), d)
        ahead, behind = self.log_prob(z + torch.stack([shifts, -shifts]))
        return (ahead - behind).movedim(0, -1) / (2 * SPACING)

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


#: Each step runs a filter over the rows for every chain, so there are fewer and longer chains. Some parameters are
#: determined by little more than their prior, and their posteriors are so far from normal that importance sampling
#: around the draws does not determine their moments; convergence is tested on the chains alone.
SAMPLER = SamplerSettings(chains=64, draws=20, burn_in=12, thinning=1, step=1.5, longest=3.0, compare=False)
#: Reference vehicle at which the information is predicted: lag [s], gain [-].
REFERENCE = (0.3, 1.0)
#: Noise level at which it is predicted: the medians of the noise priors.
REFERENCE_NOISE = {name: median for name, (median, _) in NOISE_PRIOR.items()}
#: SDs of log T_L and log K_L under the first prior.
KNOWN = (0.7, 0.3)
#: A window is excited from one bit on: where it is expected to halve the area of the belief about (T_L, K_L).
LEAST_BITS = 1.0


class LatentForm:
    """Windows of ``accel_cmd`` with measured ``accel`` and/or ``speed``, for :class:`LatentDensity`.

    `accel`, `speed`: which of the two is measured. `noise`: noise level at which excitation is predicted, by name (see
    :func:`latent_excitation`). `share`: the least share of a window's rows that must be usable; the state at the start
    of a run is unknown, so that a short end of a drive is less informative than its rows suggest.
    """

    sampler = SAMPLER

    def __init__(
        self,
        *,
        accel: bool,
        speed: bool,
        noise: Mapping[str, float] | None = None,
        noise_prior: Prior | None = None,
        share: float = 0.75,
    ) -> None:
        self.names = latent_names(accel=accel, speed=speed)
        self.measured = (*(("accel",) if accel else ()), *(("speed",) if speed else ()))
        self.columns = ("accel_cmd", *self.measured)
        self.noise_prior: Prior = default_noise_prior(self.names[2:]) if noise_prior is None else noise_prior
        self.noise, self.share = noise, share

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        usable = rows["usable"]
        count = usable.sum(-1)
        enough = count >= max(4.0, self.share * full)
        time = rows["time"].expand(usable.shape)
        signals = {name: rows[name] if name in self.measured else None for name in ("accel", "speed")}
        data = LatentWindow(time, rows["accel_cmd"], signals["accel"], signals["speed"], usable)
        excited = torch.zeros_like(enough)
        if bool(enough.any()):
            excited[enough] = latent_excitation(data.select(enough), noise=self.noise)[0]
        return WindowLikelihood(count, excited, lambda index, prior: LatentDensity(data.select(index), prior))


def latent_excitation(
    data: LatentWindow,
    *,
    noise: Mapping[str, float] | None = None,
    reference: tuple[float, float] = REFERENCE,
) -> tuple[Bool[Tensor, " window"], Float[Tensor, " window"]]:
    """Which windows are excited, ``(window,)`` bool, and their expected information, ``(window,)`` [bit].

    The figure is the expected information about ``(log T_L, log K_L)`` that the *command* brings, at a fixed reference
    vehicle and noise level: with ``F`` the Fisher information of the predicted signal and ``C = diag(KNOWN²)``,
    ``log2 det(I + C F) / 2``. It depends on times, commands and mask, on which signals are measured and on ``noise``
    (names and units of ``NOISE_PRIOR``; the default is ``REFERENCE_NOISE``), not on measured values or a posterior.
    Each run's start and a constant force on it are taken as unknown, so a constant command carries no information.
    """
    place, data = data.time.device, data.to("cpu")  # some short recursions, row by row
    runs, owner = data.runs()
    names = latent_names(accel=data.accel is not None, speed=data.speed is not None)
    values = dict(zip(names[:2], reference, strict=True)) | REFERENCE_NOISE | dict(noise or {})
    p = {name: torch.full_like(owner, values[name], dtype=torch.float64) for name in names}

    by_lag, by_gain = _sensitivities(runs, *reference)

    def energies_of(signals: list[tuple[Tensor, Tensor]]) -> list[Tensor]:
        """``sᵀ Σ⁻¹ s`` of signals (acceleration, speed): twice the loss of log likelihood that each causes alone."""
        count = len(signals)
        accel, speed = (torch.cat(parts) for parts in zip(*signals, strict=True))
        time, mask = (x.repeat(count, 1) for x in (runs.time, runs.mask))
        data = LatentWindow(
            time,
            torch.zeros_like(time),
            None if runs.accel is None else accel,
            None if runs.speed is None else speed,
            mask,
        )
        repeated = {name: x.repeat(count) for name, x in p.items()}
        return list((-2.0 * run_log_likelihood(repeated, data, even_steps(data))).chunk(count))

    # A force of unknown constant size, such as a slope: only changes of the command then determine the gain.
    since = runs.time - runs.time[:, :1]
    signals = (by_lag, by_gain, (torch.ones_like(since), since))
    zero = torch.zeros_like(since)
    pairs = ((0, 1), (0, 2), (1, 2))
    sums = [(signals[i][0] + signals[j][0], signals[i][1] + signals[j][1]) for i, j in pairs]
    floor, *found = energies_of([(zero, zero), *signals, *sums])
    energies = [x - floor for x in found[:3]]
    tk, tc, kc = (
        0.5 * (both - energies[i] - energies[j] - floor) for both, (i, j) in zip(found[3:], pairs, strict=True)
    )
    tt, kk, cc = energies
    cc = cc.clamp(min=1e-12)
    fisher = (tt - tc**2 / cc, kk - kc**2 / cc, tk - tc * kc / cc)
    tt, kk, tk = (torch.zeros(data.windows, dtype=torch.float64).index_add(0, owner, f) for f in fisher)
    known_T, known_K = KNOWN
    determinant = (1.0 + known_T**2 * tt) * (1.0 + known_K**2 * kk) - (known_T * known_K * tk) ** 2
    bits = 0.5 * determinant.clamp(min=1.0).log() / math.log(2.0)
    bits = bits.to(place)
    return bits >= LEAST_BITS, bits


def _sensitivities(runs: LatentWindow, T: float, K: float) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Derivatives of (acceleration, speed) by log T_L and by log K_L, each ``(run, time)``, with the command held."""
    h = 1e-4
    shape = runs.time.shape
    lags = (T * (1.0 + h), T * (1.0 - h))
    found = np.zeros((2, 2, *shape))  # lag, (acceleration, speed), run, row
    steps, targets = runs.time.diff().clamp(min=0.0).numpy(), K * runs.u.numpy()
    for i, lag in enumerate(lags):
        for run in range(shape[0]):
            # plain numbers: one short recursion after another, in which a call of an array library costs most
            kept = np.exp(-steps[run] / lag).tolist()
            a, v = float(targets[run, 0]), 0.0
            accel, speed = [a], [v]
            for u, dt, decay in zip(targets[run].tolist(), steps[run].tolist(), kept, strict=False):
                fading = (a - u) * (1.0 - decay)
                v += u * dt + lag * fading
                a -= fading
                accel.append(a)
                speed.append(v)
            found[i, :, run] = accel, speed
    accel, speed = torch.from_numpy(found).unbind(1)
    by_lag = ((accel[0] - accel[1]) / (2.0 * h), (speed[0] - speed[1]) / (2.0 * h))
    # The response is proportional to K_L.
    return by_lag, (accel.mean(0), speed.mean(0))
