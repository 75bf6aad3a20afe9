"""Arguments that commands share, and the checks that turn a bad one into one line; the command as it was given."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Group, Parameter, Token

from avtorch.errors import InputError, quoted
from avtorch.numeral import numeral

if TYPE_CHECKING:
    from avtorch.report import Origin

OUTPUT = Group("Output", sort_key=9)
COMMAND_LINE: ContextVar[str | None] = ContextVar("command_line", default=None)
"""The command, quoted for a shell, for answers that tell how they were made; None outside one."""


def whole_number(_: Any, tokens: Sequence[Token]) -> int:
    """The parser itself would round 1.5 to a seed of its own."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"found {tokens[0].value!r}, needs a whole number") from None


def is_address(text: str) -> bool:
    """Whether `text` is a URL, `s3://bucket/out` or `file:///tmp/out`, and no path; `C://out` is a path."""
    return re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", text) is not None


def local_folder(_: Any, tokens: Sequence[Token]) -> Path:
    """A path would make a folder `s3:` of s3://bucket/out."""
    text = tokens[0].value
    if is_address(text):
        raise ValueError(f"found {quoted(text)}; output is local: needs a folder of this machine, such as out/fleet")
    return Path(text)


Out = Annotated[
    Path,
    Parameter(name="--out", group=OUTPUT, converter=local_folder, help="Folder for the answer and the pictures."),
]
Columns = Annotated[
    list[str] | None,
    Parameter(negative=(), help="Name of a column, SIGNAL=COLUMN, such as accel=ACC_X; repeatable."),
]
Units = Annotated[
    list[str] | None, Parameter(negative=(), help="Unit of a column, SIGNAL=UNIT, such as speed=km/h; repeatable.")
]
Stamps = Annotated[
    list[str] | None, Parameter(negative=(), help="Own time column of a signal, SIGNAL=COLUMN; repeatable.")
]
Open = Annotated[bool, Parameter(name="--open", negative=(), group=OUTPUT, help="Show the page in your browser.")]
Verbose = Annotated[
    bool, Parameter(name=("--verbose", "-v"), negative=(), group=OUTPUT, help="Print all that was found.")
]
Json = Annotated[bool, Parameter(name="--json", negative=(), group=OUTPUT, help="Print the answer as JSON, no tables.")]
Quiet = Annotated[bool, Parameter(name=("--quiet", "-q"), negative=(), group=OUTPUT, help="Print nothing but errors.")]
Seed = Annotated[int, Parameter(name="--seed", converter=whole_number, help="Seed of everything random.")]
Gains = Annotated[str, Parameter(name="--gains", help="Gains k_s,k_v,k_a of the upper level.")]
Lag = Annotated[float, Parameter(name="--T", help="Actuation lag T_L [s].")]
Gain = Annotated[float, Parameter(name="--K", help="Actuation gain K_L [-].")]
TimeGap = Annotated[float, Parameter(name="--tau", help="Time gap [s].")]


def positive(name: str, value: float, unit: str = "") -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name}: found {value:g}, needs a finite number above 0 {unit}".rstrip())


def not_negative(name: str, value: float, unit: str = "") -> None:
    if not (math.isfinite(value) and value >= 0):
        raise InputError(f"{name}: found {value:g}, needs a finite number of 0 {unit} or more".replace("  ", " "))


def seed_number(seed: int) -> None:
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: found {seed}, needs a whole number from 0 to 2^63 - 1")


def _numbers(name: str, text: str, count: int, needs: str, fits: Callable[[list[float]], bool]) -> list[float]:
    """`count` finite numbers between commas, which `fits`. Raises `InputError` that says what it `needs`."""
    try:
        values = [numeral(part.strip()) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)) or not fits(values):
        raise InputError(f"{name}: found {quoted(text)}, needs {needs}")
    return values


def three_gains(name: str, text: str) -> tuple[float, float, float]:
    k_s, k_v, k_a = _numbers(name, text, 3, "three numbers k_s,k_v,k_a such as 1.5,1.5,-0.8", lambda _: True)
    return k_s, k_v, k_a


def positive_pair(name: str, text: str, of: str, example: str) -> tuple[float, float]:
    one, two = _numbers(name, text, 2, f"two numbers {of} above 0 such as {example}", lambda x: min(x) > 0)
    return one, two


def limits_pair(name: str, text: str) -> tuple[float, float]:
    """Two numbers, the first below zero and the second above."""
    needs = "MIN,MAX [m/s²] below and above 0, such as -6,4"
    low, high = _numbers(name, text, 2, needs, lambda x: x[0] < 0 < x[1])
    return low, high


def two_axes(text: str) -> tuple[str, str]:
    known = ("k_s", "k_v", "k_a", "tau", "T", "K")
    names = tuple(part.strip() for part in text.split(","))
    if len(names) != 2 or names[0] == names[1] or not set(names) <= set(known):
        raise InputError(
            f"--plane: found {quoted(text)}, needs two different names out of {', '.join(known)} such as tau,T"
        )
    return names[0], names[1]


def free_folder(out: Path, *, without: str | None = None) -> None:
    """Refuse a place that cannot become a folder before any work is done; nothing is made yet.

    `without`: an answer that must not be in the folder already, because its pictures have the same names as this one's.
    """
    if without is not None and (out / without).exists():
        raise InputError(f"--out: {out} holds {without}, and pictures of the same names; needs another folder")
    for place in (out, *out.parents):
        if place.exists():
            if not place.is_dir():
                what = "a file" if place == out else f"inside {place}, which is a file"
                raise InputError(f"--out: {out} is {what}; needs a folder, or a name that is free")
            return


def origin_of(paths: Sequence[Path], **settings: Any) -> Origin:
    """How an answer is made, by the files as they are now; a log's mapping file is one of them."""
    from avtorch.io.mapping import mapping_beside
    from avtorch.report import Origin

    beside = [place for place in (mapping_beside(path) for path in paths) if place is not None]
    return Origin.of(COMMAND_LINE.get(), [*paths, *beside], settings)
