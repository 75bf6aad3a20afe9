# %% [markdown]
# # Your own simulator
#
# You have a simulator that avtorch knows nothing of, and the log of a car. Three questions: where is the simulator
# wrong, what does it lack, and how much better is it with that in it? Here the simulator is a class of a dozen lines;
# an [FMU](../docs/simulators.md#fmus) or the simulator's output alone would do as well.

# %%
from collections import deque
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import avtorch
from avtorch import ExternalSimulator, Log, plots
from avtorch.display import show
from avtorch.external import check_simulator, wrap
from avtorch.external.driving import driven_along
from avtorch.plots import diagnosis as over_diagnosis

mpl.rcParams.update(plots.STYLE)
OUT = Path("out/notebooks/7_your_simulator")

# %% [markdown]
# ## A simulator
#
# `reset` and `step` are all that is asked of it. Inside, this one takes steps of a millisecond: a delay, an actuator of
# second order, and drag.


# %%
class Simulator:
    delay_s, omega, zeta, drag = 0.1, 6.0, 0.8, 4e-4

    def reset(self, *, speed: float, accel: float) -> None:
        self.speed, self.rate = speed, 0.0
        self.pull = accel + self.drag * speed**2
        self.waiting = deque([self.pull] * round(self.delay_s / 0.001))

    def force(self) -> float:
        return -self.drag * self.speed**2

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        for _ in range(round(dt / 0.001)):
            self.waiting.append(accel_cmd)
            wanted = self.waiting.popleft()
            bend = self.omega**2 * (wanted - self.pull) - 2 * self.zeta * self.omega * self.rate
            self.rate += 0.001 * bend
            self.pull += 0.001 * self.rate
            self.speed += 0.001 * (self.pull + self.force())
        return self.pull + self.force(), self.speed


# %% [markdown]
# ## Is it what I set?
#
# A parameter's name is one thing, what it does in the drive another. `check_simulator` drives it through steps and a
# sweep and says what it is made of.

# %%
check = check_simulator(Simulator())
show(check)

figure = Figure(figsize=(9, 3.0), layout="constrained")
ax = figure.subplots()
part = slice(0, round(55 / 0.02))
ax.step(
    check.output.time[part], check.output.accel_cmd[part], color="0.3", linewidth=0.9, where="post", label="command"
)
ax.plot(check.output.time[part], check.output.accel[part], color="#0072B2", linewidth=0.9, label="simulator")
ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
plots.show(figure, OUT / "manoeuvre.png")

# %% [markdown]
# ## Where is it wrong?
#
# The car is the simulator with something more, and with sensors. Both get the same commands.


# %%
class Car(Simulator):
    def force(self) -> float:
        return super().force() - 0.15  # a brake that drags


rng = np.random.default_rng(7)
time = np.arange(0.0, 90.0, 0.02)
command = 0.55 + sum(
    rng.normal(0, 0.5) * np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in (0.03, 0.08, 0.2, 0.4)
)
still = Log.from_arrays(name="drive.csv", time=time, accel_cmd=command, speed=np.full(len(time), 18.0))
true = driven_along(Car(), still)
log = Log.from_arrays(
    name="drive.csv",
    time=time,
    accel_cmd=command,
    accel=true.accel + 0.05 * rng.standard_normal(len(time)),
    speed=true.speed + 0.03 * rng.standard_normal(len(time)),
)
before = driven_along(Simulator(), log)
print(f"after {time[-1]:.0f} s the simulator is {before.speed[-1] - true.speed[-1]:.1f} m/s faster than the car")

# %% [markdown]
# ## What does it lack?
#
# The simulator goes in as the baseline. The answer is what *it* lacks: neither its delay nor its drag is named. The
# likeliest name is not the brake that drags: the commands hardly go below zero, and above it a dead band takes the
# same 0.15 m/s² off.

# %%
found = avtorch.diagnose(log, baseline=ExternalSimulator(Simulator))
show(found)
plots.show(over_diagnosis.which_figure(found), OUT / "which.png")

# %% [markdown]
# ## How much better is it then?
#
# `wrap` puts what was found around the simulator; the result has `reset` and `step` again, and goes wherever the
# simulator went.

# %%
after = driven_along(wrap(Simulator(), found), log)
errors = {
    name: float(np.sqrt(np.mean((x.speed - true.speed) ** 2)))
    for name, x in (("as it was", before), ("wrapped", after))
}
print({name: round(error, 2) for name, error in errors.items()}, "m/s, root mean square over the whole drive")

figure = Figure(figsize=(9, 3.4), layout="constrained")
ax = figure.subplots()
ax.plot(time, log.speed, color="0.6", linewidth=0.8, label="car")
ax.plot(time, before.speed, color="#D55E00", linewidth=1.2, label="simulator")
ax.plot(time, after.speed, color="#0072B2", linewidth=1.2, linestyle="--", label="simulator, wrapped")
ax.set(xlabel="time [s]", ylabel="speed [m/s]")
ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
plots.show(figure, OUT / "speeds.png")

# %% [markdown]
# ## Try this
#
# - Give the car another `delay_s` in place of the force. The answer is then a parameter that is wrong, not an effect
#   that is missing.
# - Say what may be wrong: `ExternalSimulator(Simulator, adjustable={"delay_s": (0.0, 0.5)})` fits the delay to the car
#   by its own name, and says whether it is that or something missing.
# - Take the simulator's output instead of the simulator: `ExternalSimulator(before)`.
# - Write what was found as an FMU: `avtorch.external.write_fmu(found, "better.fmu")`.
