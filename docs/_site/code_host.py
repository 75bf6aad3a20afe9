"""Pages are written for a code host, as plain Markdown with relative links. Here the site learns to follow them.

A link to a file of `../avtorch` leads to its listing on the site, a link to a package to its page of the reference, one
to a page of `OUTSIDE` to the copy made here, and one to a notebook to its page.
"""

from __future__ import annotations

import posixpath
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import reference
from navigation import trees
from reference import FOLDER
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

ROOT = Path(__file__).resolve().parents[2]
# Pages that lie outside, by their path from the root, and what they are called here.
OUTSIDE = {"README.md": "readme.md", "notebooks/README.md": "notebooks.md"} | {
    page: page.replace("/README.md", ".md").replace("/", ".")
    for page in sorted(p.relative_to(ROOT).as_posix() for p in (ROOT / "benchmarks").rglob("*.md"))
}

LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)#\s]+)")


def outside(app: Sphinx) -> None:
    """Pages of other folders: their links are those of their folders."""
    made = Path(app.srcdir) / FOLDER
    made.mkdir(exist_ok=True)
    for old in made.glob("*.md"):
        if old.name not in OUTSIDE.values():
            old.unlink()
    for path, page in OUTSIDE.items():
        text = (ROOT / path).read_text(encoding="utf-8")
        folder = posixpath.dirname(path)
        text = LINK.sub(lambda m, folder=folder: f"../../{posixpath.normpath(posixpath.join(folder, m[1]))}", text)
        target = made / page
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")


def read(app: Sphinx, docname: str, content: list[str]) -> None:
    """A page's text as the site needs it."""
    if app.env.doc2path(docname).suffix != ".md":
        return
    up = "../" * docname.count("/")
    below = trees(docname, content[0], lambda link: on_site(link, up))
    content[0] = LINK.sub(lambda m: on_site(m[1], up), content[0]) + below


def on_site(link: str, up: str) -> str:
    path = re.sub(r"^(?:\.\./)+", "", posixpath.normpath(link))
    if link.startswith("../") and path in OUTSIDE:
        return f"{up}{FOLDER}/{OUTSIDE[path]}"
    notebook = re.fullmatch(r"(?:\.\./)+(notebooks/\w+\.ipynb)", link)
    if notebook:
        return f"{up}{FOLDER}/{notebook[1]}"
    found = re.fullmatch(r"(?:\.\./)+(avtorch(?:/\w+)*)(/|\.py)?", link)
    if not found:
        return link
    module = found[1].removesuffix("/__init__")
    if found[2] != ".py" or module != found[1]:
        page = "commands" if module == "avtorch/cli" else module.replace("/", ".")
        return f"{up}{FOLDER}/{page}.rst"
    # other files are handed out as they are
    return f"source:{up}_modules/{module}.html" if module.replace("/", ".") in reference.listed() else link


class Page(HTMLParser):
    """Where a built page leads, and which marks it has."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.marks: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.marks.add(value)
            elif name in ("href", "src") and value and not urlsplit(value).scheme:
                self.links.add(value)


def check(app: Sphinx, fault: Exception | None) -> None:
    """Every link between the built pages leads somewhere."""
    if fault is not None or app.builder.name != "html":
        return
    pages = {path: Page(path) for path in Path(app.outdir).rglob("*.html")}
    dead = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            mark = unquote(parts.fragment)
            if not target.exists() or (mark and target in pages and mark not in pages[target].marks):
                dead.append(f"{path.relative_to(app.outdir)}: {link}")
    if dead:
        raise ExtensionError("links that lead nowhere:\n" + "\n".join(sorted(dead)))


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", outside)
    app.connect("source-read", read)
    app.connect("build-finished", check)
    return {"parallel_read_safe": True}
