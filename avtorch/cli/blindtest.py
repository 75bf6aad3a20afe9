"""`avtorch blindtest`: sealed cases of a reference vehicle, answered by the diagnosis and its rivals, and the score."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from avtorch.cli.arguments import Json, Out, Quiet, Seed, free_folder, seed_number, whole_number
from avtorch.cli.blindtest_table import blindtest_notes, blindtest_table
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError


def blindtest(
    *,
    n: Annotated[int, Parameter(name="--n", converter=whole_number, help="Number of cases; 20 hold the mix.")],
    seed: Seed,
    out: Out,
    signals: Annotated[
        Literal["both", "accel", "speed"], Parameter(help="Which measured channels the logs hold.")
    ] = "both",
    rivals: Annotated[
        str, Parameter(help="all that are installed, none but the random guess, or names with commas between.")
    ] = "all",
    workers: Annotated[int, Parameter(converter=whole_number, help="Processes, one thread each.")] = 1,
    resume: Annotated[bool, Parameter(negative=(), help="Resume the trial in --out.")] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Does the diagnosis name causes that it cannot have seen?

    Draws cases from a reference vehicle that shares no code with the effects, lets the diagnosis and its rivals answer
    them, and scores the answers. They are kept as they come: --resume goes on after an interruption, or with a larger
    --n.
    """
    if n < 1:
        raise InputError(f"--n: found {n}, needs 1 case or more")
    if workers < 1:
        raise InputError(f"--workers: found {workers}, needs 1 or more")
    seed_number(seed)
    free_folder(out)
    if (out / "trial.json").exists() and not resume:
        raise InputError(f"--out: {out} holds a trial; needs --resume to go on with it, or another folder")

    from avtorch import plots, trial

    answerers = {"avtorch": trial.avtorch, **trial.rivals(rivals)}
    talk = Talk(json=json, quiet=quiet)
    channels = ("accel", "speed") if signals == "both" else (signals,)
    try:
        with talk.progress(f"{n} cases") as step:
            answer = trial.run_trial(
                n,
                seed,
                out,
                answerers=answerers,
                workers=workers,
                signals=channels,
                progress=step,
                publish=False,  # together with the picture
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"answers so far are kept in {out}, --resume goes on") from None
    write_answer(out, "blindtest.json", answer, {"confusion.png": lambda: plots.confusion_figure(answer)})
    talk.out.print(blindtest_table(answer))
    for note in blindtest_notes(answer):
        talk.out.print(note, style="dim", markup=False)
    talk.done(out, answer)
