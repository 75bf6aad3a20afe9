"""What stands in the site's navigation: the groups of `index.md` and their pages, in its order.

That page is the only list. One that it does not name is in no group, and the build refuses it.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from reference import FOLDER

TREE = "\n\n```{{toctree}}\n:hidden:\n:glob:\n{}\n{}\n```\n"
BELOW = {
    "effects": TREE.format("", "effects/*"),
    f"{FOLDER}/notebooks": TREE.format("", "notebooks/*"),
    f"{FOLDER}/benchmarks": TREE.format("", "benchmarks.*"),
    "reference": TREE.format("", f"{FOLDER}/commands\n{FOLDER}/avtorch*"),
}

PAGE = re.compile(r"\[([^\]]+)\]\(([^)#:]+\.md)\)")


def trees(docname: str, text: str, on_site: Callable[[str], str]) -> str:
    """The pages below `docname`; `on_site` makes a link of its text one of the site."""
    if docname != "index":
        return BELOW.get(docname, "")
    made = []
    for caption, pages in groups(text).items():
        entries = [f"{title} <{on_site(link).removesuffix('.md')}>" for title, link in pages]
        made.append(TREE.format(f":caption: {caption}\n", "\n".join(entries)))
    return "".join(made)


def groups(text: str) -> dict[str, list[tuple[str, str]]]:
    """The pages of each section of `index.md`: `{"How-to": [("Your own log", "logs.md"), ...], ...}`."""
    sections = re.split(r"^## ", text, flags=re.M)[1:]
    return {s.split("\n")[0].strip(): [(m[1], m[2]) for m in PAGE.finditer(s)] for s in sections}
