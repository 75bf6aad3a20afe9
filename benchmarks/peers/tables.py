"""The tables in text and in Markdown, and the aims with their verdicts."""

from __future__ import annotations

import math
from typing import Any

from benchmarks.peers.score import WANTED
from benchmarks.peers.single import Row

Table = tuple[list[str], list[list[str]]]


def number(value: float | None, form: str = "{:.3g}") -> str:
    return "-" if value is None or math.isnan(value) else form.format(value)


def times(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.0f} x" if value >= 10 else f"{value:.2g} x"


def one_window(rows: list[Row]) -> Table:
    """Table 1, ratios against the row of avtorch."""
    head = [
        "method",
        "wall [ms]",
        f"to {WANTED} ESS [ms]",
        "against avtorch",
        "first call [s]",
        "ESS bulk",
        "ESS tail",
        "ESS/s",
        "mean diff [SD]",
        "SD ratio",
        "memory [MB]",
    ]
    return head, [_cells(row, rows) for row in rows]


def many_windows(rows: list[Row]) -> Table:
    """Table 2: cost per window."""
    head, _ = one_window([])
    head = [head[0], "windows", "wall [ms/window]", f"to {WANTED} ESS [ms/window]", *head[3:]]
    pairs = [(row, _cells(row, rows)) for row in rows]
    body = [[c[0], row.why, *c[2:], ""] if row.why else [c[0], str(row.windows), *c[1:]] for row, c in pairs]
    return head, body


def _cells(row: Row, rows: list[Row]) -> list[str]:
    if row.why:
        return [row.title, row.why, *[""] * 9]
    own = next((r for r in rows if r.method == "avtorch" and not r.why), None)
    ratio = row.seconds_wanted / own.seconds_wanted if own is not None else math.nan
    scaled = "" if math.isnan(row.bulk) or row.bulk >= WANTED else " *"
    return [
        row.title,
        number(1e3 * row.seconds),
        number(1e3 * row.seconds_wanted) + scaled,
        times(ratio),
        number(row.first_s, "{:.2f}"),
        number(row.bulk, "{:.0f}"),
        number(row.tail, "{:.0f}"),
        number(row.bulk / row.seconds, "{:,.0f}"),
        number(row.shift, "{:.3f}"),
        f"{number(row.ratio_low, '{:.3f}')} to {number(row.ratio_high, '{:.3f}')}",
        number(row.peak_mb, "{:.0f}"),
    ]


def growth(found: dict[str, Any]) -> list[Table]:
    """Tables 3 and 4."""
    tables: list[Table] = []
    for name in ("windows", "chains", "points"):
        head = [name, "statistics [ms]", "mode [ms]", "sampling [ms]", "total [ms]"]
        head += ["per window [ms]"] if name == "windows" else []
        body = []
        for row in found[name]:
            keys = ("statistics_s", "mode_s", "sampling_s", "total_s")
            cells = [f"{row[name]:,}", *(number(1e3 * row[key]) for key in keys)]
            body.append([*cells, number(1e3 * row["total_s"] / row[name])] if name == "windows" else cells)
        tables.append((head, body))
    head = [
        "points",
        "arm",
        "batch",
        "step h",
        "a step [ms]",
        "steps",
        f"to {WANTED} ESS [s]",
        "against full",
        "SD ratio",
    ]
    body = [
        [
            f"{row['points']:,}",
            row["kind"],
            "all" if row["batch"] is None else str(row["batch"]),
            number(row["step"]),
            number(1e3 * row["step_s"]),
            f"{row['steps']:,}",
            number(row["seconds"]),
            times(row["against_full"]),
            number(row.get("sd_ratio"), "{:.3f}") if "sd_ratio" in row else "not run",
        ]
        for row in found["minibatch"]
    ]
    return [*tables, (head, body)]


def details(rows: list[Row]) -> list[str]:
    """Settings of every row and the other settings tried."""
    lines = []
    for row in rows:
        if row.why:
            continue
        same = "" if row.density_error is None else f"; log density equal to {row.density_error:.0e}"
        lines.append(f"{row.title}: {row.settings or 'default'}; import {row.import_s:.1f} s{same}")
        for trial in row.trials if len(row.trials) > 1 else []:
            verdict = "" if trial["accurate"] else ", not accurate"
            lines.append(f"    tried {trial['settings']}: {1e3 * trial['seconds_wanted']:.1f} ms{verdict}")
    return lines


def text(table: Table) -> str:
    head, body = table
    # a row with a reason in place of figures does not widen the columns
    figures = [cells for cells in [head, *body] if not _reason(cells)]
    widths = [max(len(cells[0]) for cells in [head, *body])]
    widths += [max(len(cells[i]) for cells in figures) for i in range(1, len(head))]
    lines = []
    for cells in [head, *body]:
        rest = [cells[1]] if _reason(cells) else [f"{c:>{w}}" for c, w in zip(cells[1:], widths[1:], strict=True)]
        lines.append("  ".join([f"{cells[0]:<{widths[0]}}", *rest]))
    return "\n".join(lines)


def _reason(cells: list[str]) -> bool:
    return len(cells) > 2 and not any(cells[2:])


def markdown(table: Table) -> str:
    head, body = table
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join(["---", *["---:"] * (len(head) - 1)]) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(cells) + " |" for cells in body)])
