"""The signature of each effect: the response to one standard command, with and without it."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from avtorch.gap import EFFECTS, PLACES, Effect, Response, SimulatorInput, plant
from avtorch.gap.simulator.effect_response import shown_at
from avtorch.plots.style import BLACK, BLUE, GREY, VERMILLION, styled

_DT = 0.02
_ONSET_S = 9.0  # [s]
_SEED = 3  # of the random effects' picture
_FACTORS = (1, 2, 5, 10, 20, 50)
_GAP_AT = -3.6  # [m/s²], where the gap's zero is drawn


def standard_command() -> tuple[Tensor, Tensor]:
    """Time (time,) [s] and command (time,) [m/s²]: step up, hold, step down, back to zero, sine."""
    time = torch.arange(round(24.0 / _DT), dtype=torch.float64) * _DT
    command = torch.zeros_like(time)
    for start, end, value in ((1.0, 5.0, 1.5), (5.0, 7.0, 0.3), (7.0, 11.0, -2.0)):
        command[(time >= start) & (time < end)] = value
    sine = time >= 14.0
    command[sine] = torch.sin(2 * math.pi * 0.4 * (time[sine] - 14.0))
    return time, command


def standard_response(effect: Effect | None) -> Response:
    """Response of GLVD (0.3 s, 1), with `effect` if one is given, to the standard command; random ones are drawn.

    An effect that depends on speed gets the speed of this response, found by iteration.
    """
    time, command = standard_command()
    first = torch.full_like(time, 12.0 if effect is None else shown_at(effect))
    drive = SimulatorInput(time, command, first, 0.0 if effect is None or effect.place != "body" else None)
    car = plant([] if effect is None else [effect])
    response = car.response(drive, generator=torch.Generator().manual_seed(_SEED))
    for _ in range(4):
        drive = replace(drive, speed=response.speed.clamp_min(0.0))
        response = car.response(drive, generator=torch.Generator().manual_seed(_SEED))
    return response


def effect_signature(ax: Axes, effect: Effect) -> Axes:
    """Plot the measured acceleration [m/s²] with `effect` and without, over the standard command.

    Of an effect on the measured speed it is that speed's slope. Below lies the gap, magnified by the factor that is
    written there.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from avtorch.gap import DeadTime
        >>> from avtorch.plots import effect_signature
        >>> ax = effect_signature(Figure().subplots(), DeadTime(0.4))
        >>> len(ax.lines) >= 2
        True
    """
    time, command = standard_command()
    with_it, without = (_shown(standard_response(e), effect.reading) for e in (effect, None))
    gap = with_it - without
    factor = next((f for f in _FACTORS if f * float(gap.abs().max()) >= 0.45), _FACTORS[-1])
    ax.step(time, command, where="post", color=GREY, linewidth=0.8, alpha=0.7, label="command")
    ax.plot(time, without, color=BLACK, linewidth=1.0, linestyle="--", label="simulator (GLVD)")
    ax.plot(time, with_it, color=BLUE, linewidth=1.3, label="with the effect")
    ax.axhline(_GAP_AT, color=GREY, linewidth=0.6)
    magnified = (factor * gap).clamp(-1.1, 1.1) + _GAP_AT
    ax.fill_between(time, magnified, _GAP_AT, color=VERMILLION, alpha=0.6, linewidth=0, label="gap, magnified")
    ax.plot(time, magnified, color=VERMILLION, linewidth=0.8)
    ax.text(0.995, 0.02, f"gap × {factor}", transform=ax.transAxes, color=VERMILLION, fontsize=7, ha="right")
    ax.set_title(effect.name.replace("_", " "), fontsize=9)
    ax.set_xlim(0.0, float(time[-1]))
    ax.set_ylim(_GAP_AT - 1.5, 2.0)
    ax.set_yticks([-2, -1, 0, 1])
    return ax


def _shown(response: Response, reading: str) -> Tensor:
    return response.accel_measured if reading == "accel" else torch.gradient(response.speed_measured, spacing=_DT)[0]


def _typical(kind: type[Effect]) -> Effect:
    """The effect at its typical strength; one with its own onset starts within the picture."""
    effect = kind()
    return effect if kind.own_onset is None else effect.replaced({kind.own_onset: _ONSET_S})


@styled
def signature_figure() -> Figure:
    """All registered effects at typical strength, in the order of the chain.

    Example:
        >>> from avtorch.plots import signature_figure
        >>> len(signature_figure().axes) >= 22
        True
    """
    typical = [_typical(cls) for cls in EFFECTS.values()]
    effects = sorted(typical, key=lambda e: (PLACES.index(e.place), e.order, e.name))
    columns = 4
    rows = -(-len(effects) // columns)
    figure = Figure(figsize=(13, 2.1 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True)
    for ax, effect in zip(axes.flat, effects, strict=False):
        effect_signature(ax, effect)
        ax.set_title(effect.place, loc="right", fontsize=8, color=GREY, fontweight="normal")
    for ax in axes.flat[len(effects) :]:
        ax.set_axis_off()
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    for ax in axes[:, 0]:
        ax.set_ylabel("accel. [m/s²]")
    for ax in axes.flat[max(0, len(effects) - columns) : len(effects)]:
        ax.set_xlabel("time [s]")
        ax.tick_params(labelbottom=True)
    return figure
