"""An amortised neural posterior of one window beside the estimators that evaluate its likelihood.

A mixture density network (`sbi`'s, for NPE) learns the posterior of ``z = log(T_L, K_L, sigma)`` from windows simulated
under the default prior, once from the six sums (as least squares gives them, which is the same information) and once
from the rows, through a small convolutional network. Every method then gets the same windows and the same prior.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.inference import JerkStatistics, Posterior, integrate, sample
from avtorch.inference.priors import Joint, default_actuation_prior, default_jerk_noise_prior
from avtorch.validation.windows import simulate_windows
from benchmarks.estimators import CHANGE_S, drive
from benchmarks.peers.own import density_of
from benchmarks.peers.problem import Windows
from benchmarks.rank_calibration import RankCalibration

ROWS, DRAWS = 200, 1000
BATCH = 40  # windows at once
PRIOR = Joint(default_actuation_prior(), default_jerk_noise_prior())


def commands(windows: int, rows: int, dt: float, g: torch.Generator) -> Tensor:
    """Three sines a window of 0.3 to 8 rad/s, the largest of 0.1 to 2 m/s², random phases, ``(window, time)``."""
    low, high = np.log([0.3, 8.0])
    rate = (low + (high - low) * torch.rand(3, windows, 1, generator=g, dtype=torch.float64)).exp()
    phase = 2 * torch.pi * torch.rand(3, windows, 1, generator=g, dtype=torch.float64)
    size = 0.1 * 20 ** torch.rand(windows, 1, generator=g, dtype=torch.float64)
    share = torch.tensor([1.0, 0.6, 0.4], dtype=torch.float64)[:, None, None]
    return size * (share * torch.sin(rate * dt * torch.arange(rows, dtype=torch.float64) + phase)).sum(0)


def simulated(z: Tensor, g: torch.Generator, *, rows: int = ROWS, dt: float = 0.01) -> Windows:
    """One window of every vehicle ``z``, ``(window, 3)``."""
    u = commands(len(z), rows, dt, g)
    a, jerk = simulate_windows(z, u, dt=dt, generator=g)
    return Windows(a.numpy(), u.numpy(), jerk.numpy(), z.exp().numpy())


def prior_windows(count: int, seed: int) -> Windows:
    g = torch.Generator().manual_seed(seed)
    return simulated(PRIOR.sample(1, count, generator=g)[0], g)


def from_sums(windows: Windows) -> Tensor:
    """Least squares of jerk on ``(-a, u)``: estimates, noise, standard errors and their correlation; the six sums."""
    sums = JerkStatistics.from_samples(*(torch.from_numpy(x) for x in (windows.a, windows.u, windows.jerk)))
    rate, gain, noise = sums.least_squares()
    det = (sums.aa * sums.uu - sums.au.square()).clamp_min(1e-12 * sums.aa * sums.uu)
    errors = [0.5 * (noise.square() * x / det).log() for x in (sums.uu, sums.aa)]
    together = torch.atanh((sums.au / (sums.aa * sums.uu).sqrt()).clamp(-1 + 1e-9, 1 - 1e-9))
    return torch.stack([*(torch.asinh(x / 0.1) for x in (rate, gain)), noise.log(), *errors, together], -1).float()


def from_rows(windows: Windows) -> Tensor:
    """The rows, ``(window, 3, time)``, on scales of their own, with the logarithms of these."""
    rows = torch.from_numpy(np.stack([windows.a, windows.u, windows.jerk], 1))
    size = rows.square().mean(-1, keepdim=True).sqrt()
    return torch.cat([rows / size, size.log().expand_as(rows)], 1).float()


class RowsNetwork(nn.Module):
    """Convolutions with a stride, mean and mean square over time beside the logarithms of the scales; 32 features."""

    def __init__(self) -> None:
        super().__init__()
        self.along = nn.Sequential(
            nn.Conv1d(3, 16, 8, stride=4), nn.GELU(), nn.Conv1d(16, 32, 5, stride=2), nn.GELU(), nn.Conv1d(32, 32, 3)
        )
        self.out = nn.Sequential(nn.Linear(32 * 2 + 3, 64), nn.GELU(), nn.Linear(64, 32))

    def forward(self, x: Tensor) -> Tensor:
        seen = self.along(x[:, :3])
        return self.out(torch.cat([seen.mean(-1), seen.square().mean(-1), x[:, 3:, 0]], -1))


@dataclass
class Amortised:
    """A trained flow: windows in, draws out; what its training took."""

    features: Callable[[Windows], Tensor]
    flow: nn.Module
    train_s: float
    epochs: int
    weights: int

    def draws(self, windows: Windows) -> Tensor:
        """``(draw, window, 3)`` in the parameters' own units."""
        with torch.no_grad():
            return self.flow.sample((DRAWS,), condition=self.features(windows)).double().exp()


def train(kind: str, *, windows: int, seed: int, epochs: int) -> Amortised:
    """Train on `windows` simulated ones; `kind` is ``"sums"`` or ``"rows"``.

    The estimator is sbi's; the loop is not, because its loader collates the windows one by one and takes ten times as
    long as the network.
    """
    try:
        from sbi.neural_nets import posterior_nn
    except ImportError as error:
        raise InputError("sbi: not installed; needs pip install 'avtorch[bench]'") from error
    made = prior_windows(windows, seed)
    features = from_sums if kind == "sums" else from_rows
    x, z = features(made), torch.from_numpy(np.log(made.truth)).float()
    g = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    embed, scale_x = (nn.Identity(), "independent") if kind == "sums" else (RowsNetwork(), "none")
    begun = time.process_time()
    flow = posterior_nn(
        "mdn",
        hidden_features=128,
        num_components=4,
        embedding_net=embed,
        z_score_x=scale_x,
        z_score_theta="independent",
    )(z, x)
    optimizer = torch.optim.Adam(flow.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    for _ in range(epochs):
        for some in torch.randperm(windows, generator=g).split(500):
            optimizer.zero_grad()
            loss = flow.loss(z[some], condition=x[some]).mean()
            loss.backward()
            nn.utils.clip_grad_norm_(flow.parameters(), 5.0)
            optimizer.step()
        schedule.step()
    spent = time.process_time() - begun
    return Amortised(features, flow.eval(), spent, epochs, sum(p.numel() for p in flow.parameters()))


def domains(count: int, seed: int) -> dict[str, Windows]:
    """Windows within and off the range of training, by name."""
    g = torch.Generator().manual_seed(seed)

    def of(T_L: float, K_L: float, sigma: float, **how: float) -> Windows:
        z = torch.tensor([T_L, K_L, sigma], dtype=torch.float64).log().expand(count, 3)
        return simulated(z, g, **how)  # pyright: ignore[reportArgumentType]

    block = drive(max(1, count // 4), first_seed=seed)
    cut = {"closed loop, healthy": (2.0, CHANGE_S), "closed loop, worn (1.5 s, 0.5)": (CHANGE_S, 80.0)}
    found = {"the prior's": prior_windows(count, seed + 1)}
    for name, (begin, end) in cut.items():
        steps = range(round(begin * 100), round(end * 100) - ROWS + 1, ROWS)
        parts = [[getattr(block, c)[:, k : k + ROWS] for k in steps] for c in ("accel", "accel_cmd", "jerk")]
        a, u, jerk = (torch.cat(x).numpy() for x in parts)
        truth = (0.3, 1.0, 0.1) if "healthy" in name else (1.5, 0.5, 0.1)
        lively = np.flatnonzero((u.std(-1) > 0.1) & (np.abs(a).min(-1) > 0))[:count]
        found[name] = Windows(a[lively], u[lively], jerk[lively], np.tile(truth, (len(lively), 1)))
    return found | {
        "lag of 4 s, gain 0.3": of(4.0, 0.3, 0.1),
        "jerk noise of 5 m/s³": of(0.3, 1.0, 5.0),
        "50 Hz, 100 rows": of(0.3, 1.0, 0.1, rows=100, dt=0.02),
        "5 s, 500 rows": of(0.3, 1.0, 0.1, rows=500),
    }


@dataclass
class Told:
    """Means and SDs ``(window, 2)`` of T_L and K_L, the 90 % interval, and draws where there are some."""

    mean: FloatArray
    sd: FloatArray
    low: FloatArray
    high: FloatArray
    draws: Tensor | None = None

    @classmethod
    def of_draws(cls, draws: Tensor) -> Told:
        low, high = np.quantile(draws[..., :2].numpy(), [0.05, 0.95], axis=0)
        return cls(draws.mean(0)[:, :2].numpy(), draws.std(0)[:, :2].numpy(), low, high, draws)

    @classmethod
    def of_moments(cls, mean: FloatArray, sd: FloatArray) -> Told:
        mean, sd = mean[:, :2], sd[:, :2]
        return cls(mean, sd, mean - 1.645 * sd, mean + 1.645 * sd)


Method = Callable[[Windows], Told]


def sgld(windows: Windows) -> Told:
    found: Posterior = sample(density_of(windows), generator=torch.Generator().manual_seed(0))
    return Told.of_draws(found.draws.flatten(0, -3))


def nuts() -> Method:
    """BlackJAX NUTS with window adaptation, all windows in one XLA program."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from benchmarks.peers.blackjax_nuts import Runner

    runner = Runner({"chains": 1, "warmup": 300, "draws": DRAWS})

    def run(windows: Windows) -> Told:
        found = runner.run(windows, 0).draws
        assert found is not None
        return Told.of_draws(torch.from_numpy(np.array(found)).flatten(0, 1))

    return run


def by_window(module: str) -> Method:
    """A filter of the peers, window after window."""
    from importlib import import_module

    runner = import_module(f"benchmarks.peers.{module}").Runner({})

    def run(windows: Windows) -> Told:
        each = [runner.run(windows.select(slice(k, k + 1)), 0) for k in range(len(windows))]
        return Told.of_moments(np.concatenate([x.mean for x in each]), np.concatenate([x.sd for x in each]))

    return run


def exact(windows: Windows) -> Told:
    parts = [integrate(density_of(windows.select(slice(k, k + 10))), nodes=31) for k in range(0, len(windows), 10)]
    levels = [np.concatenate([p.quantile(q)[:, :2].numpy() for p in parts]) for q in (0.05, 0.95)]
    moments = [np.concatenate([getattr(p, name)[:, :2].numpy() for p in parts]) for name in ("mean", "sd")]
    return Told(moments[0], moments[1], levels[0], levels[1])


def cost(method: Method, windows: Windows, *, repeats: int = 2) -> float:
    """Processor milliseconds a window, the least of some calls."""
    spent = []
    for _ in range(repeats + 1):  # the first one compiles
        begun = time.process_time()
        method(windows)
        spent.append(time.process_time() - begun)
    return 1e3 * min(spent[1:]) / len(windows)


def compare(*, trained: int = 40_000, epochs: int = 20, replications: int = 360, seed: int = 0) -> None:
    """Print the tables: training, accuracy by kind of window, calibration, time to answer."""
    torch.set_num_threads(1)
    flows = {f"NPE, {kind}": train(kind, windows=trained, seed=seed, epochs=epochs) for kind in ("sums", "rows")}
    for name, flow in flows.items():
        print(f"{name}: {flow.train_s:.0f} s of one core, {flow.epochs} epochs, {flow.weights} weights", flush=True)
    methods: dict[str, Method] = {
        **{name: lambda w, flow=flow: Told.of_draws(flow.draws(w)) for name, flow in flows.items()},
        "SGLD": sgld,
        "NUTS (BlackJAX)": nuts(),
        "UKF": by_window("ukf"),
        "RLS": by_window("rls"),
    }
    tested = domains(BATCH, seed + 100)
    truth = {name: exact(windows) for name, windows in tested.items()}
    print("\n| windows | " + " | ".join([*methods, "quadrature"]) + " |\n|---|" + "---:|" * (len(methods) + 1))
    for name, windows in tested.items():
        cells = [_cell(_answer(m, windows), truth[name], windows) for m in methods.values()]
        print(f"| {name} ({len(windows)}) | " + " | ".join([*cells, _cover(truth[name], windows)]) + " |", flush=True)
    print(f"\n| method | SBC p-value | coverage of 90 %: T_L, K_L, sigma | ms a window: one | {BATCH} at once |")
    print("|---|---:|---:|---:|---:|")
    windows = prior_windows(replications, seed + 200)
    parts = [windows.select(slice(k, k + BATCH)) for k in range(0, replications, BATCH)]
    density, z = density_of(windows), torch.from_numpy(np.log(windows.truth))
    for name, method in methods.items():
        told = [method(part) for part in parts]
        if told[0].draws is None:
            whole = Told(*(np.concatenate([getattr(t, x) for t in told]) for x in ("mean", "sd", "low", "high")))
            p, cover = "-", _cover(whole, windows)
        else:
            ranks = RankCalibration.of(density, z, torch.cat([t.draws for t in told if t.draws is not None], 1))
            p, cover = f"{ranks.p_value:.2g}", " / ".join(f"{100 * x:.1f}" for x in ranks.coverage[0.9][:3].tolist())
        times = [cost(method, windows.select(slice(0, n))) for n in (1, BATCH)]
        print(f"| {name} | {p} | {cover} | {times[0]:.3g} | {times[1]:.3g} |", flush=True)
    print(f"| quadrature | - | - | {cost(exact, windows.select(slice(0, 1))):.3g} | - |", flush=True)


def _answer(method: Method, windows: Windows) -> Told | None:
    """None where a network cannot take windows of this length."""
    try:
        return method(windows)
    except ValueError:
        return None


def _cover(told: Told, windows: Windows) -> str:
    inside = (told.low <= windows.truth[:, :2]) & (windows.truth[:, :2] <= told.high)
    return " / ".join(f"{100 * x:.0f}" for x in inside.mean(0))


def _cell(told: Told | None, truth: Told, windows: Windows) -> str:
    """Distance of the mean of T_L from the exact one [exact SD], median and 95 %, and coverage of the truth [%]."""
    if told is None:
        return "refused"
    away = np.quantile(np.abs(told.mean - truth.mean)[:, 0] / truth.sd[:, 0], [0.5, 0.95])
    return f"{away[0]:.2f}, {away[1]:.2f}; {_cover(told, windows)}"
