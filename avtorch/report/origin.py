"""Where a page comes from, for who wants to repeat it: the command, the versions, and hashes of what was read."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

from avtorch.io import fingerprint
from avtorch.version import __version__


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
                with file.open("rb") as stream:
                    # two drives may have one name in two folders
                    files[_free(name, files)] = hashlib.file_digest(stream, "sha256").hexdigest()
        return cls(command, files, None if settings is None else fingerprint(settings))


def _free(name: str, taken: Mapping[str, str]) -> str:
    number = 2
    free = name
    while free in taken:
        free, number = f"{name} ({number})", number + 1
    return free


def versions() -> str:
    """Of avtorch and of what computes, in one line."""
    found = {
        "avtorch": __version__,
        "torch": version("torch"),
        "numpy": version("numpy"),
        "Python": platform.python_version(),
    }
    return ", ".join(f"{name} {number}" for name, number in found.items())
