"""`avtorch stability`: conditions, exact verdict, peak gain and a region around one setting."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from avtorch.cli import arguments as arg
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError, quoted

_AXES = {
    "k_s": (0.05, 4.0),
    "k_v": (0.0, 4.0),
    "k_a": (-3.0, 0.9),
    "tau": (0.1, 3.0),
    "T": (0.02, 2.0),
    "K": (0.2, 1.3),
}
"""Usual limits of each axis of a region."""


def stability(
    *,
    T: arg.Lag = 0.3,
    K: arg.Gain = 1.0,
    tau: Annotated[float, arg.zero_or_more("Time gap [s].", "s")] = 1.0,
    gains: arg.Gains = "1.5,1.5,-0.8",
    dead_time: Annotated[float, arg.zero_or_more("Dead time in the chain [s].", "s")] = 0.0,
    plane: Annotated[str, arg.option(f"Axes of the region: two out of {', '.join(_AXES)}.")] = "T,K",
    out: arg.Out = Path("out/stability"),
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Is one setting stable and string stable: conditions, exact verdict, peak gain, region."""
    k = arg.three_gains(gains)
    axes = _two_axes(plane)

    import torch

    from avtorch.results import stability_answer
    from avtorch.vehicle import stability as s

    talk = Talk(json=json, quiet=quiet)
    answer = stability_answer(T, K, tau, k, dead_time=dead_time)
    point = {"k_s": k[0], "k_v": k[1], "k_a": k[2], "tau": tau, "T": T, "K": K}
    # a dead time needs a frequency sweep, which is slow: use fewer points
    points = 401 if dead_time == 0 else 101
    x, y = ((name, torch.linspace(*_around(name, point[name]), points, dtype=torch.float64)) for name in axes)
    held = {"T_L": T, "K_L": K, "time_gap": tau, "gains": k, "dead_time": dead_time}
    with talk.waiting("Drawing the region"):
        region = s.region(x, y, **held)
    omega = torch.logspace(-1.5, 1.5, 600, dtype=torch.float64)
    curve = s.gain(omega, T, K, tau, k, dead_time=dead_time)

    from avtorch import plots

    peak = None if answer["peak_gain"] is None else (answer["peak_frequency_radps"], answer["peak_gain"])
    title = f"T_L {T:g} s, K_L {K:g}, time gap {tau:g} s, gains {k[0]:g}, {k[1]:g}, {k[2]:g}, dead time {dead_time:g} s"

    def picture() -> Any:
        here = (point[axes[0]], point[axes[1]])
        return plots.stability_figure(
            region, here, omega, curve, peak=peak, stable=answer["locally_stable"], title=title
        )

    write_answer(out, "stability.json", answer, {"stability.png": picture})
    _print(talk, answer)
    talk.done(out, answer)


def _print(talk: Talk, answer: Mapping[str, Any]) -> None:
    from avtorch.report.table import Table

    lines = [(group, *line) for group, lines in answer["conditions"].items() for line in lines.items()]
    rows = tuple((group, line, f"{value:.4g}", "holds" if value > 0 else "fails") for group, line, value in lines)
    talk.table(Table("Conditions", ("condition", "expression > 0", "value", ""), rows, numeric=("value",)))
    if answer["setting"]["dead_time_s"] > 0:
        talk.lines(["The conditions above ignore the dead time; the verdict below includes it."], "dim")
    for word in ("locally", "string"):
        stable = answer[f"{word}_stable"]
        name = f"{word} stable"
        talk.lines([f"{name:<16} {'yes' if stable else 'no'}"], "bold green" if stable else "bold red")
    if answer["peak_gain"] is not None:
        where = "" if answer["string_stable"] else f" at {answer['peak_frequency_radps']:.3g} rad/s"
        talk.lines([f"peak gain        {answer['peak_gain']:.4f}{where}"], "bold")
    talk.lines([f"dead time left   {answer['dead_time_margin_s']:.3f} s before local instability"])


def _two_axes(text: str) -> tuple[str, str]:
    names = tuple(part.strip() for part in text.split(","))
    if len(names) != 2 or names[0] == names[1] or not set(names) <= set(_AXES):
        needs = f"two different names out of {', '.join(_AXES)} such as tau,T"
        raise InputError(f"--plane: found {quoted(text)}, needs {needs}")
    return names[0], names[1]


def _around(name: str, value: float) -> tuple[float, float]:
    """Limits of an axis that contain the setting and the settings that could replace it."""
    low, high = _AXES[name]
    return min(low, value - 0.1 * abs(value)), max(high, value + 0.3 * abs(value))
