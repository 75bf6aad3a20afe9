"""Windows to validate on: synthetic ones over a range of vehicles and drives, and those of a log.

Windows drawn from the exact model of the jerk likelihood serve checks that need both to agree: ``a`` moves by the
*measured* jerk, ``a + dt jerk``. An acceleration simulated without the noise would carry more information, and a
posterior that does not use it would not be exactly calibrated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.density import Density, SelectableDensity
from avtorch.inference.form import Form
from avtorch.inference.jerk import ExcitationRule, JerkDensity, JerkForm, JerkStatistics
from avtorch.inference.latent import LatentForm
from avtorch.inference.priors import Joint, default_actuation_prior
from avtorch.inference.sampler_settings import SamplerSettings
from avtorch.io.clock import ROUNDING_S
from avtorch.io.log import Log, no_command
from avtorch.io.us06 import US06_SPEED_MPS
from avtorch.vehicle.glvd import glvd_jerk, glvd_rollout


def simulate_windows(
    z: Tensor, u: Tensor, *, dt: float = 0.01, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Acceleration [m/s^2] and jerk [m/s^3] of vehicles ``z = log(T_L, K_L, sigma)`` under commands ``u``.

    A lag below ``dt`` would diverge where a sample's jerk is held for ``dt``; it is held for ``T_L`` then.

    `z`: shape ``(window, 3)``. `u`: demanded acceleration [m/s^2], ``(window, time)``; the acceleration starts at the
    first command.

    Returns:
        ``a`` and ``jerk``, each ``(window, time)``.

    Raises `InputError` for shapes that do not match.
    """
    if z.ndim != 2 or z.shape[1] != 3 or u.ndim != 2 or len(u) != len(z):
        raise InputError(f"z, u: found shapes {tuple(z.shape)}, {tuple(u.shape)}, need (window, 3), (window, time)")
    lag, gain, sigma = z.exp().unbind(-1)
    noise = sigma[:, None] * torch.randn(u.shape, generator=generator, dtype=torch.float64)
    # noise in jerk is a command of T/K noise
    moved = glvd_rollout(u[:, 0], u + (lag / gain)[:, None] * noise, lag, gain, lag.clamp_max(dt), method="euler")
    a = torch.cat([u[:, :1], moved[:, :-1]], -1)
    return a, glvd_jerk(a, u, lag[:, None], gain[:, None]) + noise


#: Ranges of the synthetic windows, each log-uniform but the gain, which is uniform: lag [s], gain [-], jerk noise
#: [m/s^3], largest command [m/s^2].
LAG, GAIN, NOISE, AMPLITUDE = (0.1, 2.0), (0.4, 1.1), (0.03, 0.3), (0.03, 3.0)
#: Points of a synthetic window, in turn; time step [s].
POINTS, DT = (200, 500), 0.01
#: Frequencies of the sines of a command [Hz], log-uniform.
FREQUENCY = (0.05, 1.0)
#: Usable rows that a window of a log must have: its parameters from fewer are the prior's.
LEAST_ROWS = 10


@dataclass(frozen=True)
class Windows:
    """Windows, each with a posterior of its own under the first prior.

    Attributes:
        name: where they come from: "synthetic" or the log's name.
        form: "jerk" or "latent".
        density: the posterior density of all of them.
        n: usable rows, ``(window,)``.
        excited: ``(window,)`` bool, by the fixed rule; the others are validated as well.
        truth: the true parameters in the order of ``density.names``, ``(window, parameter)``, or None where unknown.
        start_s, end_s: bounds on the log's clock [s], ``(window,)``; from 0 for synthetic windows.
        sampler: settings of SGLD that the form has by default.

    Example:
        >>> import torch
        >>> from avtorch.validation import synthetic_windows
        >>> windows = synthetic_windows(4, seed=1)
        >>> len(windows), windows.names, windows.n.tolist()
        (4, ('T_L', 'K_L', 'sigma'), [200.0, 500.0, 200.0, 500.0])
        >>> tuple(windows.select(torch.tensor([0, 2])).truth.shape)
        (2, 3)
    """

    name: str
    form: str
    density: Density
    n: Tensor
    excited: Tensor
    truth: Tensor | None
    start_s: Tensor
    end_s: Tensor
    sampler: SamplerSettings = field(default_factory=SamplerSettings)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.density.names

    def __len__(self) -> int:
        return self.density.windows

    def select(self, index: Tensor) -> Windows:
        """The windows named by ``index``.

        Raises `InputError` if the density's windows cannot be taken apart.
        """
        if not isinstance(self.density, SelectableDensity):
            raise InputError(f"density: the windows of {type(self.density).__name__} cannot be selected")
        return replace(
            self,
            density=self.density.select(index),
            n=self.n[index],
            excited=self.excited[index],
            truth=None if self.truth is None else self.truth[index],
            start_s=self.start_s[index],
            end_s=self.end_s[index],
        )


def synthetic_windows(count: int, *, seed: int = 0) -> Windows:
    """Windows of measured jerk from slow to quick vehicles and from hardly moving to hard driving.

    Lag, gain, noise and the largest command are drawn from `LAG`, `GAIN`, `NOISE` and `AMPLITUDE`; every other window
    has 200 and 500 points at 100 Hz; the command is a sum of three sines or a piece of the US06 cycle, as often.

    Raises `InputError` for ``count`` below 1.

    Example:
        >>> from avtorch.inference import find_mode
        >>> from avtorch.validation import synthetic_windows
        >>> windows = synthetic_windows(3, seed=1)
        >>> estimate, truth = find_mode(windows.density).z.exp(), windows.truth
        >>> bool(((estimate / truth - 1).abs() < 0.5).all())
        True
    """
    if count < 1:
        raise InputError(f"windows: found {count}, needs 1 or more")
    generator = torch.Generator().manual_seed(seed)
    T, sigma = _log_uniform(LAG, count, generator), _log_uniform(NOISE, count, generator)
    K = GAIN[0] + (GAIN[1] - GAIN[0]) * torch.rand(count, generator=generator, dtype=torch.float64)
    truth = torch.stack([T, K, sigma], -1)
    u = command(count, max(POINTS), generator=generator)
    points = torch.tensor(POINTS).repeat(-(-count // len(POINTS)))[:count]
    inside = torch.arange(u.shape[-1]) < points[:, None]
    a, jerk = simulate_windows(truth.log(), u, dt=DT, generator=generator)
    statistics = JerkStatistics.from_samples(a, u, jerk, inside)
    return Windows(
        name="synthetic",
        form="jerk",
        density=JerkDensity(statistics),
        n=statistics.n,
        excited=ExcitationRule()(statistics, 0.0),  # every row is usable
        truth=truth,
        start_s=torch.zeros(count, dtype=torch.float64),
        end_s=DT * points.double(),
    )


def windows_of_log(log: Log, *, window: float = 2.0, count: int | None = None) -> Windows:
    """The windows of a log, each under the first prior: the jerk form where jerk and accel are there, else the latent.

    They lie on the grid of the sequential loop, which starts afresh with each segment; windows with fewer than
    `LEAST_ROWS` usable rows are left out.

    `window`: length [s]. `count`: at most so many, evenly spread over the log; all by default.

    Raises `InputError` for a log without accel_cmd or without a usable window, a ``window`` that is not positive, or
    ``count`` below 1.
    """
    if log.accel_cmd is None:
        raise no_command(log, "; T_L and K_L need the demanded acceleration")
    if not (math.isfinite(window) and window > 0):
        raise InputError(f"window: found {window:g} s, needs a finite number above 0")
    if count is not None and count < 1:
        raise InputError(f"windows: found {count}, needs 1 or more")
    spans = _spans(log, window)
    if not spans:
        raise InputError(f"{log.name}: no window of {window:g} s has {LEAST_ROWS} usable rows")
    if count is not None and count < len(spans):
        spans = [spans[i] for i in torch.linspace(0, len(spans) - 1, count).round().long().tolist()]
    measured = log.jerk is not None and log.accel is not None
    form: Form = JerkForm() if measured else LatentForm(accel=log.accel is not None, speed=log.speed is not None)
    likelihood = form.likelihood(_padded(log, form, spans), window * log.rate_hz)
    prior = Joint(default_actuation_prior(), form.noise_prior)
    start = torch.tensor([s for s, _ in spans], dtype=torch.float64)
    # from the log's start to its own clock, which a segment may start anew
    clock = torch.from_numpy(log.time - log.elapsed)[[rows.start for _, rows in spans]]
    last = torch.tensor([float(log.elapsed[rows.stop - 1]) for _, rows in spans], dtype=torch.float64)
    return Windows(
        name=log.name,
        form="jerk" if measured else "latent",
        density=likelihood.density(torch.arange(len(spans)), prior),
        n=likelihood.n,
        excited=likelihood.excited,
        truth=None,
        start_s=(start + clock).round(decimals=9),
        end_s=(torch.minimum(start + window, last + 1 / log.rate_hz) + clock).round(decimals=9),
        sampler=form.sampler,
    )


def command(windows: int, rows: int, *, dt: float = DT, generator: torch.Generator | None = None) -> Tensor:
    """Demanded accelerations [m/s^2], ``(window, time)``: sums of three sines and pieces of US06 in turn.

    The largest command of a window is log-uniform over `AMPLITUDE`.
    """
    time = dt * torch.arange(rows, dtype=torch.float64)
    frequency = _log_uniform(FREQUENCY, 3 * windows, generator).reshape(3, windows, 1)
    phase = 2 * torch.pi * torch.rand(3, windows, 1, generator=generator, dtype=torch.float64)
    share = torch.rand(3, windows, 1, generator=generator, dtype=torch.float64)
    sines = (share * torch.sin(2 * torch.pi * frequency * time + phase)).sum(0)
    pieces = _us06(windows, time, generator)
    turn = (torch.arange(windows) % 4 < 2)[:, None]  # both kinds get both numbers of points
    shape = torch.where(turn, sines, pieces)
    return _log_uniform(AMPLITUDE, windows, generator)[:, None] * shape / shape.abs().amax(-1, keepdim=True)


def _us06(windows: int, time: Tensor, generator: torch.Generator | None) -> Tensor:
    """Accelerations [m/s^2] of moving pieces of US06, ``(window, time)``."""
    speed = torch.tensor(US06_SPEED_MPS, dtype=torch.float64)
    accel = torch.cat([speed[1:2] - speed[:1], 0.5 * (speed[2:] - speed[:-2]), speed[-1:] - speed[-2:-1]])
    length = int(time[-1]) + 2
    pieces = accel.unfold(0, length + 1, 1)
    moving = (pieces.abs().amax(-1) > 0.1).nonzero().squeeze(-1)
    first = moving[torch.randint(len(moving), (windows,), generator=generator)]
    at = torch.rand(windows, 1, generator=generator, dtype=torch.float64) + time
    second = at.long()
    around = accel[first[:, None] + second], accel[first[:, None] + second + 1]
    return torch.lerp(*around, at - second)


def _log_uniform(bounds: tuple[float, float], count: int, generator: torch.Generator | None) -> Tensor:
    low, high = map(math.log, bounds)
    return (low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)).exp()


def _spans(log: Log, window: float) -> list[tuple[float, slice]]:
    """Start [s from the log's start] and rows of every window with enough usable rows."""
    spans = []
    usable = torch.from_numpy(log.usable)
    for part in log.segments():
        time = torch.from_numpy(log.elapsed[part])
        # round-off in a clock that counts 0.01 s must not push a row over a window's end
        number = ((time - time[0] + ROUNDING_S) / window).floor().long()
        which, rows = number.unique_consecutive(return_counts=True)
        first = part.start
        for k, n in zip(which.tolist(), rows.tolist(), strict=True):
            if int(usable[first : first + n].sum()) >= LEAST_ROWS:
                spans.append((float(time[0]) + k * window, slice(first, first + n)))
            first += n
    return spans


def _padded(log: Log, form: Form, spans: list[tuple[float, slice]]) -> dict[str, Tensor]:
    """Rows ``(window, time)``; shorter windows are filled up with rows that are not usable."""
    longest = max(rows.stop - rows.start for _, rows in spans)
    index = torch.stack([torch.arange(longest) + rows.start for _, rows in spans])
    inside = index < torch.tensor([rows.stop for _, rows in spans])[:, None]
    index = torch.where(inside, index, index[:, :1])
    signals = {name: getattr(log, name) for name in form.columns} | {"time": log.elapsed}
    rows = {name: torch.from_numpy(signal)[index] for name, signal in signals.items()}
    last = torch.where(inside, rows["time"], -torch.inf).amax(-1, keepdim=True)
    later = last + (torch.arange(longest) + 1) / log.rate_hz
    return {
        **rows,
        "time": torch.where(inside, rows["time"], later),
        "usable": torch.from_numpy(log.usable)[index] & inside,
    }
