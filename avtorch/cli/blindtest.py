"""`avtorch blindtest`: sealed cases of a reference vehicle, answered by the diagnosis and its rivals, and the score."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from avtorch.cli.arguments import Json, Out, Quiet, free_folder, seed_number, whole_number
from avtorch.cli.background_table import background_notes, background_table
from avtorch.cli.blindtest_table import blindtest_notes, blindtest_table
from avtorch.cli.talk import Talk, write_answer
from avtorch.errors import InputError, quoted
from avtorch.numeral import numeral

RECORDED = Group("Recordings", sort_key=20)
Channels = Literal["both", "accel", "speed"]


def blindtest(
    *,
    n: Annotated[
        int | None, Parameter(name="--n", converter=whole_number, help="Number of cases; 20 hold the mix.")
    ] = None,
    seed: Annotated[
        int | None, Parameter(name="--seed", converter=whole_number, help="Seed of everything random.")
    ] = None,
    out: Out,
    signals: Annotated[Channels, Parameter(help="Which measured channels the logs hold.")] = "both",
    recorder: Annotated[
        Literal["ideal", "ordinary"],
        Parameter(help="ordinary: filters, quanta, vibration and lost rows as in real logs, drawn for each case."),
    ] = "ideal",
    mix: Annotated[
        str | None,
        Parameter(
            help="Kinds of case and their shares, none=0.5,several=0.5, or one kind; default: none=0.25,single=0.4,"
            "pair=0.2,outside=0.15. several: three to five causes at once."
        ),
    ] = None,
    rivals: Annotated[
        str | None,
        Parameter(
            help="all that are installed, none but the random guess, or names with commas between; default: all."
        ),
    ] = None,
    background: Annotated[
        list[Path] | None,
        Parameter(
            group=RECORDED,
            negative=(),
            consume_multiple=True,
            help="Recorded logs, LOG ..., in front of which known effects are put, in place of drawn cases.",
        ),
    ] = None,
    sizes: Annotated[
        str | None,
        Parameter(group=RECORDED, help="Sizes of these effects, 1 is clearly visible; default: 0.5,0.8,1.25."),
    ] = None,
    effects: Annotated[
        str | None, Parameter(group=RECORDED, help="Only these effects, NAME,NAME,...; default: all that can be.")
    ] = None,
    draws: Annotated[
        int | None,
        Parameter(
            group=RECORDED,
            converter=whole_number,
            help="How often effects with random times, roads or gusts are put in front; default: once.",
        ),
    ] = None,
    workers: Annotated[int, Parameter(converter=whole_number, help="Processes, one thread each.")] = 1,
    resume: Annotated[bool, Parameter(negative=(), help="Resume the trial in --out.")] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Does the diagnosis name causes that it cannot have seen?

    Draws cases from a reference vehicle that shares no code with the effects, lets the diagnosis and its rivals answer
    them, and scores the answers. They are kept as they come: --resume goes on after an interruption, or with a larger
    --n. With --background known effects are put in front of recorded cars instead, and each answer is held against the
    one to the untouched log.
    """
    recorded = background is not None
    if recorded:
        for name, given in (
            ("--n", n),
            ("--rivals", rivals),
            ("--recorder", None if recorder == "ideal" else recorder),
            ("--mix", mix),
        ):
            if given is not None:
                raise InputError(f"{name}: found {given} with --background, which draws no cases; needs one of the two")
    else:
        for name, given in (("--sizes", sizes), ("--effects", effects), ("--draws", draws)):
            if given is not None:
                raise InputError(f"{name}: found {quoted(str(given))} without --background; needs the recordings")
        if n is None:
            raise InputError("--n: missing; see avtorch blindtest --help")
        if n < 1:
            raise InputError(f"--n: found {n}, needs 1 case or more")
    if seed is None:
        raise InputError("--seed: missing; see avtorch blindtest --help")
    for name, count in (("--workers", workers), ("--draws", draws)):
        if count is not None and count < 1:
            raise InputError(f"{name}: found {count}, needs 1 or more")
    shares = None if mix is None else _shares(mix)
    seed_number(seed)
    free_folder(out)
    if (out / "trial.json").exists() and not resume:
        raise InputError(f"--out: {out} holds a trial; needs --resume to go on with it, or another folder")

    talk = Talk(json=json, quiet=quiet)
    try:
        if background is not None:
            answer = _recorded(background, seed, out, talk, signals, sizes, effects, draws or 1, workers)
        else:
            assert n is not None
            answer = _cases(n, seed, out, talk, signals, recorder, shares, "all" if rivals is None else rivals, workers)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"answers so far are kept in {out}, --resume goes on") from None
    talk.done(out, answer)


def _cases(
    n: int,
    seed: int,
    out: Path,
    talk: Talk,
    signals: Channels,
    recorder: Literal["ideal", "ordinary"],
    mix: Mapping[str, float] | None,
    rivals: str,
    workers: int,
) -> Mapping[str, Any]:
    from avtorch import plots, trial

    answerers = {"avtorch": trial.avtorch, **trial.rivals(rivals)}
    with talk.progress(f"{n} cases") as step:
        answer = trial.run_trial(
            n,
            seed,
            out,
            answerers=answerers,
            workers=workers,
            signals=("accel", "speed") if signals == "both" else (signals,),
            recorder=recorder,
            mix=mix,
            progress=step,
            publish=False,  # together with the picture
        )
    write_answer(out, "blindtest.json", answer, {"confusion.png": lambda: plots.confusion_figure(answer)})
    talk.out.print(blindtest_table(answer))
    for note in blindtest_notes(answer):
        talk.out.print(note, style="dim", markup=False)
    return answer


def _recorded(
    paths: list[Path],
    seed: int,
    out: Path,
    talk: Talk,
    signals: Channels,
    sizes: str | None,
    effects: str | None,
    draws: int,
    workers: int,
) -> Mapping[str, Any]:
    from dataclasses import replace

    from avtorch import trial
    from avtorch.io import Log

    wanted = trial.SIZES if sizes is None else _numbers(sizes)
    logs = [Log.read(path) for path in paths]
    if signals != "both":
        for log in logs:
            if getattr(log, signals) is None:
                raise InputError(f"{log.name}: has no {signals}, which --signals asks for")
        left_out = "speed" if signals == "accel" else "accel"
        logs = [replace(log, **{left_out: None}) for log in logs]
    with talk.progress(f"effects in front of {len(logs)} recording{'s' * (len(logs) > 1)}") as step:
        answer = trial.run_background(
            logs,
            seed,
            out,
            answerer=trial.avtorch,
            sizes=wanted,
            effects=None if effects is None else [name.strip() for name in effects.split(",")],
            draws=draws,
            workers=workers,
            progress=step,
            publish=False,
        )
    write_answer(out, "background.json", answer, {})
    talk.out.print(background_table(answer))
    for note in background_notes(answer):
        talk.out.print(note, style="dim", markup=False)
    return answer


def _numbers(text: str) -> list[float]:
    try:
        return [numeral(part.strip()) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--sizes: found {quoted(text)}, needs numbers such as 0.5,0.8,1.25") from None


def _shares(text: str) -> dict[str, float]:
    """Shares by kind: `none=0.5,several=0.5`, or one kind alone."""
    from avtorch.blindtest import KINDS

    if text.strip() in KINDS:
        return {text.strip(): 1.0}
    shares: dict[str, float] = {}
    for part in text.split(","):
        kind, _, share = (x.strip() for x in part.partition("="))
        try:
            number = numeral(share)
        except ValueError:
            number = -1.0
        if kind not in KINDS or kind in shares or not 0 <= number <= 1:
            break
        shares[kind] = number
    else:
        if abs(sum(shares.values()) - 1) <= 1e-9:
            return shares
    raise InputError(f"--mix: found {quoted(text)}, needs one of {', '.join(KINDS)}, or shares of them that sum to 1")
