# %% [markdown]
# # Real cars
#
# Nobody outside a car maker knows what the controller of a production car demands. Its speed, its gap and the speed of
# the car in front are enough to say how it follows, whether a platoon of such cars would calm a disturbance or make it
# grow, and what of that is conditional on what. Then a car whose commands *are* known: a test vehicle on three laps.
#
# The recordings belong to others and are not part of the project. Set `AVTORCH_DATA` to a folder with
# `openacc_astazero` (OpenACC, European Commission, Joint Research Centre) and `genesis` (MPC-Berkeley,
# genesis_path_follower). Without them this notebook says so and ends.

# %%
import os
from pathlib import Path

import avtorch
from avtorch.errors import InputError
from avtorch.follower import diagnose_follower
from avtorch.io import Log, read_following
from avtorch.plots import over_followers

DATA = Path(os.environ["AVTORCH_DATA"]) if os.environ.get("AVTORCH_DATA") else None
if DATA is None:
    print("AVTORCH_DATA is not set: no recordings, nothing to show.")

# %% [markdown]
# ## A platoon of five
#
# Four cars follow a leader around a proving ground, each on its own adaptive cruise control. A law is fitted to one
# half of each drive and judged on the other: driven by its leader alone, the loop has to find the car's speed over a
# minute.

# %%
cars = []
if DATA is not None:
    for number in (2, 3, 4, 5):
        log = read_following(DATA / "openacc_astazero" / "ASta_040719_platoon7.csv", vehicle=number)
        found = diagnose_follower(log, cause=False)
        own = found.loops[found.law.name]
        cars.append(found)
        print(
            f"{found.name}: {found.law.name}, off by {own.speed:.2f} m/s where a car that keeps its speed is off by "
            f"{found.keeps_speed:.1f}; P(string stable) {found.usual.p_string_stable:.2f}; amplifies "
            f"{own.amplified:.2f} times, {own.amplified_simulated:.2f} in the simulated loop"
        )

# %% [markdown]
# Each of them follows at little more than a second, reacts later than that, and passes on more than it gets: peak gains
# are above one. What the simulated loops amplify is what the cars amplify.

# %%
figure = over_followers.followers_figure(cars) if cars else None
figure

# %% [markdown]
# ## What a slope does
#
# The road is surveyed, and the followers were not told of it. If a car's actuator did nothing against a slope, its
# pull would show in the speed with coefficient 1. It does not: between -0.3 and 0.4. A production car's lower level
# holds the demanded acceleration uphill and down, so from a follower's speed nobody can recover the road.

# %% [markdown]
# ## A car whose commands are known
#
# Three laps of one test vehicle with the demanded acceleration and the speed, no accelerometer. Each lap is judged by
# what the other two fitted.

# %%
if DATA is not None:
    try:
        laps = [Log.read(DATA / "genesis" / f"lap{k}.csv") for k in (1, 2, 3)]
        among = ["brake_throttle_asymmetry", "constant_resistance", "dead_time", "second_order_actuator"]
        as_it_is = avtorch.diagnose(laps, effects=among, pairs=False)
        told = avtorch.diagnose(laps, effects=among, pairs=False, prior={"unknown": 0})
    except InputError as error:
        print(error)
    else:
        print("as it is:", as_it_is.verdict.name, f"{as_it_is.winner.probability:.2f}")
        print("if it must be one of these:", told.verdict.name, f"{told.winner.probability:.2f}")
        if told.shrinkage is not None:
            for metric, moved in told.shrinkage.by_metric.items():
                share = "nothing to close" if moved.closed is None else f"{moved.closed.mean:.2f}"
                between = "" if moved.closed is None else f" ({moved.closed.q05:.2f} to {moved.closed.q95:.2f})"
                print(f"{metric}: {moved.before:.3g} -> {moved.after:.3g}, closed {share}{between}")

# %% [markdown]
# The measured speed trembles at 8 to 20 Hz as no effect of the table makes it, so the honest answer is `unknown`. Made
# to choose, the diagnosis takes brakes that are stronger than the engine. On the lap that was held out this makes the
# speed a little better, and the intervals say that three minutes cannot show it.
