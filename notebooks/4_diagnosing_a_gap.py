# %% [markdown]
# # Diagnosing a sim-to-real gap
#
# A simulator and a car disagree. Which effect does the simulator lack? You will draw a drive of a reference vehicle
# that shares no code with the diagnosis, with one hidden effect. You will diagnose it from its log alone, see where
# the gap lies, how far it shrinks and which manoeuvre would separate the remaining hypotheses, drive that manoeuvre,
# and only then reveal the truth. At the end the repaired simulator drives.

# %%
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import avtorch
from avtorch import plots
from avtorch.display import show
from avtorch.experiment import Limits, next_experiment
from avtorch.gap import plant
from avtorch.plots import diagnosis as over_diagnosis
from benchmarks.blindtest import Recorded, draw_cases, simulate
from benchmarks.golden.simulated import DRAWN

mpl.rcParams.update(plots.STYLE)
OUT = Path("out/notebooks/4_diagnosing_a_gap")

# %% [markdown]
# ## A sealed case
#
# The first case of set 2026 with a single effect of medium strength, over a minute, drawn from the table but for the
# two effects that joined it last. Other seeds hold other cases; a diagnosis gets some of them wrong, and
# [how often](../docs/diagnosis.md#how-well-it-does) is counted on sealed cases.

# %%
case = next(draw_cases(1, 2026, mix={"single": 1.0}, tiers=["medium"], effects=DRAWN, seconds=60.0))
log = case.log()
show(log)

figure = Figure(figsize=(9, 3.4), layout="constrained")
ax = figure.subplots()
ax.plot(log.time, log.accel, color="#0072B2", linewidth=0.8, label="measured")
ax.step(log.time, log.accel_cmd, color="0.3", linewidth=0.9, where="post", label="command")
ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
plots.show(figure, OUT / "log.png")

# %% [markdown]
# No one could name an effect by eye here. The measurement is noisy, and lag and gain are unknown as well.
#
# ## The diagnosis
#
# Every effect of the table is fitted, alone and in pairs, together with `T_L` and `K_L`.

# %%
found = avtorch.diagnose(log)
show(found)

# %%
print(found)
print()
for candidate in found.candidates[:6]:
    sizes = ", ".join(f"{k} {q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})" for k, q in candidate.parameters.items())
    print(f"  {candidate.name:22} {candidate.probability:.3f}  {sizes}")
plots.show(over_diagnosis.which_figure(found), OUT / "which.png")

# %% [markdown]
# Shown, a diagnosis is its verdict and the car's parameters; printed, it is all that was found. In the picture, blue
# bars are the hypotheses that this log cannot distinguish. `unknown` means that the cause is not in the table. It is
# always a hypothesis; where it comes first, the diagnosis names no effect. Here one is named, by a little: a minute is
# short.
#
# ## Where the gap lies

# %%
plots.show(over_diagnosis.road_figure(found), OUT / "road.png")

# %% [markdown]
# The stretch that tells most, as measured, by the baseline simulator, and by the simulator with the cause that is
# named.
#
# ## The next experiment
#
# More than one hypothesis is left. Each predicts another response to a manoeuvre; which manoeuvre separates them best?

# %%
ahead = next_experiment(found, Limits(seconds=60.0))
if ahead is None:
    print("one hypothesis is left")
    both = found
else:
    show(ahead)
    m = ahead.manoeuvre
    rate = case.drive.rate_hz
    times = np.arange(0.0, m.time[-1], 1 / rate)
    command = m.command[np.searchsorted(m.time, times + 1e-9, side="right") - 1]
    # the same car with the same sealed cause, driven open loop; a change of gain would have happened before
    cause = {k: {**v, "change_s": 0.0} if "change_s" in v else v for k, v in case.parameters.items()}
    run = simulate(
        case.car,
        Recorded(command, start_speed=float(m.speed[0])),
        seconds=len(command) / rate,
        rate_hz=rate,
        effects=cause,
        seed=1,
    )
    second = avtorch.Log.from_arrays(
        name="manoeuvre", time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed
    )
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    ax = figure.subplots()
    ax.plot(run.time, run.accel, color="#0072B2", linewidth=0.8, label="measured")
    ax.step(m.time, m.command, color="0.3", linewidth=0.9, where="post", label=f"command: {m.name}")
    ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    plots.show(figure, OUT / "manoeuvre.png")
    both = avtorch.diagnose([log, second])
    print(both.verdict.why)
    print("not distinguished:", ", ".join(both.verdict.alias_set))

# %% [markdown]
# Both drives are diagnosed together. The effect stays named, by a little less than before: brakes that are weaker than
# the drive are the next likeliest now. What the manoeuvre tells is the car: the intervals of lag and gain, below, are a
# third narrower.

# %%
plots.show(over_diagnosis.where_figure(both), OUT / "where.png")

# %% [markdown]
# How the effect (blue) and the drives (grey) are distributed over time, speed and command. A part of the time, the
# speeds or the commands is named (and shaded) only where it holds nearly all of the effect in far fewer rows.

# %%
scores = both.shrinkage
if scores is not None:
    top = scores.top
    print(f"{scores.metric}: {top.before:.3g} baseline, {top.after:.3g} with the effect, {top.floor:.3g} noise floor")
    if top.closed is not None:
        closed = f"{top.closed.mean:.0%} ({top.closed.q05:.0%} to {top.closed.q95:.0%})"
        print(f"closed {closed} of the reducible gap, on held-out rows")
    plots.show(over_diagnosis.shrinkage_figure(both), OUT / "shrinkage.png")

# %% [markdown]
# Free runs on held-out parts of the drives. Orange is the baseline simulator, blue the repaired one, light blue the
# noise floor. Grey is the baseline with a black box, which learns what it can from the rest of the drives.
#
# ## The truth

# %%
print("the hidden cause:", case.truth_name, {k: dict(v) for k, v in case.parameters.items()})
print("from" if case.onset_s else "", f"{case.onset_s:.1f} s on" if case.onset_s else "from the start")
print(f"the car: T_L {case.car.T_L:.3f} s, K_L {case.car.K_L:.3f}")
for name, answer in (("first drive", found), ("both drives", both)):
    fitted = {k: answer.winner.moved[k] for k in ("T_L", "K_L")} if answer.winner.moved else answer.baseline
    sizes = ", ".join(f"{k} {q.mean:.3f} ({q.q05:.3f} to {q.q95:.3f})" for k, q in fitted.items())
    print(f"{name}: {answer.verdict.name}, probability {answer.winner.probability:.2f}; {sizes}")

# %% [markdown]
# ## Back into the simulator
#
# `plant` is the repaired simulator. As a file it is some lines of TOML, and it drives in `avtorch.simulate` like any
# other plant.

# %%
files = both.write(OUT)
if both.plant is None:
    print("nothing was named, so there is nothing to repair")
else:
    text = (OUT / "plant.toml").read_text(encoding="utf-8")
    print(text)
    repaired = plant(baseline=OUT / "plant.toml")
    leader = avtorch.Leader.default(start=60.0)
    as_it_was = avtorch.simulate(leader, plant=both.simulator, duration=40.0)
    as_it_is = avtorch.simulate(leader, plant=repaired, duration=40.0)
    figure = Figure(figsize=(9, 4.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(as_it_was.time, as_it_was.accel[0, 0], color="#D55E00", label="simulator as it was")
    upper.plot(as_it_is.time, as_it_is.accel[0, 0], color="#0072B2", label="repaired")
    lower.plot(as_it_is.time, (as_it_is.spacing - as_it_was.spacing)[0, 0], color="0.3")
    upper.set_ylabel("acceleration [m/s²]")
    lower.set(xlabel="time [s]", ylabel="spacing, repaired\nless as it was [m]")
    upper.legend()
    plots.show(figure, OUT / "repaired.png")

# %% [markdown]
# The lower curve is the error that the missing effect caused: a controller tuned in the old simulator would have been
# wrong about its spacing by that much.
#
# ## Try this
#
# - `avtorch.diagnose(case.log(signals=["speed"]))`: one channel instead of two. What can no longer be distinguished?
# - `draw_cases(1, 2026, mix={"outside": 1.0}, seconds=60.0)`: a cause that is not in the table. Is an effect named?
# - `avtorch.diagnose(log, baseline="dead_time=0.2")`: a simulator with a delay that the car lacks. Is the answer the
#   same?
# - Bring your own: `avtorch.Log.read("drive.csv")`, or `avtorch diagnose drive.csv --out out/diagnosis`.
