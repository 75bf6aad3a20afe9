# %% [markdown]
# # Diagnosing a sim-to-real gap
#
# A simulator and a car disagree. Which effect does the simulator lack? You will draw a drive of a reference vehicle
# that shares no code with the diagnosis, with one effect in it that stays sealed; diagnose it from its log alone; read
# where the gap lies, how far it shrinks and which manoeuvre would settle the rest; drive that manoeuvre; and only then
# open the seal. At the end the repaired simulator drives on.

# %%
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import avtorch
from avtorch import plots
from avtorch.blindtest import Recorded, draw_cases, simulate
from avtorch.experiment import Limits, next_experiment
from avtorch.gap import plant
from avtorch.plots import diagnosis as over_diagnosis

mpl.rcParams.update(plots.STYLE)
OUT = Path("out/notebooks/4_diagnosing_a_gap")

# %% [markdown]
# ## A sealed case
#
# The first case of set 2026 with a single effect of medium strength, over a minute. Other seeds hold other cases; a
# diagnosis gets some of them wrong, and [how often](../docs/diagnosis.md) was counted on a thousand.

# %%
case = next(draw_cases(1, 2026, mix={"single": 1.0}, tiers=["medium"], seconds=60.0))
log = case.log()
print(f"{log.rows} rows, {log.rate_hz:.0f} Hz, {case.drive.manoeuvre}")

figure = Figure(figsize=(9, 3.4), layout="constrained")
ax = figure.subplots()
ax.plot(log.time, log.accel, color="#0072B2", linewidth=0.8, label="measured")
ax.step(log.time, log.accel_cmd, color="0.3", linewidth=0.9, where="post", label="command")
ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
plots.show(figure, OUT / "log.png")

# %% [markdown]
# Nobody would name an effect by looking at this. The measurement is noisy, and lag and gain are unknown as well.
#
# ## The diagnosis
#
# Every effect of the table is fitted, alone and in pairs, with `T_L` and `K_L` free beside it.

# %%
found = avtorch.diagnose(log)
print(found)
print()
for candidate in found.candidates[:6]:
    sizes = ", ".join(f"{k} {q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})" for k, q in candidate.parameters.items())
    print(f"  {candidate.name:22} {candidate.probability:.3f}  {sizes}")
plots.show(over_diagnosis.which_figure(found), OUT / "which.png")

# %% [markdown]
# Printed, a diagnosis says what it found. In the picture, blue bars are what this log cannot tell apart. `unknown`
# means none of the table: it is always a candidate, and where it is first the diagnosis blames nothing.
#
# ## Where it lies, and how far it shrinks

# %%
plots.show(over_diagnosis.road_figure(found), OUT / "road.png")
plots.show(over_diagnosis.where_figure(found), OUT / "where.png")

# %% [markdown]
# Above, the stretch where the simulator with the effect (blue) and without (orange) differ most, beside the
# measurement. Below, in blue, where the effect does what it does, over time, speed and command; in grey the drive
# itself. In words it was said above: it lies in what the car does, not in what its sensor shows, and at low
# frequencies. A part of the time, the speeds or the commands is named (and shaded) only where it holds nearly all of
# the effect in much fewer rows.

# %%
told = found.shrinkage
if told is not None:
    top = told.top
    print(f"{told.metric}: {top.before:.3g} as it is, {top.after:.3g} with the effect, {top.floor:.3g} at best")
    if top.closed is not None:
        closed = f"{top.closed.mean:.0%} ({top.closed.q05:.0%} to {top.closed.q95:.0%})"
        print(f"closed {closed} of the gap, on rows that chose neither the effect nor its size")
    plots.show(over_diagnosis.shrinkage_figure(found), OUT / "shrinkage.png")

# %% [markdown]
# Rollouts on parts of the drive that were held out. Orange is the simulator as it is, blue the repaired one; the light
# line is what noise alone would leave, the grey crosses what a black box makes of it: with a minute to learn from,
# worse than nothing. Read the interval of `closed`: a minute in which an effect hardly acts cannot say how far it
# closes the gap.
#
# ## The next experiment
#
# More than one cause is left. Each foretells another answer to a manoeuvre; which manoeuvre sets them apart?

# %%
ahead = next_experiment(found, Limits(seconds=60.0))
if ahead is None:
    print("nothing is confused")
    both = found
else:
    print(ahead.why)
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
    print("not told apart:", ", ".join(both.verdict.alias_set))

# %% [markdown]
# The ramps go through zero slowly, both ways, at low speed and on a road that is taken as level: there a dead band is
# seen and the others are not. Both drives are diagnosed together.
#
# ## The truth

# %%
print("the sealed cause:", case.truth_name, {k: dict(v) for k, v in case.parameters.items()})
print("from" if case.onset_s else "", f"{case.onset_s:.1f} s on" if case.onset_s else "from the start")
print(f"the car: T_L {case.car.T_L:.3f} s, K_L {case.car.K_L:.3f}")
for name, answer in (("first drive", found), ("both drives", both)):
    fitted = {k: answer.winner.moved[k] for k in ("T_L", "K_L")} if answer.winner.moved else answer.baseline
    sizes = ", ".join(f"{k} {q.mean:.3f} ({q.q05:.3f} to {q.q95:.3f})" for k, q in fitted.items())
    print(f"{name}: {answer.verdict.name}, probability {answer.winner.probability:.2f}; {sizes}")

# %% [markdown]
# ## Back into the simulator
#
# `found.plant` is the repaired simulator. Written down it is a few lines of TOML, and it drives in `avtorch.simulate`
# like any other plant.

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
# The lower curve is what the missing effect had hidden: a controller tuned in the old simulator would have been wrong
# about its spacing by so much.
#
# ## Try this
#
# - `avtorch.diagnose(case.log(signals=["speed"]))`: one channel instead of two. What is no longer told apart?
# - `draw_cases(1, 2026, mix={"outside": 1.0}, seconds=60.0)`: a cause that is not in the table. Is it blamed on a name?
# - `avtorch.diagnose(log, baseline="dead_time=0.2")`: a simulator that has a delay which the car has not. Is the answer
#   the same?
# - Bring your own: `avtorch.Log.read("drive.csv")`, or `avtorch diagnose drive.csv --out out/diagnosis`.
