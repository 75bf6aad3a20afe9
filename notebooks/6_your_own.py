# %% [markdown]
# # Your own
#
# Your car has an effect that is not among the 22 of the table, or a controller that is not three gains. You will
# write an effect in a dozen lines, plot it, drive with it and diagnose it. Then you will put a controller of your own
# into the loop, find the equivalent setting, and monitor it through a change of the car.

# %%
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import torch
from matplotlib.figure import Figure

import avtorch
from avtorch import plots
from avtorch.decision import Grid, Setting, Strategist, SupervisedRun
from avtorch.display import show
from avtorch.gap import EFFECTS, Effect, EffectContext, Parameter, SimulatorInput, plant
from avtorch.plots import diagnosis as over_diagnosis
from avtorch.plots import effect_signature
from avtorch.results import run_answer
from avtorch.vehicle import FollowerState

mpl.rcParams.update(plots.STYLE)
OUT = Path("out/notebooks/6_your_own")

# %% [markdown]
# ## An effect
#
# Many cars realise a smaller share of a small command: the pedal's map is bent. The class below defines this: its place
# in the chain (`command`), its parameter with a typical range, which is its prior, and its equation. At the neutral
# value it must do nothing. [How to add an effect](../docs/own-effect.md) has the rules for all places in the chain.


# %%
@dataclass(frozen=True)
class PedalMap(Effect):
    """Commands below 2 m/s² are answered with less than their share, larger ones with more."""

    curve: float = 0.4

    name, place, meaning = "pedal_map", "command", "a pedal map that is bent"
    equation = "u (|u| / 2)^curve"
    parameters = (Parameter("curve", "-", neutral=0.0, low=0.1, high=0.8),)

    def apply(self, x: torch.Tensor, row: EffectContext) -> torch.Tensor:
        return x * (x.abs().clamp_min(1e-3) / 2.0) ** self.curve


figure = Figure(figsize=(9, 3.4), layout="constrained")
ax = effect_signature(figure.subplots(), PedalMap())
ax.set(xlabel="time [s]", ylabel="acceleration [m/s²]")
ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.25), ncols=4)
plots.show(figure, OUT / "signature.png")

# %% [markdown]
# Its signature: the standard command in grey, the response without and with the effect, and below, magnified, the
# difference of the two. Small commands fall short, the brake pulse of 2 m/s² does not.
#
# At the neutral value it must equal the plain vehicle, to the last digits:

# %%
time = torch.arange(2000, dtype=torch.float64) * 0.02
drive = SimulatorInput(time, torch.sin(time))
bare, neutral, bent = (plant(e).response(drive).accel for e in ([], [PedalMap(0.0)], [PedalMap(0.4)]))
error = float((neutral - bare).abs().max())
print(f"neutral against none: {error:.1e} m/s²; bent against none: {float((bent - bare).abs().max()):.2f} m/s²")

# %% [markdown]
# ## The effect diagnosed
#
# A minute of driving with it. Then the diagnosis, with the class as one more hypothesis beside the table.

# %%
car = plant([PedalMap(0.4)], baseline="T_L=0.4, K_L=0.9", sigma=0.1)
run = avtorch.simulate(avtorch.Leader.default(start=48.0), plant=car, duration=60.0)
found = avtorch.diagnose(run.log(), effects=[*EFFECTS.values(), PedalMap], pairs=False)
show(found)
q = found.winner.parameters.get("curve")
print("true curve 0.4;", "not named" if q is None else f"found {q.mean:.3f} ({q.q05:.3f} to {q.q95:.3f})")
plots.show(over_diagnosis.which_figure(found), OUT / "which.png")

livelier = avtorch.simulate(avtorch.Leader.default(), plant=car, duration=60.0)
quiet, without = (avtorch.diagnose(each.log(), pairs=False) for each in (run, livelier))
for what, answer in (("this minute", quiet), ("a livelier one", without)):
    print(f"without the class, {what}:", answer.verdict.name, f"{answer.winner.probability:.2f}")

# %% [markdown]
# With the class among the hypotheses the diagnosis names the effect and its size. Without it it cannot, and says so, in
# this minute and in a livelier one of the same car: the verdict is `unknown`, a cause that is not in the table.
#
# `@register` above the class would make it available everywhere: in strings, in TOML files, in every diagnosis.
#
# ## A controller
#
# A controller is any callable that maps a follower's measurements to a demanded acceleration [m/s²]: a law, a
# network, a binary behind a wire. This one drives at the speed that its spacing allows, and has neither gains nor a
# time gap.


# %%
def allowed_speed(spacing: torch.Tensor) -> torch.Tensor:
    """The speed [m/s] that a spacing [m] allows."""
    return 30 * torch.tanh((spacing - 5).clamp_min(0) / 35)


def controller(state: FollowerState) -> torch.Tensor:
    """Demanded acceleration [m/s²] (..., scenario)."""
    return 0.9 * (allowed_speed(state.spacing) - state.speed) + 0.6 * (state.lead_speed - state.speed)


# %% [markdown]
# ## Its equivalent setting
#
# Stability is a property of gains and a time gap. Near a steady drive every smooth controller has them: its
# derivatives. With `u = k_s (spacing - tau v - d) + k_v (v_lead - v) + k_a a`, autograd finds all four. Here they are
# over the speeds.

# %%
speeds = torch.linspace(2.0, 26.0, 49, dtype=torch.float64)
steady = 5 + 35 * torch.atanh(speeds / 30)  # the spacing at which the demand is zero
inputs = [x.clone().requires_grad_() for x in (steady, speeds, torch.zeros_like(speeds), speeds)]
spacing, speed, accel, lead_speed = inputs
demand = controller(FollowerState(0.0, spacing, speed, accel, lead_speed, torch.zeros_like(speeds)))
k_s, by_speed, k_a, k_v = torch.autograd.grad(demand.sum(), inputs, allow_unused=True, materialize_grads=True)
time_gap = -(by_speed + k_v) / k_s
gains = torch.stack([k_s, k_v, k_a], -1)

figure = Figure(figsize=(9, 3.4), layout="constrained")
left, right = figure.subplots(1, 2)
left.plot(speeds, time_gap, color="#0072B2", label="time gap [s]")
left.plot(speeds, k_s, color="#009E73", label="k_s [1/s²]")
left.plot(speeds, k_v, color="#A6407E", label="k_v [1/s]")
for (T, K), colour in (((0.3, 1.0), "#0072B2"), ((1.5, 0.5), "#D55E00")):
    right.plot(speeds, avtorch.stability.peak_gain(T, K, time_gap, gains), color=colour, label=f"T_L {T} s, K_L {K}")
right.axhline(1.0, color="0.5", linestyle=":")
right.set_ylabel("peak gain [-]")
for ax in (left, right):
    ax.set_xlabel("speed [m/s]")
    ax.legend()
plots.show(figure, OUT / "linearised.png")

at = int((speeds - 15).abs().argmin())
setting = Setting(time_gap=float(time_gap[at]), gains=gains[at].tolist())
print(f"at 15 m/s: time gap {float(time_gap[at]):.2f} s, gains", *(f"{k:.2f}" for k in gains[at]))

# %% [markdown]
# Left: the faster it drives, the more distance it keeps for each m/s, and the more softly it corrects its spacing.
# Right: the result in a line of cars. With the healthy actuator the peak gain is one, with the worn one it is larger,
# except at high speeds. The monitor below gets the setting at 15 m/s.
#
# ## Monitored
#
# The supervisor takes the controller as it is. Because the controller has no setting of its own, we pass one. The
# strategist may change the lower level only (strategy 1): it cannot adjust a controller that it does not know. At 26
# s the car changes.


# %%
def drive_with(strategist: Strategist | None) -> SupervisedRun:
    """Eighty seconds behind US06 with the controller above; the car changes at 26 s."""
    loop = avtorch.ClosedLoop(
        avtorch.Leader.default(), controller, plant=avtorch.GLVDPlant(0.3, 1.0, sigma=0.1), seeds=[0]
    )

    def change(loop: avtorch.ClosedLoop) -> None:
        loop.plant = avtorch.GLVDPlant(1.5, 0.5, sigma=0.1)

    supervisor = avtorch.Supervisor(loop, strategist=strategist, setting=setting)
    return supervisor.run(80.0, events=[(26.0, change)])


alone = drive_with(None)
saved = drive_with(Strategist(Grid(allowed={1})))
for action in saved.actions[0]:
    print(f"{action.time_s:.0f} s: {action.why}")

answer = run_answer(saved, alone.rows, change=(26.0, 1.5, 0.5), time_gap=float(setting.time_gap))
traces = {
    "accel": {
        "leader": saved.rows.lead_accel[0],
        "without action": alone.rows.accel[0],
        "with action": saved.rows.accel[0],
    }
}
truth = {"T_L": [(0.0, 0.3), (26.0, 1.5)], "K_L": [(0.0, 1.0), (26.0, 0.5)]}
plots.show(plots.overview_figure(answer, saved.rows.time, traces, truth=truth), OUT / "watched.png")
performance = answer["performance"]
for key in ("accel_rms_ratio", "jerk_rms_mps3", "min_spacing_m"):
    print(f"{key}: {performance['without_action'][key]:.3g} without action, {performance['with_action'][key]:.3g} with")

# %% [markdown]
# The belief follows lag and gain as it does under the paper's controller: it uses the commands and the response, not
# the controller. Without action the worn car runs into its leader at the stop (the least spacing is below zero; the
# orange line means nothing afterwards). With a lower level that has the right model, it stops clear of its leader.
#
# ## Try this
#
# - A `torch.nn.Module` as the controller: the same call, the same derivatives.
# - `PedalMap` with `memory`: a pedal that sticks ([effects with memory](../docs/own-effect.md#with-memory)).
# - `plant([PedalMap(0.4)], baseline=...)` behind your controller: does the diagnosis name the effect?
# - `avtorch.MPC()` as the controller: it has a setting of its own, so no `setting=` is needed.
