"""The frame of a command's page: what was found first, then its parts."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

from avtorch.io import atomic
from avtorch.report.house import page_of
from avtorch.report.origin import Origin
from avtorch.report.picture import Picture
from avtorch.report.table import Table

Tone = Literal["blue", "green", "amber"]


@dataclass(frozen=True)
class Section:
    """Lines, pictures, tables (those `folded` behind a click) and a list under a title, in that order.

    Example:
        >>> from avtorch.report.answer_page import Section
        >>> Section("The data", ("3000 rows.",)).items
        ()
    """

    title: str
    lines: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    folded: tuple[Table, ...] = ()
    items: tuple[str, ...] = ()

    @property
    def empty(self) -> bool:
        """Whether there is nothing under the title."""
        return not (self.lines or self.pictures or self.tables or self.folded or self.items)


@dataclass(frozen=True)
class AnswerPage:
    """`kind` of answer, and what it is `of`; `lead`: the first section, whose title is the answer; `tone`: green where
    all is well, amber where something is to be done."""

    kind: str
    of: str
    lead: Section
    sections: tuple[Section, ...]
    tone: Tone = "blue"


def answer_html(page: AnswerPage, *, origin: Origin | None = None) -> str:
    """The page as text; sections with nothing in them are left out.

    Example:
        >>> from avtorch.report.answer_page import AnswerPage, Section, answer_html
        >>> page = AnswerPage("Estimate", "lap.csv", Section("T_L is 0.3 s"), (Section("The data"),))
        >>> text = answer_html(page)
        >>> "<h1 id=\\"verdict\\">T_L is 0.3 s</h1>" in text, "The data" in text
        (True, False)
    """
    kept = tuple(section for section in page.sections if not section.empty)
    shown = AnswerPage(page.kind, page.of, page.lead, kept, page.tone)
    pictures = [picture for section in (page.lead, *kept) for picture in section.pictures]
    # thousands of dots are an image within the page
    policy = "; img-src data:" if any("<image" in picture.wide for picture in pictures) else ""
    return page_of("answer.html", origin=origin, policy=policy, page=shown)


def written(text: str, folder: str | PathLike[str], name: str) -> Path:
    """A page in `folder`; returns its path. Raises `InputError` where it cannot be written."""
    path = Path(folder) / name
    with atomic(path) as stream:
        stream.write(text)
    return path
