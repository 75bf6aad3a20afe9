"""`avtorch compare`: did a change to the car or to the simulator help?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.markup import escape
from rich.table import Table

from avtorch.cli.arguments import OUTPUT, Json, Quiet, free_folder
from avtorch.cli.simulator import read_simulator
from avtorch.cli.talk import Talk
from avtorch.errors import InputError

if TYPE_CHECKING:
    from avtorch.gap.result.comparison import Change, Comparison

_ROWS = {
    "T_L": "lag T_L [s]",
    "K_L": "gain K_L [-]",
    "rollout_rmse_accel": "acceleration error, {horizon} s [m/s²]",
    "rollout_rmse_speed": "speed error, {horizon} s [m/s]",
}


def compare(
    before: Path,
    after: Path,
    /,
    *,
    baseline: Annotated[
        str, Parameter(help="The simulator: effects such as dead_time=0.2, or TOML; glvd is fitted to BEFORE.")
    ] = "glvd",
    baseline_after: Annotated[
        str | None, Parameter(help="The simulator that AFTER is compared with; default: the same.")
    ] = None,
    out: Annotated[Path | None, Parameter(name="--out", group=OUTPUT, help="Folder for comparison.json.")] = None,
    map: Annotated[
        list[str] | None,
        Parameter(negative=(), help="Name of a column, SIGNAL=COLUMN, such as accel=ACC_X; repeatable."),
    ] = None,
    unit: Annotated[
        list[str] | None, Parameter(negative=(), help="Unit of a column, SIGNAL=UNIT, such as speed=km/h; repeatable.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Did a change to the car, or to the simulator, help? By how much, with intervals.

    Parameters
    ----------
    before
        A log, as for diagnose: the drive before the change.
    after
        The drive after it. The same file twice compares two simulators on one drive.
    """
    if out is not None:
        free_folder(out)
    simulator = read_simulator("--baseline", baseline)
    other = None if baseline_after is None else read_simulator("--baseline-after", baseline_after)
    if baseline_after is not None and (simulator is None or other is None):
        raise InputError("--baseline-after: found without two simulators; needs --baseline and --baseline-after given")

    from avtorch.gap.compare import compare as work
    from avtorch.io import Log, answer_set, check, write_json

    talk = Talk(json=json, quiet=quiet)
    logs = [Log.read(path, map=map, unit=unit) for path in (before, after)]
    for path, log in zip((before, after), logs, strict=True):
        if not log.usable.any():
            raise InputError(
                f"{path}: has no row to use; all are driven by hand (engaged 0), within 2 s after, or at standstill"
            )
        talk.notes(log.name, check(log).notes)
    with talk.steps("Comparing") as step:
        comparison = work(*logs, baseline=simulator, baseline_after=other, progress=step)
    if out is not None:
        with answer_set(out, ("comparison.json",)) as staged:
            write_json(staged / "comparison.json", comparison.to_dict())
    if talk.json:
        import json as text

        print(text.dumps(comparison.to_dict()))
        return
    talk.out.print(f"[bold]{escape(comparison.why)}[/bold]")
    talk.out.print()
    talk.out.print(_table(comparison))
    if out is not None:
        talk.out.print(f"\nWritten to [bold]{escape(str(out))}[/bold]: comparison.json", soft_wrap=True)


def _table(comparison: Comparison) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("")
    for name in ("before", "after", "after / before (90 %)"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, moved in {**comparison.car, **comparison.gap}.items():
        row = _ROWS.get(name, name).format(horizon=f"{comparison.horizon_s:.3g}")
        table.add_row(escape(row), *_cells(moved))
    for label, value in _of_cause(comparison):
        table.add_row(escape(label), "", "", escape(value))
    return table


def _of_cause(comparison: Comparison) -> list[tuple[str, str]]:
    """Rows of the cause: what has changed, by how much, with which probability; or the least change that would show."""
    from avtorch.gap.change.change_cause import detectable_text
    from avtorch.gap.quantity import unit_of, words_of

    cause = comparison.cause
    if cause is None:
        return []
    if not cause.parts:
        least = cause.detectable.items()
        return [(f"least change of {name} that would show", detectable_text(name, value)) for name, value in least]
    rows: list[tuple[str, str]] = []
    for part in cause.parts:
        others = [name for name in part.alias_set if name != part.name]
        alike = f" (or {', '.join(others)})" if others else ""
        rows.append((f"cause: {part.name}{alike}", f"probability {part.probability:.2f}"))
        for key, q in part.parameters.items():
            unit = unit_of(key)
            name = f"  {words_of(key)}" + ("" if unit == "-" else f" [{unit}]")
            rows.append((name, f"{q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})"))
    return rows


def _cells(moved: Change) -> list[str]:
    r = moved.ratio
    return [
        *(f"{q.mean:.3g}" for q in (moved.before, moved.after)),
        f"{r.mean:.2f} ({r.q05:.2f} to {r.q95:.2f})",
    ]
