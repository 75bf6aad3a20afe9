"""What the pages have in common: their frame, style and parts. A page loads nothing, and all text in it is escaped."""

from __future__ import annotations

import base64
import hashlib
from importlib.resources import files
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from avtorch.errors import printable
from avtorch.report.origin import Origin, versions


def page_of(template: str, *, origin: Origin | None = None, policy: str = "", script: str = "", **values: Any) -> str:
    """A page by its `template` in this package, with the house's style and footer.

    `policy`: what its Content-Security-Policy allows beside inline styles and the page's scripts, which are `script`,
    if it has one of its own, and that of the house where a picture has lines to read. Scripts are known by their hash.
    """
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_seen,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(text_of),
    )
    scripts = {name: Markup("\n" + text) for name, text in (("curves", text_of("curves.js")), ("own", script)) if text}
    hashes = {name: Markup(f"'sha256-{_digest(text)}'") for name, text in scripts.items()}
    house = {"style": Markup(text_of("style.css")), "origin": origin or Origin(), "versions": versions()}
    house |= {"scripts": scripts, "hashes": hashes}
    return environment.get_template(template).render(policy=Markup(policy), **house, **values)


def text_of(name: str) -> str:
    """A file of this package."""
    return files("avtorch.report").joinpath(name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _seen(value: Any) -> Any:
    """Text of a page, its control characters escaped; markup of our own, the pictures, as it is."""
    return value if isinstance(value, Markup) or not isinstance(value, str) else printable(value)
