"""Options that commands share, each with its check and its help; the command as it was given."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter, Token

from avtorch.errors import InputError, quoted
from avtorch.numeral import numeral

if TYPE_CHECKING:
    from avtorch.report import Origin

OUTPUT = Group("Output", sort_key=9)
COMMAND_LINE: ContextVar[str | None] = ContextVar("command_line", default=None)
"""The command, quoted for a shell, for answers that tell how they were made; None outside one."""
_HOW_SHOWN = ("out", "open_page", "json", "quiet", "verbose", "resume")
"""Options that change nothing in an answer."""


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


def option(help: str, group: Group | None = None, **more: Any) -> Parameter:
    """Of a value, a list, or something to switch on, which has no negative."""
    # None would be a group, too: one that help leaves out
    return Parameter(help=help, negative=(), **(more if group is None else {"group": group, **more}))


def whole(help: str, *, least: int | None = None, **more: Any) -> Parameter:
    """Of a whole number."""
    check = None if least is None else _checked(lambda x: x >= least, f"{least} or more")
    return option(help, converter=whole_number, validator=check, **more)


def above_zero(help: str, unit: str = "", **more: Any) -> Parameter:
    """Of a finite number above zero."""
    needs = f"a finite number above 0 {unit}".rstrip()
    return option(help, validator=_checked(lambda x: math.isfinite(x) and x > 0, needs), **more)


def zero_or_more(help: str, unit: str = "", **more: Any) -> Parameter:
    """Of a finite number that is not below zero."""
    needs = f"a finite number of 0 {unit} or more".replace("  ", " ")
    return option(help, validator=_checked(lambda x: math.isfinite(x) and x >= 0, needs), **more)


def _checked(fits: Callable[[Any], bool], needs: str) -> Callable[[Any, Any], None]:
    """The check of an option that is given: what `fits` it, and what it `needs` in words."""

    def check(_: Any, value: float | None) -> None:
        if value is not None and not fits(value):
            found = f"{value:g}" if isinstance(value, float) else value
            raise ValueError(f"found {found}, needs {needs}")

    return check


_is_seed = _checked(lambda x: 0 <= x < 2**63, "a whole number from 0 to 2^63 - 1")

Out = Annotated[Path, option("Folder for the answer and its files.", OUTPUT, name="--out", converter=local_folder)]
Columns = Annotated[list[str] | None, option("Name of a column, SIGNAL=COLUMN, such as accel=ACC_X; repeatable.")]
Units = Annotated[list[str] | None, option("Unit of a column, SIGNAL=UNIT, such as speed=km/h; repeatable.")]
Stamps = Annotated[list[str] | None, option("Own time column of a signal, SIGNAL=COLUMN; repeatable.")]
Open = Annotated[bool, option("Show the page in your browser.", OUTPUT, name="--open")]
Verbose = Annotated[bool, option("Print all that was found.", OUTPUT, name=("--verbose", "-v"))]
Json = Annotated[bool, option("Print the answer as JSON, no tables.", OUTPUT, name="--json")]
Quiet = Annotated[bool, option("Print nothing but errors.", OUTPUT, name=("--quiet", "-q"))]
Seed = Annotated[int, option("Seed of everything random.", name="--seed", converter=whole_number, validator=_is_seed)]
Gains = Annotated[str, option("Gains k_s,k_v,k_a of the upper level.", name="--gains")]
Lag = Annotated[float, above_zero("Actuation lag T_L [s].", "s", name="--T")]
Gain = Annotated[float, above_zero("Actuation gain K_L [-].", name="--K")]
TimeGap = Annotated[float, above_zero("Time gap [s].", "s", name="--tau")]
Window = Annotated[float, above_zero("Length of a window [s].", "s")]
Accepted = Annotated[str, option("T_L,K_L of the car as it should be, which accepted_change compares with [s, -].")]
DeadTime = Annotated[
    float | None,
    zero_or_more("Dead time of the car [s], if known; by default inferred where jerk is not measured.", "s"),
]
Form = Annotated[
    Literal["auto", "jerk", "latent"], option("Likelihood: of measured jerk, or of noisy acceleration and speed.")
]
Estimator = Annotated[
    Literal["auto", "sgld", "importance", "map", "rls", "ekf", "ukf"],
    option(
        "SGLD, importance sampling, posterior mode, recursive least squares, extended or unscented Kalman "
        "filter; auto: SGLD where jerk is measured, else importance sampling."
    ),
]
Mode = Annotated[Literal["lambda", "posterior", "forgetting"], option("How a posterior becomes the next prior.")]
Baseline = Annotated[str, option("Your simulator: glvd, effects such as dead_time=0.2, or a TOML file.")]
Effects = Annotated[str | None, option("Only these effects, NAME,NAME,...; default: all.")]
Pairs = Annotated[bool, Parameter(help="Look for several effects at once.")]
Budget = Annotated[float | None, above_zero("Stop the search of a diagnosis after this time [s]; default: none.", "s")]


def _numbers(name: str, text: str, count: int, needs: str, fits: Callable[[list[float]], bool]) -> list[float]:
    """`count` finite numbers between commas, which `fits`. Raises `InputError` that says what it `needs`."""
    try:
        values = [numeral(part.strip()) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)) or not fits(values):
        raise InputError(f"{name}: found {quoted(text)}, needs {needs}")
    return values


def three_gains(text: str) -> tuple[float, float, float]:
    k_s, k_v, k_a = _numbers("--gains", text, 3, "three numbers k_s,k_v,k_a such as 1.5,1.5,-0.8", lambda _: True)
    return k_s, k_v, k_a


def accepted_pair(text: str) -> tuple[float, float]:
    needs = "two numbers T_L,K_L above 0 such as 0.3,1.0"
    lag, gain = _numbers("--accepted", text, 2, needs, lambda x: min(x) > 0)
    return lag, gain


def limits_pair(text: str) -> tuple[float, float]:
    """Two numbers, the first below zero and the second above."""
    needs = "MIN,MAX [m/s²] below and above 0, such as -6,4"
    low, high = _numbers("--limits", text, 2, needs, lambda x: x[0] < 0 < x[1])
    return low, high


def origin_of(paths: Sequence[Path], given: Mapping[str, Any]) -> Origin:
    """How an answer is made: by the files as they are now, with a log's mapping file, and by the arguments `given` to
    the command, without paths and what only says how the answer is shown."""
    from avtorch.io.mapping import mapping_beside
    from avtorch.report import Origin

    beside = [place for place in (mapping_beside(path) for path in paths) if place is not None]
    settings = {name: value for name, value in given.items() if name not in _HOW_SHOWN and not _is_path(value)}
    return Origin.of(COMMAND_LINE.get(), [*paths, *beside], settings)


def _is_path(value: Any) -> bool:
    return isinstance(value, Path) or (isinstance(value, list) and any(isinstance(x, Path) for x in value))
