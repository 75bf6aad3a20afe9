"""`avtorch paper`: the paper's figures and tables run anew, each claim with a verdict."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from avtorch.cli.arguments import Json, Out, Quiet, Seed, free_folder, seed_number, whole_number
from avtorch.cli.paper_table import counts_table, missed, rows_table
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError

Name = Literal["all", "regions", "estimation", "monitoring", "strategies", "gains", "platoon"]


def paper(
    name: Name = "all",
    *,
    out: Out,
    data: Annotated[
        Path | None,
        Parameter(help="Folder that holds ngsim and the OpenACC platoons; default: AVTORCH_DATA, or US06 without one."),
    ] = None,
    seeds: Annotated[int, Parameter(converter=whole_number, help="Noise seeds of every setting.")] = 20,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Repeat the paper's experiments, and report of each claim: same, better, or not reproduced.

    All of them take some minutes, and are equal by seed. Pictures and paper.json are written.

    Parameters
    ----------
    name
        all, or one: stability regions, estimation sweep, monitoring, strategies, what the gains do, a platoon of ten.
    """
    if seeds < 2:
        raise InputError(f"--seeds: found {seeds}, needs 2 or more")
    seed_number(seed)
    free_folder(out)
    recorded = data or (Path(os.environ["AVTORCH_DATA"]) if os.environ.get("AVTORCH_DATA") else None)

    from avtorch.paper import Leaders, reproduce

    leaders = Leaders.read(recorded)
    talk = Talk(json=json, quiet=quiet)
    with talk.progress("Reproducing") as step:
        found = reproduce(None if name == "all" else [name], leaders=leaders, seeds=seeds, seed=seed, progress=step)
    answer = found.answer()

    from avtorch.plots import PAPER_PICTURES, paper_pictures

    write_answer(out, "paper.json", answer, paper_pictures(found.found), also=PAPER_PICTURES)
    talk.notes("Leaders", [f"{name}: {which}" for name, which in answer["leaders"].items()])
    talk.out.print(counts_table(answer) if name == "all" else rows_table(answer))
    for note in missed(answer):
        talk.out.print(note, markup=False)
    talk.done(out, answer)
