"""The page of a comparison: two sets of drives, or two simulators on one log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from avtorch.gap.quantity import Quantity, unit_behind, words_of
from avtorch.gap.result.comparison import ChangeCause, Comparison, detectable_text
from avtorch.gap.result.log_facts import LogFacts
from avtorch.report.page import Origin, Page, Picture, Section, Tone, picture_of
from avtorch.report.table import Table

if TYPE_CHECKING:
    from avtorch.external import SimulatorComparison

_ROWS = {
    "T_L": "lag T_L [s]",
    "K_L": "gain K_L [-]",
    "rollout_rmse_accel": "acceleration error, {horizon} s [m/s²]",
    "rollout_rmse_speed": "speed error, {horizon} s [m/s]",
}
_OF_SIMULATOR: Mapping[str, tuple[str, str, Tone]] = {
    "closer": ("the simulator is closer to the car after", "The simulator after is closer to the car", "green"),
    "farther": ("the simulator is farther from the car after", "The simulator after is farther from the car", "amber"),
    "inconclusive": (
        "whether the simulator is closer cannot be told",
        "Which simulator is closer to the car cannot be told",
        "blue",
    ),
}
"""What is said of two drives, and of two simulators of one drive."""


def comparison_html(
    found: Comparison | SimulatorComparison, *, notes: Sequence[str] = (), origin: Origin | None = None
) -> str:
    """The page of a comparison as text; `notes`: on the data."""
    page = _of_drives(found, notes) if isinstance(found, Comparison) else _of_simulators(found, notes)
    return page.html(origin)


def comparison_tables(found: Comparison | SimulatorComparison) -> tuple[Table, Table]:
    """The errors before and after, or of the first and the second; and what has changed or differs, as far as known."""
    if isinstance(found, Comparison):
        moved = {**found.car, **found.gap}
        rows = [
            (_row_name(name, found.horizon_s), *map(_told, (m.before, m.after, m.ratio))) for name, m in moved.items()
        ]
        columns = ("quantity", "before (90 %)", "after (90 %)", "after / before (90 %)")
        return Table("Before and after", columns, tuple(rows), numeric=columns[1:]), _cause_table(found.cause)
    errors = found.errors.items()
    rows = [(_row_name(name, found.horizon_s), *map(_told, (e.first, e.second, e.ratio))) for name, e in errors]
    rows.append(("both, geometric mean", "", "", _told(found.ratio)))
    columns = ("error", "first (90 %)", "second (90 %)", "second / first (90 %)")
    table = Table("Errors of the two", columns, tuple(rows), numeric=columns[1:])
    what = [
        (
            ", ".join(d.parts),
            *(("", "") if len(d.parts) > 1 else (_side(d.first), _side(d.second))),
            f"× {_told(d.ratio)}",
        )
        for d in found.differences
    ]
    titles = ("difference", "first", "second", "error of the farther (90 %)")
    return table, Table("What the two have differently", titles, tuple(what))


def _cause_table(cause: ChangeCause | None) -> Table:
    """Parts of the change, or the least changes that would show."""
    if cause is None or not cause.parts:
        least = () if cause is None else tuple((name, detectable_text(name, x)) for name, x in cause.detectable.items())
        return Table("What would show", ("least change that would show", "size"), least)
    sides = ("before (90 %)", "after (90 %)", "change (90 %)")
    rows = []
    for part in cause.parts:
        cells: dict[str, list[str]] = {side: [] for side in sides}
        for key, q in part.parameters.items():
            side = next((s for s in ("before", "after") if key.startswith(s)), "change")
            word = "" if key.startswith(side) else f"{words_of(key)} "
            cells[f"{side} (90 %)"].append(f"{word}{_told(q)}{unit_behind(key)}")
        alike = ", ".join(name for name in part.alias_set if name != part.name) or "nothing"
        name = f"{'less ' if part.less else ''}{part.name}"
        rows.append((name, f"{part.probability:.2f}", *map("; ".join, cells.values()), alike))
    columns = ("what", "probability", *sides, "cannot be told from")
    return Table("Parts of the change", columns, tuple(rows), numeric=("probability",))


# two sets of drives ------------------------------------------------------------------------------------------------
def _of_drives(found: Comparison, notes: Sequence[str]) -> Page:
    said, of_one_drive, tone = _OF_SIMULATOR[found.simulator]
    one_drive = found.before == found.after
    car = "The car has changed" if found.changed else "No change of T_L and K_L is detected"
    table, parts = comparison_tables(found)
    ratios = {_row_name(n, found.horizon_s): m.ratio for n, m in {**found.car, **found.gap}.items()}
    none = "An interval that crosses the dashed line cannot be told from no change."
    cause = () if found.cause is None or found.cause.why in found.why else (found.cause.why,)
    return Page(
        "Comparison",
        _facts(found.before) if one_drive else f"before: {_facts(found.before)}; after: {_facts(found.after)}",
        Section(
            of_one_drive if one_drive else f"{car}; {said}",
            (found.why,),
            (_ratios("after / before", ratios, table, none),),
        ),
        (
            Section("What has changed", cause, tables=(parts,)),
            Section("The data", items=notes),
            Section(
                "Method and limits",
                items=(
                    "T_L and K_L are fitted to each set of drives; intervals are of the scatter between blocks of the "
                    "drives, which holds what one road or one day has to itself only as far as the drives do.",
                    f"Errors are of rollouts over {found.horizon_s:.3g} s from logged commands.",
                    f"p-value of T_L and K_L for drives of one car: {found.p_value:.2g}.",
                ),
            ),
        ),
        tone if not found.changed else "amber",
    )


def _facts(log: LogFacts) -> str:
    return f"{log.name}, {log.seconds:.0f} s"


# two simulators ----------------------------------------------------------------------------------------------------
def _of_simulators(found: SimulatorComparison, notes: Sequence[str]) -> Page:
    nearer = found.nearer
    title = "These drives cannot tell which simulator is nearer"
    if nearer is not None:
        which = found.first if nearer == "first" else found.second
        title = f"The {nearer} simulator is nearer to the car: {which.name}"
    table, differences = comparison_tables(found)
    ratios = {_row_name(n, found.horizon_s): e.ratio for n, e in found.errors.items()} | {"both": found.ratio}
    equal = (
        "An interval that crosses the dashed line cannot be told from equal errors; right of it the first is nearer."
    )
    remarks = [f"{which.name}: {note}" for which in (found.first, found.second) for note in which.notes]
    return Page(
        "Comparison",
        f"{_facts(found.log)}; first: {found.first.name}, second: {found.second.name}",
        Section(title, (found.why,), (_ratios("error of the second / of the first", ratios, table, equal),)),
        (
            Section("What makes the difference", tables=(differences,)),
            Section("The data", items=(*notes, *remarks)),
            Section(
                "Method and limits",
                items=(
                    f"Errors are of rollouts over {found.horizon_s:.3g} s from logged commands; intervals are of the "
                    f"scatter between {found.blocks} blocks of the drives.",
                    "A difference is put into the farther simulator as the nearer one has it; its factor is the mean "
                    "over all orders in which the differences can be put in.",
                ),
            ),
        ),
    )


def _side(values: Mapping[str, float] | None) -> str:
    if values is None:
        return "none"
    return ", ".join(f"{words_of(key)} {x:.3g}{unit_behind(key)}" for key, x in values.items())


# both --------------------------------------------------------------------------------------------------------------
def _ratios(what: str, ratios: Mapping[str, Quantity], table: Table, caption: str) -> Picture:
    from avtorch.plots.diagnosis import ratio_figure

    told = "; ".join(f"{name} {_told(q)}" for name, q in ratios.items())
    return picture_of(
        "ratios",
        ratio_figure(ratios, what),
        table,
        says=f"Ratios {what} with their 90 % intervals, beside one: {told}.",
        caption=caption,
        opened=True,
    )


def _row_name(name: str, horizon_s: float) -> str:
    return _ROWS.get(name, name).format(horizon=f"{horizon_s:.3g}")


def _told(q: Quantity) -> str:
    return f"{q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})"
