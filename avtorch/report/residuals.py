"""What is left of the gap, as a section of the diagnosis's page: residuals without and with what was named."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.residuals import BLOCK_S, BinnedMeans, Residuals
from avtorch.plots import drive
from avtorch.report.page import Picture, Section, picture_of, small_picture
from avtorch.report.table import Table, of_numbers

_PARTS = 12  # of the drive, rows of its table
_ROWS = 15  # of a table behind a line
_LEAST = 100  # rows from which there is something to see


def residuals(found: Diagnosis) -> Section:
    """The residuals of a diagnosis; nothing where there is too little to show."""
    title = "What is left: residuals"
    if found.traces is None or len(found.traces.time) < _LEAST:
        return Section(title)
    left = drive.residuals_of(found)
    if len(left.time) < _LEAST:
        return Section(title)
    both = drive.sides(found, left)
    against: list[tuple[drive.Against, FloatArray]] = [("command", left.command)]
    if left.speed is not None:
        against.append(("speed", left.speed))
    pictures = [_against(found, left, both, name, axis) for name, axis in against]
    pictures.append(_correlation(found, left, both))
    if left.spectrum(list(both.values())[-1]) is not None:
        pictures.append(_spectrum(found, left, both))
    return Section(title, _what_is_left(left, both), (_over_time(found, left, both),), tuple(pictures))


def _what_is_left(left: Residuals, both: Mapping[str, FloatArray]) -> tuple[str, ...]:
    what = (
        "Measured acceleration less that of a rollout over the whole drive"
        if left.channel == "accel"
        else "Slope over 1 s of the measured speed less that of a rollout over the whole drive"
    )
    sizes = [f"{np.sqrt(np.mean(residual**2)):.2g} m/s² {label}" for label, residual in both.items()]
    said = [f"{what}: {', '.join(sizes)} (root mean square)."]
    judged = list(both.values())[-1]
    shows = [
        name
        for name, axis in (("command", left.command), ("speed", left.speed))
        if axis is not None and _apart(left.against(axis, judged))
    ]
    outside = left.correlation(judged)
    late = outside.lag[(outside.lag >= 0) & (np.abs(outside.value) > outside.band)]
    who = "The simulator with what was named" if len(both) > 1 else "The baseline simulator"
    if shows:
        said.append(f"{who} still errs by more than chance at some {' and some '.join(f'{x}s' for x in shows)}.")
    if len(late):
        said.append(f"Its residual still follows commands of {late[0]:.1f} to {late[-1]:.1f} s before.")
    if not shows and not len(late):
        said.append("It depends neither on the command, nor on the speed, by more than chance would.")
    return tuple(said)


def _apart(bins: BinnedMeans) -> bool:
    """Whether more bins than chance would exclude 0: of 90 % intervals, one in ten does."""
    known = np.isfinite(bins.low)
    return int(((bins.low > 0) | (bins.high < 0))[known].sum()) > max(2, 0.3 * int(known.sum()))


def _over_time(found: Diagnosis, left: Residuals, both: Mapping[str, FloatArray]) -> Picture:
    columns = ("part of the drive [s]", *(f"{what} {label} [m/s²]" for label in both for what in ("mean", "SD")))
    rows = [
        (
            f"{left.time[part[0]]:.0f} to {left.time[part[-1]]:.0f}",
            *(f"{size:.3f}" for residual in both.values() for size in (residual[part].mean(), residual[part].std())),
        )
        for part in np.array_split(np.arange(len(left.time)), _PARTS)
    ]
    label, judged = list(both.items())[-1]
    usual = left.usual(judged)
    beyond = f"{100 * float(np.mean(np.abs(judged) > usual)):.1f} %"
    return picture_of(
        "residual-time",
        lambda narrow: drive.residual_time_figure(found, narrow=narrow),
        f"Lines of the residual over the whole drive: {', '.join(both)}. {beyond} of the rows {label} lie beyond "
        f"{usual:.2g} m/s².",
        Table("Residual in parts of the drive", columns, tuple(rows), numeric=columns[1:]),
        caption="Grey ground: where 99 % of a steady normal residual with the quartiles of the last line would lie; "
        f"{beyond} lie beyond.",
    )


def _against(
    found: Diagnosis, left: Residuals, both: Mapping[str, FloatArray], name: drive.Against, axis: FloatArray
) -> Picture:
    unit = "m/s²" if name == "command" else "m/s"
    rows, says = [], []
    for label, residual in both.items():
        bins = left.against(axis, residual)
        worst = int(np.abs(bins.mean).argmax())
        says.append(f"{label} up to {bins.mean[worst]:.2g} m/s² at {bins.place[worst]:.2g} {unit}")
        for place, mean, low, high in zip(bins.place, bins.mean, bins.low, bins.high, strict=True):
            within = f" ({low:.3f} to {high:.3f})" if np.isfinite(low) else ""
            rows.append((f"{place:.3g} {unit}", label, f"{mean:.3f}{within}"))
    return small_picture(
        f"residual-{name}",
        drive.residual_figure(found, name),
        f"Lines of the mean residual over the {name}: {', '.join(says)}.",
        Table(f"Mean residual by {name}", (name, "simulator", "mean residual (90 %) [m/s²]"), tuple(rows)),
        caption=f"Against the {name}: means of as many rows each; bands are 90 %, by blocks of {BLOCK_S:.0f} s.",
    )


def _correlation(found: Diagnosis, left: Residuals, both: Mapping[str, FloatArray]) -> Picture:
    each = {label: left.correlation(residual) for label, residual in both.items()}
    last = list(each.values())[-1]
    few = np.linspace(0, len(last.lag) - 1, _ROWS).astype(int)
    says = ", ".join(f"{label} {x.value[np.abs(x.value).argmax()]:.2f} at the most" for label, x in each.items())
    return small_picture(
        "residual-correlation",
        drive.residual_figure(found, "earlier commands"),
        f"Lines of the residual's correlation with the command: {says}; by chance up to {last.band:.2f}.",
        of_numbers(
            f"Correlation with the command, by chance up to {last.band:.2f}",
            ("time since the command [s]", *each),
            np.column_stack([last.lag, *(x.value for x in each.values())])[few].tolist(),
            (".2f", *(".3f" for _ in each)),
        ),
        caption="Against earlier commands: a residual beyond the grey ground, 99 % of what chance does, follows the "
        "command in a way that the simulator does not.",
    )


def _spectrum(found: Diagnosis, left: Residuals, both: Mapping[str, FloatArray]) -> Picture:
    each = {label: x for label, residual in both.items() if (x := left.spectrum(residual)) is not None}
    last = list(each.values())[-1]
    few = np.unique(np.geomspace(1, len(last.frequency), _ROWS).astype(int)) - 1
    says = ", ".join(f"{label} most at {x.frequency[x.power.argmax()]:.2g} Hz" for label, x in each.items())
    return small_picture(
        "residual-frequency",
        drive.residual_figure(found, "frequency"),
        f"Lines of the residual's power over frequency: {says}.",
        of_numbers(
            "Power of the residual",
            ("frequency [Hz]", *(f"{label} [(m/s²)²/Hz]" for label in each)),
            np.column_stack([last.frequency, *(x.power for x in each.values())])[few].tolist(),
            (".3g", *(".3g" for _ in each)),
        ),
        caption="Against frequency: power averaged over windows of 20 s; bands are 90 %.",
    )
