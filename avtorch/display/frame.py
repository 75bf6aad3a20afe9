"""An answer in a few lines, and its small table: drawn as text and as HTML, shown in a console or a notebook, and
handed on as a data frame."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import import_module
from textwrap import wrap
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError, printable

if TYPE_CHECKING:
    import pandas
    import pyarrow

SHOWN = 12
"""Rows that are drawn; the rest is counted."""
_CELL = 60  # characters of a cell

Column = Sequence[Any] | NDArray


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """`columns` by name, one value a row each: numbers, texts, truth values, or None where there is none.

    `to_dataframe()` makes a pandas data frame; Polars, DuckDB and pyarrow take the table itself, by Arrow's protocol
    (``polars.DataFrame(frame)``). Raises `InputError` where columns differ in length.
    """

    columns: Mapping[str, Column]

    def __post_init__(self) -> None:
        lengths = {name: len(values) for name, values in self.columns.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"columns: differ in length: {', '.join(f'{k} {n}' for k, n in lengths.items())}")

    @classmethod
    def of_rows(cls, rows: Sequence[Mapping[str, Any]]) -> Frame:
        """The table of rows with the same keys."""
        return cls({name: tuple(row[name] for row in rows) for name in (rows[0] if rows else {})})

    def __len__(self) -> int:
        """Number of rows."""
        return next((len(values) for values in self.columns.values()), 0)

    def __getitem__(self, name: str) -> Column:
        """A column, by name."""
        return self.columns[name]

    def rows(self) -> Iterator[dict[str, Any]]:
        """The rows, each by the names of the columns."""
        for values in zip(*self.columns.values(), strict=True):
            yield dict(zip(self.columns, values, strict=True))

    def to_arrow(self) -> pyarrow.Table:
        """The table as `pyarrow.Table`."""
        import pyarrow as pa

        return pa.table({name: _array(values) for name, values in self.columns.items()})

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Arrow's protocol for data frames (the PyCapsule interface)."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_dataframe(self) -> pandas.DataFrame:
        """The table as `pandas.DataFrame`. Raises `InputError` where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise InputError("pandas: not installed; to_dataframe needs pip install 'avtorch[pandas]'") from None
        return pandas.DataFrame({name: _array(values) for name, values in self.columns.items()})

    def __repr__(self) -> str:
        return "\n".join(self.lines())

    def lines(self, most: int = SHOWN) -> list[str]:
        """The table as text: a header, up to `most` rows, and the number of the others."""
        shown, right = self._drawn(most)
        widths = [max(len(cell) for cell in column) for column in shown]
        table = [
            "  ".join(
                cell.rjust(width) if number else cell.ljust(width)
                for cell, width, number in zip(row, widths, right, strict=True)
            ).rstrip()
            for row in zip(*shown, strict=True)
        ]
        return [*table, *self._rest(most)]

    def _repr_html_(self) -> str:
        return self.html()

    def html(self, most: int = SHOWN) -> str:
        """The same table as HTML without any style of its own; every text escaped."""
        shown, right = self._drawn(most)
        sides = ["right" if number else "left" for number in right]

        def row(tag: str, cells: Sequence[str]) -> str:
            pairs = zip(sides, cells, strict=True)
            drawn = (f'<{tag} style="text-align:{side}">{escape(cell)}</{tag}>' for side, cell in pairs)
            return f"<tr>{''.join(drawn)}</tr>"

        head, *body = zip(*shown, strict=True) if shown else [()]
        rows = "".join(row("td", cells) for cells in body)
        rest = "".join(f"<div>{escape(line)}</div>" for line in self._rest(most))
        return f"<table><thead>{row('th', head)}</thead><tbody>{rows}</tbody></table>{rest}"

    def _drawn(self, most: int) -> tuple[list[list[str]], list[bool]]:
        """Each column with its title in front, and whether it is set to the right."""
        cut = {name: list(values[:most]) for name, values in self.columns.items()}
        shown = [[printable(name, _CELL), *map(_text, values)] for name, values in cut.items()]
        return shown, [any(_is_number(x) for x in values) for values in cut.values()]

    def _rest(self, most: int) -> list[str]:
        left = len(self) - most
        return [f"... and {left} more row{'s' if left > 1 else ''}"] if left > 0 else []


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float, np.number)) and not isinstance(x, bool)


def _array(values: Column) -> Any:
    """None among numbers is NaN, so that a column of numbers stays one."""
    if isinstance(values, np.ndarray):
        return values
    if any(isinstance(x, float) for x in values) and all(x is None or _is_number(x) for x in values):
        return np.array([np.nan if x is None else float(x) for x in values])
    return list(values)


def _text(x: Any) -> str:
    if x is None:
        return ""
    if isinstance(x, (bool, np.bool_)):
        return "yes" if x else "no"
    if isinstance(x, (float, np.floating)):
        return f"{x:.4g}"
    return printable(str(x), _CELL)


WIDTH = 100
"""Characters of a line of sentences."""
_SENTENCE = 600  # characters


@dataclass(frozen=True)
class Card:
    """A `title`, `lines` of one sentence each, and a `table`, of which `most` rows are drawn."""

    title: str
    lines: tuple[str, ...] = ()
    table: Frame | None = None
    most: int = 6

    def __str__(self) -> str:
        """As a console shows it."""
        table = self.table.lines(self.most) if self.table else []
        sentences = (printable(line, _SENTENCE) for line in (self.title, *self.lines))
        return "\n".join([*(part for line in sentences for part in wrap(line, WIDTH)), *table])

    def html(self) -> str:
        """As a notebook shows it; every text escaped."""
        lines = "".join(f"<div>{escape(printable(line, _SENTENCE))}</div>" for line in self.lines)
        table = self.table.html(self.most) if self.table else ""
        return f"<div><strong>{escape(printable(self.title, _SENTENCE))}</strong>{lines}{table}</div>"


class Displayed:
    """An answer that shows its `overview()`: as text in a console, as HTML in a notebook."""

    def overview(self) -> Card:
        """The answer in a few lines."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return str(self.overview())

    def _repr_html_(self) -> str:
        return self.overview().html()


def notebook_display() -> ModuleType | None:
    """`IPython.display` where a notebook's kernel runs this program; None elsewhere."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    # the shell of a terminal has no kernel and shows neither pictures nor HTML
    return import_module("IPython.display") if hasattr(shell, "kernel") else None


def show(*answers: object) -> None:
    """Display answers below the cell in a notebook, as its last line would; elsewhere print them.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from avtorch.display import show
        >>> log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05)).log()
        >>> show(log.overview().title)  # of the log itself a notebook shows a small table
        Log arrays: 1200 rows, 59.95 s at 20 Hz, 1 segment
    """
    display = notebook_display()
    for answer in answers:
        if display is None:
            print(answer if isinstance(answer, str) else repr(answer))
        else:
            display.display(answer)
