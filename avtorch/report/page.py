"""The frame of every page: what was found first, then its sections of text, pictures and tables.

A page loads nothing, and all text in it is escaped. Pictures are SVG that takes its colours from the page's style, so
that one serves light, dark and paper.
"""

from __future__ import annotations

import base64
import hashlib
import io
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from importlib.resources import files
from itertools import count
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from avtorch.errors import printable
from avtorch.io import atomic, fingerprint
from avtorch.report.table import Table
from avtorch.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Origin:
    """`command`: the exact line that made the answer, None where it was no command. `files`: SHA-256 [64 hex digits] of
    each file that was read, by its name without its folder. `settings`: the same over the settings in force.
    """

    command: str | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    settings: str | None = None

    @classmethod
    def of(
        cls,
        command: str | None = None,
        paths: Iterable[str | PathLike[str]] = (),
        settings: Mapping[str, Any] | None = None,
    ) -> Origin:
        """With the hashes of those files, and of those in folders among them, and of `settings`.

        Raises `OSError` for a file that cannot be read.
        """
        files: dict[str, str] = {}
        for path in map(Path, paths):
            inside = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
            for file in inside:
                name = str(file.relative_to(path.parent))
                # two drives may have one name in two folders
                names = (name if number == 1 else f"{name} ({number})" for number in count(1))
                with file.open("rb") as stream:
                    digits = hashlib.file_digest(stream, "sha256").hexdigest()
                files[next(free for free in names if free not in files)] = digits
        return cls(command, files, None if settings is None else fingerprint(settings))


def versions() -> str:
    """Of avtorch and of what computes, in one line."""
    computes = ", ".join(f"{name} {version(name)}" for name in ("torch", "numpy"))
    return f"avtorch {__version__}, {computes}, Python {platform.python_version()}"


Tone = Literal["blue", "green", "amber"]

_COLOURS = {
    "#222222": "ink",
    "#000000": "ink",
    "#ffffff": "paper",
    "#0072b2": "p-blue",
    "#d55e00": "p-vermillion",
    "#e69f00": "p-orange",
    "#56b4e9": "p-sky",
    "#7f7f7f": "p-grey",
    "#009e73": "p-green",
    "#a6407e": "p-purple",
    "#d3e8f2": "p-stable",
    "#fbe6c4": "p-amplifies",
    "#ddd3d8": "p-unstable",
    "#b07a1e": "p-contour",
    "#bbbbbb": "p-bar",
    "#dddddd": "p-fill",
    "#dadada": "p-fill",  # an exact density
    "#555555": "soft",  # its outline
    "#e6e6e6": "p-grid",
}
"""The style's name for each colour of `avtorch.plots.style`."""
_PX_A_POINT = 1.5
_LEAST = 0.76  # of the width on a desk, below which letters could not be read
_MOST = 40  # rows of a table of lines


@dataclass(frozen=True)
class Picture:
    """A picture as SVG; `says`: what it shows, in words; `caption`; `tables`: its numbers, shown at once where
    `opened`."""

    svg: Markup
    says: str
    caption: str = ""
    tables: tuple[Table, ...] = ()
    opened: bool = False


@dataclass(frozen=True)
class Section:
    """Lines, pictures, `small` pictures side by side, tables, `soft` lines, a list and `more` under a title.

    None among the pictures and tables without rows are left out.
    """

    title: str
    lines: Sequence[str] = ()
    pictures: Sequence[Picture | None] = ()
    small: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    soft: Sequence[str] = ()
    items: Sequence[str] = ()
    more: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "pictures", tuple(picture for picture in self.pictures if picture is not None))
        object.__setattr__(self, "tables", tuple(table for table in self.tables if table.rows))

    @property
    def empty(self) -> bool:
        """Whether there is nothing under the title."""
        parts = (self.lines, self.pictures, self.small, self.tables, self.soft, self.items, self.more)
        return not any(map(len, parts))


@dataclass(frozen=True)
class Page:
    """`kind` of answer, and what it is `of`; `lead`: the first section, whose title is the answer; `tone`: green where
    all is well, amber where something is to be done. `script`: of its own."""

    kind: str
    of: str
    lead: Section
    sections: Sequence[Section]
    tone: Tone = "blue"
    script: str = ""

    def html(self, origin: Origin | None = None) -> str:
        """The page as text; sections with nothing in them are left out."""
        page = replace(self, sections=tuple(section for section in self.sections if not section.empty))
        script = Markup("\n" + self.script) if self.script else ""
        # thousands of dots are an image within the page
        pictures = [picture for section in (page.lead, *page.sections) for picture in section.pictures if picture]
        policy = "; img-src data:" if any("<image" in picture.svg for picture in pictures) else ""
        if script:
            digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
            policy += f"; script-src 'sha256-{digest}'"
        frame = {"style": Markup(text_of("style.css")), "origin": origin or Origin(), "versions": versions()}
        return _TEMPLATES.get_template("page.html").render(page=page, policy=Markup(policy), script=script, **frame)


def written(text: str, folder: str | PathLike[str], name: str) -> Path:
    """A page in `folder`; returns its path. Raises `InputError` where it cannot be written."""
    path = Path(folder) / name
    with atomic(path) as stream:
        stream.write(text)
    return path


def picture_of(
    name: str, figure: Figure, *tables: Table, says: str = "", caption: str = "", opened: bool = False
) -> Picture:
    """A figure for the page; where they are not given, what it says and its tables are those of its lines."""
    # draws, and needs matplotlib
    from avtorch.plots.style import words_of

    says = says or words_of(figure)
    return Picture(inline_svg(name, figure, says), says, caption, tables or _tables_of(figure), opened)


def _tables_of(figure: Figure) -> tuple[Table, ...]:
    """The lines of each axes, which have their places in common: at `_MOST` of these, evenly spaced."""
    from avtorch.plots.style import lines_of

    tables = []
    # axes beside or above each other share a label
    along = next(text for ax in reversed(figure.axes) if (text := ax.get_xlabel()))
    across = next(text for ax in figure.axes if (text := ax.get_ylabel()))
    for ax in figure.axes:
        lines = lines_of(ax)
        if lines:
            columns = (ax.get_xlabel() or along, *lines)
            points = [next(iter(lines.values()))[:, 0], *(values[:, 1] for values in lines.values())]
            some = list(zip(*points, strict=True))[:: -(-len(points[0]) // _MOST)]
            rows = tuple((f"{x:.4g}", *(f"{y:.3g}" for y in ys)) for x, *ys in some)
            tables.append(Table(f"{ax.get_ylabel() or across} over {columns[0]}", columns, rows, numeric=columns))
    return tuple(tables)


def inline_svg(name: str, figure: Figure, says: str) -> Markup:
    """A figure as SVG for the page: text as text, no date, equal for equal figures.

    `name` begins its ids and is the page's only one; `says` is its text alternative. A colour of the house's palette
    becomes the style's variable.
    """
    import matplotlib as mpl

    stream = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "avtorch"}):
        # no ground of its own: the page's paper shows through
        figure.savefig(
            stream, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    text = stream.getvalue()
    text = text[text.index("<svg") :]  # the prologue has no place inside a page
    view = re.search(r'viewBox="[^"]*"', text)
    assert view is not None, "matplotlib writes the extent of every SVG"
    text = text[text.index(">") + 1 :]
    # a style inside a picture would be the whole page's; the page has its own
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", text)
    text = re.sub(
        r"((?:fill|stroke): )(#[0-9a-f]{6})",
        lambda m: m[1] + (f"var(--{_COLOURS[m[2]]})" if m[2] in _COLOURS else m[2]),
        text,
    )
    text = re.sub(r"-?\d+\.\d{3,}", lambda m: f"{float(m[0]):.2f}", text)
    # letters are of one size on a desk, whatever the width of the figure; a phone shows a part of a wide one
    most = _PX_A_POINT * 72 * figure.get_figwidth()
    opening = Markup(
        '<svg class="picture" role="img" aria-label="{}" {} style="max-width: {:.0f}px; min-width: {:.0f}px">'
    )
    # matplotlib escapes what it writes
    return opening.format(printable(says), Markup(view[0]), most, _LEAST * most) + Markup(text)


def fragment(template: str, **values: Any) -> Markup:
    """A part of a page by its template in this package."""
    return Markup(_TEMPLATES.get_template(template).render(**values))


def text_of(name: str, package: str = "avtorch.report") -> str:
    """A file of a package, by default this one."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def _seen(value: Any) -> Any:
    """Text of a page, its control characters escaped; markup of our own, the pictures, as it is."""
    return value if isinstance(value, Markup) or not isinstance(value, str) else printable(value)


_TEMPLATES = Environment(
    autoescape=True,
    undefined=StrictUndefined,
    finalize=_seen,
    trim_blocks=True,
    lstrip_blocks=True,
    loader=FunctionLoader(text_of),
)


def markdown(page: Page, origin: Origin | None = None) -> str:
    """The page as Markdown; whatever a file's name holds stays text."""
    made = origin or Origin()
    command = (f"    {printable(made.command)}",) if made.command else ()
    foot = [f"versions: {versions()}", *(f"SHA-256 of {name}: {digits}" for name, digits in made.files.items())]
    foot += [f"SHA-256 of the settings: {made.settings}"] if made.settings else []
    parts = [f"# {_text(page.kind)}", _text(page.of), f"**{_text(page.lead.title)}**", *_body(page.lead)]
    for section in page.sections:
        parts += [] if section.empty else [f"## {_text(section.title)}", *_body(section)]
    parts += ["## How this page was made", *command, *_body(Section("", items=tuple(foot)))]
    return "\n\n".join(parts) + "\n"


def _body(section: Section) -> list[str]:
    lists = ["\n".join(f"- {_text(item)}" for item in section.items)] if section.items else []
    return [*map(_text, section.lines), *map(_table, section.tables), *map(_text, section.soft), *lists]


def _table(table: Table) -> str:
    titles, *rows = ([_text(cell) for cell in row] for row in (table.columns, *table.rows))
    sides = ["---:" if title in table.numeric else "---" for title in table.columns]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (titles, sides, *rows))


def _text(text: str) -> str:
    """With a backslash before all that Markdown would read otherwise."""
    return re.sub(r"([\\`*_{}\[\]<>#|])", r"\\\1", printable(text))
