"""The file of seeds that failed: which test, which seeds. They are drawn first in every run from then on.

`tests/failed_seeds.json` belongs to the repository: a seed that found a fault, once committed, is a regression case.
`AVTORCH_FAILED_SEEDS` names another file for what fails now, which is read as well. CI names one that git ignores, so
that a failure there leaves the checkout as it was.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

Seeds = dict[str, list[int]]
"""Seeds by test id, both sorted."""

NAME = "tests/failed_seeds.json"


def read(path: Path) -> Seeds:
    """What a file holds; nothing where there is none. ValueError where it is not `{"test id": [seeds]}`."""
    if not path.is_file():
        return {}
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault
    good = isinstance(held, dict) and all(
        isinstance(seeds, list) and all(type(s) is int and 0 <= s < 2**31 for s in seeds) for seeds in held.values()
    )
    if not good:
        raise ValueError(f'{path}: found something else, needs {{"test id": [seeds from 0 to 2**31 - 1]}}')
    return held


def merged(*several: Seeds) -> Seeds:
    together: dict[str, set[int]] = {}
    for seeds in several:
        for test, values in seeds.items():
            together.setdefault(test, set()).update(values)
    return {test: sorted(together[test]) for test in sorted(together)}


def written_to(root: Path) -> Path:
    return root / os.environ.get("AVTORCH_FAILED_SEEDS", NAME)


def recorded(root: Path) -> Seeds:
    """All that is to be drawn first: the repository's seeds, and those of the file that this run writes to."""
    return merged(read(root / NAME), read(written_to(root)))


def add(root: Path, failed: Seeds) -> Path:
    """Add to the file in one step, so that an interrupted run leaves the old file or the new one."""
    path = written_to(root)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.{os.getpid()}")
    text = json.dumps(merged(read(path), failed), indent=2, ensure_ascii=False)
    beside.write_text(text + "\n", encoding="utf-8")
    beside.replace(path)
    return path
