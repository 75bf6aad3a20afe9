"""The API reference: a page for each public package, written before the build; after it every public name must be in.

A package is public if its `__all__` lists its names; a new one gets its page without an edit anywhere. A name that
several packages offer stands in full with the innermost, and in short with the others.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
from pathlib import Path
from types import ModuleType
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.errors import ExtensionError
from sphinx.pycode import ModuleAnalyzer

import avtorch

FOLDER = "built"
# Commands speak to people, not to programs: they have a page of another form.
COMMAND_LINE = "avtorch.cli"
COMMANDS = """\
Commands
========

What ``--help`` says of each command.

.. cyclopts:: avtorch.cli.app:app
"""

Public = dict[str, list[str]]
OFFERED: Public = {}


def public() -> Public:
    """The public names of each public package: `{"avtorch": ["GLVD", ...], "avtorch.vehicle": [...], ...}`."""
    found = {"avtorch": list(avtorch.__all__)}
    for name in [m.name for m in pkgutil.walk_packages(avtorch.__path__, "avtorch.") if m.ispkg]:
        package = importlib.import_module(name)
        parent, _, own = name.rpartition(".")
        # a function of the same name hides a package from those who import the one around it
        reached = getattr(importlib.import_module(parent), own, None) is package
        if name != COMMAND_LINE and reached and hasattr(package, "__all__"):
            found[name] = list(package.__all__)
    return found


def thing(package: str, name: str) -> Any:
    return getattr(importlib.import_module(package), name)


def listed() -> set[str]:
    """The modules whose source the site shows: those that make something public."""
    return {str(getattr(thing(package, name), "__module__", "")) for package in OFFERED for name in OFFERED[package]}


def home(package: str, name: str) -> str:
    """Where `name` stands in full: with the innermost package that offers the same thing; a module on its own page."""
    wanted = thing(package, name)
    if isinstance(wanted, ModuleType):
        return wanted.__name__
    same = [p for p, names in OFFERED.items() if name in names and thing(p, name) is wanted]
    return f"{max(same, key=lambda p: (p.count('.'), p))}.{name}"


def short(package: str, name: str) -> list[str]:
    role = "mod" if isinstance(thing(package, name), ModuleType) else "obj"
    return [f":py:{role}:`{name} <{home(package, name)}>`", f"   {summary(thing(package, name))}", ""]


def in_full(package: str, name: str) -> list[str]:
    shown = thing(package, name)
    if inspect.isclass(shown):
        return [f".. autoclass:: {name}", ""]
    if inspect.isroutine(shown):
        return [f".. autofunction:: {name}", ""]
    value = repr(shown)
    option = [f"   :value: {value}"] if len(value) <= 100 and " at 0x" not in value else []
    return [f".. py:data:: {name}", *option, "", *("   " + line for line in constant(package, name)), ""]


def summary(thing: object) -> str:
    """The first sentence of its docstring."""
    paragraph = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())
    return re.split(r"(?<=[^A-Z]\.) (?=[A-Z`])", paragraph)[0]


def constant(package: str, name: str) -> list[str]:
    """What stands below, or as `#:` above, a constant where it is made."""
    source = ast.parse(Path(str(importlib.import_module(package).__file__)).read_text(encoding="utf-8"))
    made = [i.module for i in ast.walk(source) if isinstance(i, ast.ImportFrom) and name in [a.name for a in i.names]]
    module = str(made[0]) if made else package
    words = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name))
    if not words:
        raise ExtensionError(f"{module}.{name} is public and not explained: put a docstring below it")
    return words


def page(package: str) -> str:
    lines = [package, "=" * len(package), "", f".. automodule:: {package}", "   :no-members:", ""]
    names = sorted(OFFERED[package], key=str.lower)
    modules = [name for name in names if isinstance(thing(package, name), ModuleType)]
    own = [name for name in names if name not in modules and home(package, name) == f"{package}.{name}"]
    for name in names:
        if name not in own:
            lines += short(package, name)
    lines += [f".. py:currentmodule:: {package}", ""]
    for name in own:
        lines += in_full(package, name)
    return "\n".join(lines)


def write(app: Sphinx) -> None:
    OFFERED.update(public())
    pages = {f"{package}.rst": page(package) for package in OFFERED} | {"commands.rst": COMMANDS}
    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.rst"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def follow(app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.TextElement) -> nodes.reference | None:
    """`avtorch.simulate` leads to where it stands in full."""
    package, _, name = node.get("reftarget", "").rpartition(".")
    if node.get("refdomain") != "py" or name not in OFFERED.get(package, []):
        return None
    return env.domains["py"].resolve_xref(env, node["refdoc"], app.builder, "obj", home(package, name), node, text)


def dashes(app: Sphinx, doctree: nodes.document) -> None:
    """Between a name and what it is; in prose alone, for options begin with two hyphens."""
    for text in list(doctree.findall(nodes.Text)):
        if " -- " in text and not isinstance(text.parent, (nodes.literal, nodes.literal_block)):
            text.parent.replace(text, nodes.Text(text.replace(" -- ", " – ")))


def check(app: Sphinx, fault: Exception | None) -> None:
    """Every public name stands somewhere in full."""
    if fault is not None:
        return
    python = app.env.domaindata["py"]
    for package, names in OFFERED.items():
        for name in names:
            if home(package, name) not in {*python["objects"], *python["modules"]}:
                raise ExtensionError(f"{package}.{name} is public and not in the reference")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write)
    app.connect("doctree-read", dashes)
    app.connect("missing-reference", follow)
    app.connect("build-finished", check)
    return {"parallel_read_safe": True}
