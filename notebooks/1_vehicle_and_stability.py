# %% [markdown]
# # The vehicle and its stability
#
# An automated vehicle does not follow its command at once, nor in full: a lag `T_L` and a gain `K_L` lie between the
# command and the acceleration. This notebook shows the effect of both on one car, why a whole line of such cars may
# turn a tap on the brake into a jam, how to predict whether it will, and how certain the prediction is when `T_L` and
# `K_L` are estimated, not known.
#
# Pictures appear below their cells; run as a script, the notebook saves them and prints where.

# %%
from pathlib import Path

import matplotlib as mpl
import torch
from matplotlib.figure import Figure

import avtorch
from avtorch import plots, stability
from avtorch.display import show

mpl.rcParams.update(plots.STYLE)
OUT = Path("out/notebooks/1_vehicle_and_stability")
HEALTHY, WORN = (0.3, 1.0), (1.5, 0.5)  # T_L [s], K_L [-]
NOMINAL = (1.5, 1.5, -0.8)  # the paper's gains k_s [1/s²], k_v [1/s], k_a [-]

# %% [markdown]
# ## One car
#
# The vehicle follows `da/dt = -a/T_L + K_L/T_L u` (the paper's Eq. 1). Command 1 m/s² for six seconds, then nothing.

# %%
dt = 0.01
time = dt * torch.arange(1200)
command = torch.where((time >= 1) & (time < 7), 1.0, 0.0).double()
figure = Figure(figsize=(9, 3.2), layout="constrained")
ax = figure.subplots()
ax.step(time, command, color="0.5", where="post", label="command")
for (T, K), colour, name in ((HEALTHY, "#0072B2", "healthy"), (WORN, "#D55E00", "worn")):
    accel = avtorch.GLVD(T, K).rollout(torch.zeros((), dtype=torch.float64), command, dt).detach()
    ax.plot(time, accel, color=colour, label=f"{name}: T_L {T} s, K_L {K}")
    print(f"{name}: {float(accel[350]):.2f} m/s² after 2.5 s, {float(accel[699]):.2f} when the command ends")
ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
ax.legend()
plots.show(figure, OUT / "one_car.png")

# %% [markdown]
# The healthy car reaches the command within a second. The worn one takes several, and then realises only half of it.
# Both continue after the command has ended, for as long as they were late.
#
# ## A line of cars
#
# Now six such cars drive behind each other, each with the paper's controller: `u = k_s Δs + k_v Δv + k_a a`, where `Δs`
# is the spacing beyond that of the time gap, and `Δv` how much faster the car in front is. The leader slows from 20 to
# 19 m/s and speeds up again, once.

# %%
leader = avtorch.Leader.from_speed([0, 10, 12, 14, 16, 60], [20, 20, 19, 19, 20, 20], name="one slow-down")
dips = {}
figure = Figure(figsize=(9, 3.6), layout="constrained")
axes = figure.subplots(1, 2, sharey=True)
for ax, (T, K), name in zip(axes, (HEALTHY, WORN), ("healthy", "worn"), strict=True):
    line = avtorch.simulate(leader, plant=avtorch.GLVDPlant(T, K), vehicles=6)
    speed = line.speed[0]
    dips[name] = (20 - speed.amin(-1)).tolist()
    ax.plot(line.time, line.lead_speed[0, 0], color="0.5", label="leader")
    for k, v in enumerate(speed):
        ax.plot(line.time, v, color=mpl.colormaps["viridis"](k / 6), label={0: "first car", 5: "sixth car"}.get(k))
    ax.set(xlabel="time [s]", title=f"{name}: T_L {T} s, K_L {K}")
axes[0].set_ylabel("speed [m/s]")
axes[0].legend(loc="lower right")
plots.show(figure, OUT / "a_line_of_cars.png")
for name, dip in dips.items():
    print(f"{name}: the leader slows by {20 - float(leader.speed.min()):.2f} m/s", end=", the cars by ")
    print(*(f"{d:.2f}" for d in dip))

# %% [markdown]
# Left, every car slows a little less than the one in front: the disturbance dies out. Right, every car slows more than
# the one in front and overshoots afterwards: this is how a jam grows out of nothing. A line that does the former for
# every disturbance is *string stable*.
#
# ## The verdict without a drive
#
# How much of a slow or a quick wave of its leader's speed a car passes on is a function of frequency, `|G(jω)|`. String
# stable means that it nowhere exceeds one. Its highest value is the *peak gain*.

# %%
figure = Figure(figsize=(9, 3.2), layout="constrained")
omega = torch.logspace(-2, 1, 400, dtype=torch.float64)
peaks = {}
for ax, (T, K), name in zip(figure.subplots(1, 2, sharey=True), (HEALTHY, WORN), ("healthy", "worn"), strict=True):
    law = (T, K, 1.0, NOMINAL)  # lag, gain, time gap, gains
    peaks[name] = float(stability.peak_gain(*law))
    plots.gain_curve(ax, omega, stability.gain(omega, *law), peak=(float(stability.peak_frequency(*law)), peaks[name]))
    ax.set_ylim(0, 2.6)
    ax.set_title(f"{name}: string stable {bool(stability.string_stable(*law))}")
plots.show(figure, OUT / "gain.png")

# %% [markdown]
# The healthy car's curve never exceeds one. The worn car's waves grow wherever the curve is in the shaded part, most at
# the point: behind six cars a wave of that frequency has grown by the sixth power.

# %%
print(f"peak gain: healthy {peaks['healthy']:.3f}, worn {peaks['worn']:.4f}; sixth power {peaks['worn'] ** 6:.0f}")

# %% [markdown]
# ## The paper's condition and the exact verdict
#
# The paper tests string stability by two inequalities (its Eq. 3). They are *sufficient*: a car that meets them is
# string stable, one that does not may still be. avtorch also has the exact verdict. Here are both for the paper's own
# settings, with the car worn: the time gap it recommends, its gains, and a longer gap.

# %%
settings = {
    "healthy, as built": (*HEALTHY, 1.0, NOMINAL),
    "worn, as built": (*WORN, 1.0, NOMINAL),
    "worn, time gap 2 s": (*WORN, 2.0, NOMINAL),
    "worn, time gap 2.5 s": (*WORN, 2.5, NOMINAL),
    "worn, gains 3, 3, -1.8": (*WORN, 1.0, (3.0, 3.0, -1.8)),
}
print(f"{'':24}{'Eq. 3':>8}{'exact':>8}{'peak gain':>12}")
verdicts = {}
for name, law in settings.items():
    verdicts[name] = (bool(stability.string_sufficient(*law)), bool(stability.string_stable(*law)))
    eq3, exact = ("yes" if yes else "no" for yes in verdicts[name])
    print(f"{name:24}{eq3:>8}{exact:>8}{float(stability.peak_gain(*law)):>12.4f}")

# %% [markdown]
# Both of the paper's settings calm the worn car, and neither makes it string stable as long as only the upper level
# is changed. With 2.5 s the line is calm, yet Eq. 3 rejects it: a sufficient condition requires more than is
# necessary. How much more? Below, every point is a car, and the controller has a time gap of 2.5 s.

# %%
T_axis = torch.linspace(0.02, 2.5, 249, dtype=torch.float64)
K_axis = torch.linspace(0.3, 1.3, 201, dtype=torch.float64)
plane = stability.region(("T", T_axis), ("K", K_axis), time_gap=2.5)
eq3 = stability.region(("T", T_axis), ("K", K_axis), time_gap=2.5, form="print")
figure = Figure(figsize=(7, 5.2), layout="constrained")
ax = plots.region(figure.subplots(), plane, point=WORN)
ax.contourf(T_axis, K_axis, (eq3.string & eq3.local).double(), levels=[0.5, 1.5], colors="none", hatches=["///"])
plots.verdict_legend(ax)
ax.set_title("Hatched: what Eq. 3 passes. The dot: the worn car")
plots.show(figure, OUT / "sufficient_and_exact.png")
passed = float((eq3.string & eq3.local).double().mean())
print(f"string stable: {plane.string_share:.0%} of the cars; passed by Eq. 3: {passed:.0%}")
wrongly = int((eq3.string & eq3.local & ~plane.string).sum())
print("passed by Eq. 3 without being string stable:", wrongly)

# %% [markdown]
# The hatched area lies within the blue, as it must; the rest of the blue is what the sufficient condition misses.
#
# ## Which gains, which time gap
#
# The same question the other way round: given the car, which gains make it string stable? The rows are two time gaps,
# the columns two cars.

# %%
k = torch.linspace(0.05, 4, 160, dtype=torch.float64)
shares = {}
figure = Figure(figsize=(8.4, 8.0), layout="constrained")
axes = figure.subplots(2, 2, sharex=True, sharey=True)
for row, gap in zip(axes, (0.5, 2.0), strict=True):
    for ax, T in zip(row, (0.1, 1.0), strict=True):
        plane = stability.region(("k_s", k), ("k_v", k), T_L=T, K_L=1.0, time_gap=gap)
        shares[gap, T] = plane.string_share
        plots.region(ax, plane)
        ax.set_title(f"time gap {gap} s, T_L {T} s: {plane.string_share:.0%}")
        ax.label_outer()
plots.verdict_legend(axes[1, 0])
plots.show(figure, OUT / "gains.png")

# %% [markdown]
# The blue gains are string stable. A longer time gap makes the blue larger, a slower car makes it smaller: that is the
# paper's figure of stability regions. The share of the plane that is string stable stands over each picture.
#
# ## A delay is not a lag
#
# Real actuators also have dead time: for a moment nothing happens at all. It is tempting to simply add it to the lag.

# %%
dead = torch.linspace(0.0, 0.6, 121, dtype=torch.float64)
modelled = stability.peak_gain(0.3, 1.0, 1.0, NOMINAL, dead_time=dead)
lumped = stability.peak_gain(0.3 + dead, 1.0, 1.0, NOMINAL)
margin = float(stability.dead_time_margin(0.3, 1.0, 1.0, NOMINAL))
figure = Figure(figsize=(8, 3.6), layout="constrained")
ax = figure.subplots()
ax.plot(dead, modelled, color="#0072B2", label="dead time modelled as such")
ax.plot(dead, lumped, color="#D55E00", linestyle="--", label="dead time added to the lag")
ax.axvline(margin, color="0.5", linestyle=":", label=f"oscillates by itself from {margin:.2f} s on")
ax.set(xlabel="dead time [s]", ylabel="peak gain [-]", ylim=(0.9, 4))
ax.legend()
plots.show(figure, OUT / "dead_time.png")
at = (0.3, 1.0, 1.0, NOMINAL)
peak_04 = float(stability.peak_gain(*at, dead_time=0.4))
lumped_04 = float(stability.peak_gain(0.7, *at[1:]))
print(f"lag 0.3 s and dead time 0.4 s: peak gain {peak_04:.4f}; lag 0.7 s instead: {lumped_04:.4f}")

# %% [markdown]
# Both curves start on the same line, and for small delays the difference does not matter. Then the true curve rises,
# while the lumped one stays at one: false comfort.
#
# ## When the car is only estimated
#
# A controller does not know `T_L` and `K_L`. Let the worn car follow a leader who drives off, and estimate them from
# two seconds of its log, as draws from the posterior. The share of the draws that are string stable is the
# probability that the line is.

# %%
drive = avtorch.simulate(avtorch.Leader.default(start=48.0), plant=avtorch.GLVDPlant(*WORN, sigma=0.3), duration=4.0)
belief = avtorch.estimate(drive.log(), window=2.0).windows[-1].window.belief
show(belief)
T_L, K_L = belief.draws[:, 0, 0], belief.draws[:, 0, 1]
mean = (float(T_L.mean()), float(K_L.mean()))
gaps = torch.linspace(1.0, 4.0, 301, dtype=torch.float64)
p = stability.p_string_stable(T_L, K_L, gaps, NOMINAL)
at_mean = stability.string_stable(*mean, gaps, NOMINAL)
enough, hoped = float(gaps[p >= 0.95][0]), float(gaps[at_mean][0])

figure = Figure(figsize=(9.6, 4.6), layout="constrained")
left, right = figure.subplots(1, 2)
plots.region(left, stability.region(("T", T_axis), ("K", K_axis), time_gap=hoped), point=mean)
left.plot(T_L[:1500], K_L[:1500], ".", color="0.35", markersize=2, alpha=0.4, zorder=1.5)
left.set_title(f"the belief, at a time gap of {hoped:.2f} s")
right.plot(gaps, p, color="#0072B2", label="P(string stable)")
right.step(gaps, at_mean.double(), color="#D55E00", linestyle="--", where="post", label="at the mean of the belief")
right.axhline(0.95, color="0.5", linestyle=":")
right.set(xlabel="time gap [s]", ylim=(-0.03, 1.05))
right.legend()
plots.show(figure, OUT / "belief.png")
print(f"at the mean ({mean[0]:.2f} s, {mean[1]:.2f}) a time gap of {hoped:.2f} s would do,")
print(f"where P(string stable) is {float(p[gaps == hoped][0]):.2f}; to be 95 % sure takes {enough:.2f} s.")

# %% [markdown]
# The cloud on the left is the belief, the large dot its mean, just inside the blue. Much of the cloud lies outside: a
# choice by the mean alone is about as likely wrong as right. The step on the right is that gamble; the curve shows what
# certainty costs.
#
# ## Try this
#
# - Take eight seconds instead of two (`duration=8.0`, `window=8.0`): how far do the two time gaps come together?
# - Give the controller a feed-forward gain on the leader's acceleration: `stability.peak_gain(..., feedforward=0.5)`,
#   here and in `p_string_stable`.
# - Add `dead_time=0.2` to the last cell's probabilities.
# - Test a box of cars at once: `stability.string_sufficient((0.1, 0.4), (0.7, 1.0), 1.0, NOMINAL, form="rigorous")`.
