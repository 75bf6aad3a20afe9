"""`avtorch paper`: the paper's figures and tables run anew, each claim with a verdict."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from avtorch.cli import arguments as arg
from avtorch.cli.talk import Talk, write_answer

if TYPE_CHECKING:
    from avtorch.report.table import Table

Name = Literal["all", "regions", "estimation", "monitoring", "strategies", "gains", "platoon"]


def paper(
    name: Name = "all",
    *,
    out: arg.Out,
    data: Annotated[
        Path | None,
        arg.option("Folder that holds ngsim and the OpenACC platoons; default: AVTORCH_DATA, or US06 without one."),
    ] = None,
    seeds: Annotated[int, arg.whole("Noise seeds of every setting.", least=2)] = 20,
    seed: arg.Seed = 0,
    json: arg.Json = False,
    quiet: arg.Quiet = False,
) -> None:
    """Repeat the paper's experiments, and report of each claim: same, better, or not reproduced.

    All of them take some minutes, and are equal by seed. Pictures and paper.json are written.

    Parameters
    ----------
    name
        all, or one: stability regions, estimation sweep, monitoring, strategies, what the gains do, a platoon of ten.
    """
    recorded = data or (Path(os.environ["AVTORCH_DATA"]) if os.environ.get("AVTORCH_DATA") else None)

    from avtorch.paper import Leaders, reproduce

    leaders = Leaders.read(recorded)
    talk = Talk(json=json, quiet=quiet)
    with talk.progress("Reproducing") as step:
        found = reproduce(None if name == "all" else [name], leaders=leaders, seeds=seeds, seed=seed, progress=step)
    answer = found.answer()

    from avtorch.plots import paper_pictures

    write_answer(out, "paper.json", answer, paper_pictures(found.found))
    talk.notes("Leaders", [f"{name}: {which}" for name, which in answer["leaders"].items()])
    talk.table(counts_table(answer) if name == "all" else rows_table(answer))
    talk.lines(missed(answer))
    talk.done(out, answer)


def counts_table(answer: Mapping[str, Any]) -> Table:
    """Counts of the claims of each experiment by verdict."""
    from avtorch.report.table import Table

    verdicts = ("same", "better", "not reproduced")
    rows = []
    for name in (*dict.fromkeys(row["name"] for row in answer["rows"]), "all"):
        counts = Counter(row["verdict"] for row in answer["rows"] if name in (row["name"], "all"))
        rows.append((name, str(counts.total()), *(str(counts[verdict]) for verdict in verdicts)))
    columns = ("experiment", "rows", *verdicts)
    return Table("The paper's claims", columns, tuple(rows), numeric=columns[1:], marked=(len(rows) - 1,))


def rows_table(answer: Mapping[str, Any]) -> Table:
    """One row per claim: quantity and place, the paper's value, ours with its 90 % interval, the verdict."""
    from avtorch.report.table import Table

    rows = [
        (f"{row['quantity']} ({row['setting']})", formatted(row["paper"]), here(row), row["verdict"])
        for row in answer["rows"]
    ]
    soft = [i for i, row in enumerate(answer["rows"]) if row["verdict"] == "not reproduced"]
    return Table("The paper's claims", ("claim", "paper", "here (90 %)", "verdict"), tuple(rows), soft=soft)


def missed(answer: Mapping[str, Any]) -> list[str]:
    """What was not reproduced, and why."""
    rows = [row for row in answer["rows"] if row["verdict"] == "not reproduced"]
    if not rows:
        return ["Everything was reproduced."]
    found = [f"  {row['name']}: {row['quantity']} ({row['setting']}) is {here(row)}; {row['why']}" for row in rows]
    return ["Not reproduced:", *found]


def here(row: Mapping[str, Any]) -> str:
    """Our figure with its interval."""
    if row["interval"] is None:
        return formatted(row["ours"])
    low, high = (formatted(x) for x in row["interval"])
    return f"{formatted(row['ours'])} ({low} to {high})"


def formatted(value: Any) -> str:
    """A number in three digits, four around one (a peak gain of 1.077 must not read as one), or words as they are."""
    if isinstance(value, str):
        return value
    return f"{value:.4g}" if 0.9 < abs(value) < 2 else f"{value:.3g}"
