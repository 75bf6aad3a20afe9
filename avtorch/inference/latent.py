"""The log density where only noisy acceleration and/or speed are measured: a latent acceleration, nothing differenced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.latent_filter import latent_log_likelihood
from avtorch.inference.latent_steady import EvenRows, steady_log_likelihood
from avtorch.inference.priors import Joint, LogNormalPrior, Prior, default_actuation_prior

#: A step longer than this many median steps is a gap: the filter starts afresh behind it.
GAP = 2.5
#: Rows count as even while their times lie this close, in steps, to an even grid. A lag of a twentieth of a step moves a
#: speed by 0.5 mm/s per m/s² at 100 Hz, below the noise of any wheel speed; beyond it the row-by-row filter takes over.
EVEN = 0.05
#: Medians and log SDs of the noise parameters, wide enough for a test car and a production car alike; 95 % within a
#: factor 7 (log SD 1). process_noise [m/s²/√s]: the actuator's own roughness; 0.1 makes 0.1 m/s² in a second.
#: speed_noise [m/s]: from a good inertial unit to a coarse wheel speed. accel_noise [m/s²]: likewise.
#: coloured_sd [m/s²] and coloured_time [s]: what GLVD lacks: slope (2 % is 0.2 m/s²), gusts (0.1 to 0.4 m/s², 1 to 5 s),
#: gear changes, gain errors; it must be free to reach them, or the posterior of T_L and K_L is several times too narrow.
NOISE_PRIOR: dict[str, tuple[float, float]] = {
    "process_noise": (0.1, 1.0),
    "road_noise": (0.005, 1.0),
    "speed_noise": (0.01, 1.5),
    "accel_noise": (0.05, 1.0),
    "coloured_sd": (0.15, 0.7),
    "coloured_time": (1.5, 0.7),
}


@dataclass(frozen=True)
class LatentWindow:
    """Rows of one or many windows, ``(window, time)`` float64, shorter ones padded at the end with ``mask`` False.

    ``time`` [s]; ``u`` [m/s²] held from its row to the next; ``accel`` [m/s²] and/or ``speed`` [m/s] as measured, or None;
    ``mask`` True where a row may be used (engaged, moving).
    """

    time: Tensor
    u: Tensor
    accel: Tensor | None
    speed: Tensor | None
    mask: Tensor

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
        time: Tensor,
        u: Tensor,
        *,
        accel: Tensor | None = None,
        speed: Tensor | None = None,
        mask: Tensor | None = None,
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

        def join(name: str) -> Tensor | None:
            values = [getattr(w, name) for w in windows]
            given = [v for v in values if v is not None]
            if not given:
                return None
            if len(given) < len(values):
                raise InputError(f"{name}: measured in some windows only; give it for all of them or for none")
            return torch.cat([torch.nn.functional.pad(v, (0, longest - v.shape[1])) for v in given])

        time, u, mask = join("time"), join("u"), join("mask")
        assert time is not None and u is not None and mask is not None
        return cls(time, u, join("accel"), join("speed"), mask)

    def select(self, index: Tensor) -> LatentWindow:
        """The windows named by ``index``."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        return LatentWindow(**{name: None if v is None else v[index] for name, v in parts.items()})

    def runs(self) -> tuple[LatentWindow, Tensor]:
        """Stretches without a gap or an unused row, one a row, and the window ``(run,)`` each comes from.

        Behind a gap, a standstill or a driver's override the acceleration is anybody's, so each run starts afresh.
        """
        pieces: list[LatentWindow] = []
        owner: list[int] = []
        for w in range(self.windows):
            rows = self.mask[w].nonzero()[:, 0]
            if not len(rows):
                continue
            step = self.time[w, rows].diff()
            usual = step.median() if len(step) else torch.tensor(0.0)
            cut = ((rows.diff() > 1) | (step > GAP * usual)).nonzero()[:, 0] + 1
            for piece in torch.tensor_split(rows, cut.cpu()):
                pieces.append(
                    LatentWindow.single(
                        self.time[w, piece],
                        self.u[w, piece],
                        accel=None if self.accel is None else self.accel[w, piece],
                        speed=None if self.speed is None else self.speed[w, piece],
                    )
                )
                owner.append(w)
        if not pieces:
            raise InputError("mask: no row of any window may be used")
        return LatentWindow.stack(pieces), torch.tensor(owner)


def default_noise_prior(names: Sequence[str]) -> LogNormalPrior:
    """Weak log-normal priors of the latent form's noise parameters (`NOISE_PRIOR`), in the order of ``names``."""
    median, log_sd = zip(*(NOISE_PRIOR[name] for name in names), strict=True)
    return LogNormalPrior(torch.tensor(median, dtype=torch.float64), torch.tensor(log_sd, dtype=torch.float64))


def latent_names(*, accel: bool, speed: bool) -> tuple[str, ...]:
    """Parameters of the latent form: the actuation pair, then the noise of what is measured."""
    sensors = (*(("road_noise", "speed_noise") if speed else ()), *(("accel_noise",) if accel else ()))
    return ("T_L", "K_L", "process_noise", *sensors, "coloured_sd", "coloured_time")


class LatentDensity:
    """Posterior of ``T_L`` [s], ``K_L`` [-] and the noise of every window (SPEC section 3, latent form).

    ``names`` is ``latent_names``; the density is in ``z = log(parameter)``. Even rows take the fast route, others the
    row-by-row filter; both give the same number. Gaps and unused rows split a window into runs, whose likelihoods add.
    """

    def __init__(self, data: LatentWindow, prior: Prior | None = None) -> None:
        self.data = data
        self.names = latent_names(accel=data.accel is not None, speed=data.speed is not None)
        self.prior = Joint(default_actuation_prior(), default_noise_prior(self.names[2:])) if prior is None else prior
        self._runs, self._owner = data.runs()
        self._even = _even_rows(self._runs)

    @property
    def windows(self) -> int:
        return self.data.windows

    def log_likelihood(self, z: Tensor) -> Tensor:
        """``z`` ``(..., window, parameter)``; returns ``(..., window)`` [nats]."""
        p = dict(zip(self.names, z[..., self._owner, :].exp().unbind(-1), strict=True))
        five = (p["T_L"], p["K_L"], p["process_noise"], p["coloured_sd"], p["coloured_time"])
        noise = {name: p[name] for name in ("accel_noise", "speed_noise", "road_noise") if name in p}
        if self._even is not None:
            per_run = steady_log_likelihood(*five, self._even, **noise)
        else:
            r = self._runs
            per_run = latent_log_likelihood(*five, r.time, r.u, accel=r.accel, speed=r.speed, mask=r.mask, **noise)
        if len(self._owner) == self.windows:
            return per_run
        return per_run.new_zeros(*per_run.shape[:-1], self.windows).index_add(-1, self._owner, per_run)

    def log_prob(self, z: Tensor) -> Tensor:
        return self.log_likelihood(z) + self.prior.log_prob(z)

    def initial(self) -> Tensor:
        """The best of a coarse grid over lag, gain and process noise, the rest at the prior's centre."""
        center = self.prior.center().expand(self.windows, len(self.names))
        lag = torch.tensor([0.1, 0.2, 0.4, 0.8, 1.6], dtype=torch.float64)
        gain = torch.tensor([0.5, 0.75, 1.0], dtype=torch.float64)
        rough = torch.tensor([0.02, 0.1, 0.5], dtype=torch.float64)
        grid = torch.cartesian_prod(lag, gain, rough).log()
        z = center.expand(len(grid), *center.shape).clone()
        z[..., :3] = grid[:, None, :]
        if self.data.speed is not None:
            z[..., self.names.index("speed_noise")] = _speed_noise(self._runs, self._owner, self.windows).log()
        with torch.no_grad():
            score = self.log_prob(z)
        best = torch.where(score.isfinite(), score, -torch.inf).argmax(0)
        return z[best, torch.arange(self.windows)]


def _even_rows(runs: LatentWindow) -> EvenRows | None:
    """The layout of the fast route, or None where some run is not even."""
    count = runs.mask.sum(-1)
    index = torch.arange(runs.time.shape[1], dtype=torch.float64)
    last = runs.time.gather(1, (count - 1)[:, None])
    dt = (last - runs.time[:, :1]) / (count - 1).clamp(min=1)[:, None]
    # A run of a single row has no step; any will do.
    dt = torch.where(count[:, None] > 1, dt, dt[count > 1].median() if bool((count > 1).any()) else torch.tensor(0.01))
    off = (runs.time - runs.time[:, :1] - dt * index).abs() * runs.mask
    if bool((off > EVEN * dt).any()):
        return None
    return EvenRows.build(dt[:, 0], runs.u, runs.mask, accel=runs.accel, speed=runs.speed)


def _speed_noise(runs: LatentWindow, owner: Tensor, windows: int) -> Tensor:
    """Rough speed noise [m/s] ``(window,)`` from second differences of the speed: a start, not an estimate."""
    assert runs.speed is not None
    bend = runs.speed.diff(n=2).abs() * runs.mask[:, 2:]
    rows = runs.mask[:, 2:].sum(-1).clamp(min=1)
    # Mean of abs(N(0, 6 r²)) is r sqrt(12/pi).
    each = bend.sum(-1) / rows / (12.0 / torch.pi) ** 0.5
    # A later run of a window overwrites an earlier one; any will do.
    return each.new_full((windows,), 0.01).index_copy(0, owner, each).clamp(1e-4, 1.0)
