# %% [markdown]
# # Real cars
#
# Only the maker knows what the controller of a production car demands. Its speed, its spacing and its leader's speed
# are informative all the same: you will see how the car follows, whether a line of such cars damps a disturbance or
# amplifies it, and which of these results is conditional on what. Then comes a car whose commands *are* known, a test
# vehicle on three laps, and a diagnosis that names no effect.
# The recordings belong to third parties and are not part of the project, but they are public: OpenACC by the European
# Commission's Joint Research Centre (its data catalogue has it, GitHub's `yinglonghe/C2ART-OPT` the platoons on
# AstaZero) and the laps of GitHub's `MPC-Berkeley/genesis_path_follower`. Put their files into folders
# `openacc_astazero` and `genesis`, the laps as CSV with the columns `time`, `accel_cmd` and `speed`, and let
# `AVTORCH_DATA` name the folder of both. Without them every cell runs and names the missing files.

# %%
import os
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

import avtorch
from avtorch import plots
from avtorch.follower import diagnose_follower
from avtorch.io import read_following
from avtorch.plots import followers as over_followers

mpl.rcParams.update(plots.STYLE)
OUT = Path("out/notebooks/5_real_cars")
DATA = Path(os.environ["AVTORCH_DATA"]) if os.environ.get("AVTORCH_DATA") else None
PLATOON = "openacc_astazero/ASta_040719_platoon7.csv"
LAPS = [f"genesis/lap{k}.csv" for k in (1, 2, 3)]


def there(*names: str) -> bool:
    """Whether the recordings are available; prints what is missing."""
    missing = [name for name in names if DATA is None or not (DATA / name).exists()]
    if missing:
        print("not shown, for lack of", ", ".join(missing), "in the folder that AVTORCH_DATA names")
    return not missing


# %% [markdown]
# ## A platoon of five
#
# Four cars follow a leader around a proving ground, each on its own adaptive cruise control, for a quarter of an hour.

# %%
cars, logs = [], []
if there(PLATOON):
    logs = [read_following(DATA / PLATOON, vehicle=number) for number in (2, 3, 4, 5)]
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    ax = figure.subplots()
    ax.plot(logs[0].time, logs[0].lead_speed, color="0.5", label="leader")
    for k, log in enumerate(logs):
        ax.plot(log.time, log.speed, color=mpl.colormaps["viridis"](k / 4), linewidth=1, label=f"vehicle {k + 2}")
    start = float(logs[0].time[0])
    ax.set(xlabel="time [s]", ylabel="speed [m/s]", xlim=(start + 300, start + 480), ylim=(5, 37))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.18), ncols=5)
    plots.show(figure, OUT / "platoon.png")

# %% [markdown]
# Three minutes of it: whenever the leader changes its speed, each car overshoots a little more than the one in front.
#
# A law of following is fitted to one half of each drive and scored on the other: driven by its leader alone, the loop
# has to predict the car's speed over a minute.

# %%
for log in logs:
    found = diagnose_follower(log, cause=False)
    own = found.loops[found.law.name]
    cars.append(found)
    print(f"{found.name.split(', ')[-1]}, {found.law.name.replace('_', ' ')}:")
    print(f"  speed error {own.speed:.2f} m/s (constant speed: {found.keeps_speed:.1f})")
    print(
        f"  amplifies its leader's motion {own.amplified:.2f} times, its loop {own.amplified_simulated:.2f};", end=" "
    )
    print(f"P(string stable) {found.usual.p_string_stable:.2f}")

# %%
if cars:
    plots.show(over_followers.followers_figure(cars), OUT / "followers.png")

# %% [markdown]
# From the left: the time gap that each car keeps, how long it takes from perception to motion, and the peak gain. They
# follow at little more than a second and take about as long to respond, so they amplify: all peak gains are above one.
# The simulated loops amplify as much as the cars.
#
# All this is conditional on the form of the law, and concerns controller and car together. The slopes of the road,
# which is surveyed, hardly show in these speeds, because the lower level of a production car realises the demand
# uphill and down: the road cannot be recovered from a follower's speed. [Real cars](../benchmarks/real_cars.md) has the
# command for all 54 drives.
#
# ## A car whose commands are known
#
# Three laps of one test vehicle with the demanded acceleration and the speed, no accelerometer. Four effects are
# tried here, so that it does not take long. The diagnosis runs twice: once as usual, once with `unknown` excluded.

# %%
if there(*LAPS):
    laps = [avtorch.Log.read(DATA / name) for name in LAPS]
    among = ["brake_throttle_asymmetry", "constant_resistance", "dead_time", "second_order_actuator"]
    as_it_is = avtorch.diagnose(laps, effects=among, pairs=False)
    named = avtorch.diagnose(laps, effects=among, pairs=False, prior={"unknown": 0})
    print(f"as usual: {as_it_is.verdict.name}, probability {as_it_is.winner.probability:.2f}")
    print(f"without unknown: {named.verdict.name}, probability {named.winner.probability:.2f}")

# %% [markdown]
# None of the four is likelier there than not. With the speed alone a delay and a second pole cannot be told from what
# the car and its recorder do in any case, so they are part of every hypothesis and of `none`; three laps of a minute
# do not show that the brakes are stronger than the engine.
#
# ## Try this
#
# - Other drives: `ASta_040719_platoon8.csv`, or the ZalaZONE files of OpenACC. Which cars are calm?
# - `diagnose_follower(log)` without `cause=False` also asks what the plain loop lacks.
# - `avtorch.diagnose(laps)` tries all effects, alone and in pairs. Is the answer the same?
# - Your own car: `avtorch diagnose drive.csv --follower` for a log without commands, `avtorch diagnose drive.csv` with.
