"""The page of a comparison: two sets of drives, or two simulators on one log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from avtorch.gap.quantity import Quantity, unit_of, words_of
from avtorch.plots.ratios import ratio_figure
from avtorch.report.answer_page import AnswerPage, Section, Tone, answer_html, written
from avtorch.report.origin import Origin
from avtorch.report.picture import Picture, picture_of
from avtorch.report.table import Table

if TYPE_CHECKING:
    from avtorch.external import SimulatorComparison
    from avtorch.gap.answer.change import ChangeCause
    from avtorch.gap.result.comparison import Comparison
    from avtorch.gap.result.log_facts import LogFacts

_ROWS = {
    "T_L": "lag T_L [s]",
    "K_L": "gain K_L [-]",
    "rollout_rmse_accel": "acceleration error, {horizon} s [m/s²]",
    "rollout_rmse_speed": "speed error, {horizon} s [m/s]",
}
_OF_SIMULATOR: Mapping[str, tuple[str, Tone]] = {
    "closer": ("the simulator is closer to the car after", "green"),
    "farther": ("the simulator is farther from the car after", "amber"),
    "inconclusive": ("whether the simulator is closer cannot be told", "blue"),
}
_ONE_DRIVE = {
    "closer": "The simulator after is closer to the car",
    "farther": "The simulator after is farther from the car",
    "inconclusive": "Which simulator is closer to the car cannot be told",
}


def comparison_html(
    found: Comparison | SimulatorComparison, *, notes: Sequence[str] = (), origin: Origin | None = None
) -> str:
    """The page of a comparison as text; `notes`: on the data.

    Example:
        >>> from avtorch import GLVDPlant, Leader, compare, simulate
        >>> from avtorch.report import comparison_html
        >>> drives = [simulate(Leader.default(start=30.0, duration=60.0, dt=0.1), seeds=[s]).log() for s in (0, 1)]
        >>> "No change of T_L and K_L is detected" in comparison_html(compare(*drives))
        True
    """
    from avtorch.gap.result.comparison import Comparison

    page = _of_drives(found, notes) if isinstance(found, Comparison) else _of_simulators(found, notes)
    return answer_html(page, origin=origin)


def write_comparison_page(
    found: Comparison | SimulatorComparison,
    folder: str | PathLike[str],
    *,
    notes: Sequence[str] = (),
    origin: Origin | None = None,
) -> Path:
    """Write `comparison.html` into `folder`; returns its path. Raises `InputError` where it cannot be written.

    Example:
        >>> from avtorch import GLVDPlant, Leader, compare, simulate
        >>> from avtorch.report import write_comparison_page
        >>> drives = [simulate(Leader.default(start=30.0, duration=60.0, dt=0.1), seeds=[s]).log() for s in (0, 1)]
        >>> write_comparison_page(compare(*drives), "out").name
        'comparison.html'
    """
    return written(comparison_html(found, notes=notes, origin=origin), folder, "comparison.html")


# two sets of drives ------------------------------------------------------------------------------------------------
def _of_drives(found: Comparison, notes: Sequence[str]) -> AnswerPage:
    said, tone = _OF_SIMULATOR[found.simulator]
    one_drive = found.before == found.after
    car = "The car has changed" if found.changed else "No change of T_L and K_L is detected"
    heading = _ONE_DRIVE[found.simulator] if one_drive else f"{car}; {said}"
    moved = {**found.car, **found.gap}
    names = [_ROWS.get(name, name).format(horizon=f"{found.horizon_s:.3g}") for name in moved]
    columns = ("quantity", "before (90 %)", "after (90 %)", "after / before (90 %)")
    rows = tuple(
        (name, *(_told(q) for q in (m.before, m.after, m.ratio))) for name, m in zip(names, moved.values(), strict=True)
    )
    table = Table("Before and after", columns, rows, numeric=columns[1:])
    ratios = {n: m.ratio for n, m in zip(names, moved.values(), strict=True)}
    none = "An interval that crosses the dashed line cannot be told from no change."
    picture = _ratios("after / before", ratios, table, none)
    return AnswerPage(
        "Comparison",
        _facts(found.before) if one_drive else f"before: {_facts(found.before)}; after: {_facts(found.after)}",
        Section(heading, (found.why,), (picture,)),
        (
            _cause(found.cause, found.why),
            Section("The data", items=tuple(notes)),
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


def _cause(cause: ChangeCause | None, told: str) -> Section:
    """What the sentences `told` above do not say of it."""
    if cause is None:
        return Section("What has changed")
    lines = () if cause.why in told else (cause.why,)
    columns = ("what", "probability", *_SIDES, "cannot be told from")
    rows = []
    for part in cause.parts:
        sides = {side: "" for side in _SIDES}
        for key, q in part.parameters.items():
            side = next((s for s in ("before", "after") if key.startswith(s)), "change")
            word = "" if key.startswith(side) else f"{words_of(key)} "
            sides[f"{side} (90 %)"] += f"{'; ' if sides[f'{side} (90 %)'] else ''}{word}{_told(q)}{_unit(key)}"
        alike = ", ".join(name for name in part.alias_set if name != part.name) or "nothing"
        name = f"{'less ' if part.less else ''}{part.name}"
        rows.append((name, f"{part.probability:.2f}", *sides.values(), alike))
    if rows:
        table = Table("Parts of the change", columns, tuple(rows), numeric=("probability",))
        return Section("What has changed", lines, tables=(table,))
    from avtorch.gap.answer.change import detectable_text

    least = tuple(
        f"Least change of {name} that would show: {detectable_text(name, x)}." for name, x in cause.detectable.items()
    )
    return Section("What has changed", lines, items=least)


_SIDES = ("before (90 %)", "after (90 %)", "change (90 %)")


# two simulators ----------------------------------------------------------------------------------------------------
def _of_simulators(found: SimulatorComparison, notes: Sequence[str]) -> AnswerPage:
    nearer = found.nearer
    title = "These drives cannot tell which simulator is nearer"
    if nearer is not None:
        which = found.first if nearer == "first" else found.second
        title = f"The {nearer} simulator is nearer to the car: {which.name}"
    names = [_ROWS[name].format(horizon=f"{found.horizon_s:.3g}") for name in found.errors]
    columns = ("error", "first (90 %)", "second (90 %)", "second / first (90 %)")
    rows = [
        (name, *(_told(q) for q in (e.first, e.second, e.ratio)))
        for name, e in zip(names, found.errors.values(), strict=True)
    ]
    rows.append(("both, geometric mean", "", "", _told(found.ratio)))
    table = Table("Errors of the two", columns, tuple(rows), numeric=columns[1:])
    ratios = {n: e.ratio for n, e in zip(names, found.errors.values(), strict=True)}
    equal = (
        "An interval that crosses the dashed line cannot be told from equal errors; right of it the first is nearer."
    )
    picture = _ratios("error of the second / of the first", ratios | {"both": found.ratio}, table, equal)
    what = tuple(
        (
            ", ".join(d.parts),
            *(("", "") if len(d.parts) > 1 else (_side(d.first), _side(d.second))),
            f"× {_told(d.ratio)}",
        )
        for d in found.differences
    )
    titles = ("difference", "first", "second", "error of the farther (90 %)")
    differences = (Table("What the two have differently", titles, what),) if what else ()
    remarks = [f"{which.name}: {note}" for which in (found.first, found.second) for note in which.notes]
    return AnswerPage(
        "Comparison",
        f"{_facts(found.log)}; first: {found.first.name}, second: {found.second.name}",
        Section(title, (found.why,), (picture,)),
        (
            Section("What makes the difference", tables=differences),
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
    return ", ".join(f"{words_of(key)} {x:.3g}{_unit(key)}" for key, x in values.items())


# both --------------------------------------------------------------------------------------------------------------
def _ratios(what: str, ratios: Mapping[str, Quantity], table: Table, caption: str) -> Picture:
    told = "; ".join(f"{name} {_told(q)}" for name, q in ratios.items())
    return picture_of(
        "ratios",
        lambda narrow: ratio_figure(ratios, what, narrow=narrow),
        f"Ratios {what} with their 90 % intervals, beside one: {told}.",
        table,
        caption=caption,
        opened=True,
    )


def _told(q: Quantity) -> str:
    return f"{q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})"


def _unit(key: str) -> str:
    unit = unit_of(key)
    return "" if unit == "-" else f" {unit}"
