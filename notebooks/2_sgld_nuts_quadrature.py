# %% [markdown]
# # SGLD, NUTS and quadrature on one window
#
# avtorch estimates by SGLD: gradient descent with just enough noise that it samples a posterior instead of sinking to
# its mode. You will write that loop yourself around a `torch.optim` optimizer and compare its draws with two
# independent references, Pyro's NUTS and exact quadrature. Then you will spoil them on purpose: with a step that is
# too long, with minibatches, and with the paper's falling step.

# %%
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.figure import Figure

import avtorch
from avtorch import plots
from avtorch.display import show
from avtorch.inference import JerkPoints, find_mode, integrate, sample

mpl.rcParams.update(plots.STYLE)
OUT = Path("out/notebooks/2_sgld_nuts_quadrature")
TRUE = {"T_L": 0.7, "K_L": 0.7, "sigma": 0.1}  # s, -, m/s³

# %% [markdown]
# ## One window
#
# Two seconds of a drive at 100 Hz, those with the most varied command: command, acceleration and jerk. The posterior
# rests on these alone.

# %%
car = avtorch.GLVDPlant(TRUE["T_L"], TRUE["K_L"], sigma=TRUE["sigma"])
drive = avtorch.simulate(avtorch.Leader.default(start=48.0), plant=car, duration=30.0)
liveliest = int(drive.accel_cmd[0, 0].unfold(0, 200, 1).std(-1).argmax())
rows = slice(liveliest, liveliest + 200)
a, u, jerk = (x[0, 0, rows][None] for x in (drive.accel, drive.accel_cmd, drive.jerk))  # (window, time)

figure = Figure(figsize=(9, 3.2), layout="constrained")
left, right = figure.subplots(1, 2)
left.plot(drive.time[rows], u[0], color="0.5", label="command u")
left.plot(drive.time[rows], a[0], color="#0072B2", label="acceleration a")
right.plot(drive.time[rows], jerk[0], ".", color="#0072B2", markersize=3)
left.set(xlabel="time [s]", ylabel="m/s²")
right.set(xlabel="time [s]", ylabel="jerk [m/s³]")
left.legend()
plots.show(figure, OUT / "window.png")

# %% [markdown]
# On the right is what the likelihood explains: `jerk = (K_L u - a) / T_L` plus noise of `sigma` (the paper's Eq. 4).
# Two similar columns, `a` and `u`, have to separate `T_L` from `K_L`. So their posterior is strongly
# correlated, and a sampler needs a preconditioner.
#
# ## SGLD by hand
#
# One log density serves all samplers. It lives in `z = log(T_L, K_L, sigma)`. The mode and the curvature there turn the
# narrow, slanted posterior into a round one of width about one, in which a single step length fits all directions. The
# rest is a training loop. 256 chains run at once, as rows of one tensor.

# %%
density = JerkPoints(a, u, jerk)
mode = find_mode(density)


def z_of(w: torch.Tensor) -> torch.Tensor:
    """From the round coordinates (chain, window, 3) to log parameters."""
    return mode.z + (mode.scale @ w[..., None])[..., 0]


def walk(h: float, noise: str = "averaged", batch: int | None = None, steps: int = 300, seed: int = 1) -> torch.Tensor:
    """Draws (step, chain, parameter) of SGLD with step h, from the whole window or from a batch of its points."""
    generator = torch.Generator().manual_seed(seed)
    w = torch.zeros(256, 1, 3, dtype=torch.float64, requires_grad=True)
    optimizer = avtorch.SGLD([w], lr=h, noise=noise, generator=generator)
    burn_in, kept = round(40 / h), []
    for step in range(burn_in + steps):
        optimizer.zero_grad()
        if batch is None:
            potential = -density.log_prob(z_of(w)).sum()  # over chains, on the scale of the whole window
        else:
            points = torch.randint(density.points, (batch,), generator=generator)
            potential = -density.log_prob_minibatch(z_of(w), points).sum()
        potential.backward()
        optimizer.step()
        if step >= burn_in:
            kept.append(z_of(w.detach()).exp())
    return torch.stack(kept)[:, :, 0]


mine = walk(1.0)
for i, name in enumerate(density.names):
    print(f"{name}: {float(mine[..., i].mean()):.4f} ± {float(mine[..., i].std()):.4f}, true {TRUE[name]}")

# %% [markdown]
# None of this is special to cars: `avtorch.SGLD` takes any parameter of any torch model. If you do not want to write
# the loop, `sample` runs it, and handles burn-in, step lengths and chains that diverge:

# %%
posterior = sample(density, generator=torch.Generator().manual_seed(1))
show(posterior)
print(tuple(posterior.draws.shape), "(chain, draw, window, parameter)")

# %% [markdown]
# ## Two references
#
# Quadrature sums the density on a grid, which three parameters allow: exact to many digits. NUTS is another sampler,
# written by others (Pyro), of the same density; it needs `pip install 'avtorch[nuts]'`.

# %%
exact = integrate(density)
try:
    from avtorch.inference.nuts import nuts
except ImportError:
    print("Pyro is not installed; the pictures below are without NUTS")
    reference = None
else:
    reference = nuts(density, chains=2, draws=600, warmup=200, seed=1)

figure = Figure(figsize=(9.6, 3.4), layout="constrained")
for ax, name in zip(figure.subplots(1, 3), density.names, strict=True):
    plots.marginals(ax, name, posterior[name], None if reference is None else reference[name], exact, truth=TRUE[name])
figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=4)
plots.show(figure, OUT / "marginals.png")

print(f"{'':8}{'mean':>10}{'SD':>10}   error of the mean [SD], SD ratio: {'SGLD':>14}{'by hand':>18}{'NUTS':>18}")
samplers = {"SGLD": posterior.flat[:, 0], "by hand": mine.flatten(0, 1)}
if reference is not None:
    samplers["NUTS"] = reference.flat[:, 0]
off = {}
for i, name in enumerate(density.names):
    mean, sd = exact.mean[0, i], exact.sd[0, i]
    off[name] = {s: (float((x[:, i].mean() - mean) / sd), float(x[:, i].std() / sd)) for s, x in samplers.items()}
    errors = "".join(f"{m:>+10.3f}, {r:.3f} " for m, r in off[name].values())
    print(f"{name:8}{float(mean):>10.4f}{float(sd):>10.4f}{'':35}{errors}")

# %% [markdown]
# Grey is exact, blue is SGLD, the dashed line NUTS, the dotted one the truth. The three lie on top of each other, and
# the table shows how closely: means within a few hundredths of an SD, widths within a few per cent, NUTS's within ten.
# That is the Monte Carlo error of so many draws; NUTS has the fewest, and of sigma they count as a quarter.
#
# ## The price of a step
#
# SGLD accepts every step, so a constant step leaves a bias: the draws come out too wide. On a round Gaussian the SD is
# too large by `1/sqrt(1 - h/4)`. Averaging each noise with the next one cures that.

# %%
steps = [0.2, 0.5, 1.0, 1.5, 2.0, 2.5]
ratio = {}
for noise in ("independent", "averaged"):
    for h in steps:
        ratio[noise, h] = (walk(h, noise).flatten(0, 1).std(0) / exact.sd[0]).tolist()

figure = Figure(figsize=(8, 3.6), layout="constrained")
ax = figure.subplots()
fine = np.linspace(0, 2.6, 100)
ax.plot(fine, 1 / np.sqrt(1 - fine / 4), color="0.5", linestyle=":", label="independent, by the formula")
for noise, colour in (("independent", "#D55E00"), ("averaged", "#0072B2")):
    lines = ax.plot(steps, [ratio[noise, h] for h in steps], "o-", color=colour, linewidth=0.8, markersize=4)
    lines[0].set_label(f"{noise} noise, three parameters")
ax.set(xlabel="step h", ylabel="SD over the exact one")
ax.legend()
plots.show(figure, OUT / "step.png")
for noise in ("independent", "averaged"):
    print(f"{noise}: SD ratios", *(f"{x:.3f}" for x in ratio[noise, 0.2]), "at h = 0.2,", end=" ")
    print(*(f"{x:.3f}" for x in ratio[noise, 2.0]), "at h = 2")

# %% [markdown]
# With independent noise the width grows with the step as the formula predicts. With averaged noise it stays at one, so
# avtorch can afford long steps.
#
# ## The price of a minibatch
#
# "Stochastic gradient" means that each step uses a few points of the window. The gradient is then right on average,
# but its noise enters the draws. The law, again for a round Gaussian: batches of `n` out of `N` points multiply the
# variance by `1 + h N/(4 n)`.

# %%
h, batches = 0.3, [10, 20, 50, 100, 200]
drawn = {n: walk(h, "independent", batch=n, steps=400).flatten(0, 1) for n in batches}
wide = {n: (x.std(0) / exact.sd[0]).tolist() for n, x in drawn.items()}

figure = Figure(figsize=(9.6, 3.6), layout="constrained")
left, right = figure.subplots(1, 2)
lines = left.plot(batches, list(wide.values()), "o-", color="#D55E00", linewidth=0.8, markersize=4)
lines[0].set_label("as drawn, three parameters")
fine = np.linspace(9, 210, 200)
left.plot(fine, np.sqrt((1 + h * 200 / fine / 4) / (1 - h / 4)), ":", color="0.5", label="by the formula")
left.axhline(1, color="0.5", linewidth=0.8)
left.set(xscale="log", xlabel="points in a batch, of 200", ylabel="SD over the exact one")
left.set_xticks(batches, [str(n) for n in batches])
left.minorticks_off()
left.legend()
plots.marginals(right, "T_L", drawn[10][:, 0], None, exact, truth=TRUE["T_L"])
right.set_title("batches of 10")
plots.show(figure, OUT / "minibatch.png")
print("widest SD ratio by batch:", ", ".join(f"{n}: {max(x):.2f}" for n, x in wide.items()))

# %% [markdown]
# Ten points at a time make the posterior much too wide, as the formula predicts. Windows of a few hundred points gain
# nothing from minibatches: the whole window's likelihood is six sums, whatever its length, so avtorch uses all points
# in every step.
#
# ## A step that falls too fast
#
# The paper lets the step fall as `eta/k`. Any `torch.optim.lr_scheduler` will do; here are that one and a slower one.
# All chains start at the mode. How wide do they get?

# %%
falls = {"1 / k": lambda k: 1 / (k + 1), "(1 + k/100)^(-1/3)": lambda k: (1 + k / 100) ** (-1 / 3)}
widths = {}
for name, factor in falls.items():
    w = torch.zeros(256, 1, 3, dtype=torch.float64, requires_grad=True)
    optimizer = avtorch.SGLD([w], lr=1.0, generator=torch.Generator().manual_seed(4))
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    path = []
    for _ in range(1000):
        optimizer.step(lambda w=w: -density.log_prob(z_of(w)))  # a closure: the step differentiates it itself
        scheduler.step()
        path.append(w.detach()[:, 0].clone())
    walked = torch.stack(path)  # (step, chain, coordinate)
    widths[name] = walked[400:].std(0).mean().item()

figure = Figure(figsize=(9, 3.2), layout="constrained")
ax = figure.subplots()
for (name, width), colour in zip(widths.items(), ("#D55E00", "#0072B2"), strict=True):
    ax.barh(name, width, color=colour)
    ax.text(width + 0.01, name, f"{width:.2f}", va="center")
ax.axvline(1, color="0.5", linestyle=":")
ax.set(xlabel="SD within a chain over the posterior's, steps 400 to 1000", xlim=(0, 1.2))
plots.show(figure, OUT / "falling_step.png")

# %% [markdown]
# With `1/k` the chains freeze: after 1000 steps each has covered only a part of the posterior, and an estimate from one
# such chain would be overconfident. With the slower fall they keep moving.
#
# ## Try this
#
# - `temperature=0.0` in `walk`'s optimizer: the noise is gone and SGLD is gradient descent. Where do the chains end?
# - Take the two seconds of the most constant command (`argmin` for `argmax`). The gain is now known much better than
#   before, although nothing happens. Why?
# - `sample(density, SamplerSettings(whitening="none", attempts=1))`, with `SamplerSettings` from `avtorch.inference`:
#   how wide are the draws without the curvature? Does `converged` notice?
# - `avtorch validate --synthetic --windows 24 --out out/validate` does this comparison over many windows.
