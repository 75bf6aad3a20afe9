"""What the diagnosis engine answers on fixed logs, kept in a file; two such files beside each other.

``AVTORCH_DATA=DIR python -m benchmarks.golden --out FILE.json [--only TEXT ...]``
``python -m benchmarks.golden --compare OLD.json NEW.json``
``python -m benchmarks.golden --table FILE.json``

The first form answers, in this order: every caller of the engine on a small example, forty simulated logs, and the
recordings. A case that is in the file already is kept, so an interrupted run goes on where it was; take another file
for another engine. The others print tables in Markdown: what differs, for better or for worse; and all verdicts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path
from typing import Any

import torch

import avtorch
from avtorch.errors import InputError
from benchmarks.golden import callers, recordings, simulated
from benchmarks.golden.facts import Answer, rounded
from benchmarks.golden.tables import all_verdicts, differences


def commit() -> str:
    """Of the package that answers, with a mark where its files were changed."""
    home = Path(avtorch.__file__).parent

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(home), *arguments], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--", str(home))
    return f"{git('rev-parse', '--short', 'HEAD') or 'unknown'}{'+' if changed else ''}"


def kept(path: Path) -> dict[str, Any]:
    empty: dict[str, Any] = {"schema": "avtorch.golden/1", "commits": [], "answers": {}}
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else empty


def write(path: Path, found: dict[str, Any]) -> None:
    """A case a line, so that changes can be read line by line."""
    lines = [f"  {json.dumps(k, ensure_ascii=False)}: {_text(v)}" for k, v in found["answers"].items()]
    text = '{{"schema": {}, "commits": {}, "answers": {{\n{}\n}}}}\n'.format(
        _text(found["schema"]), _text(found["commits"]), ",\n".join(lines)
    )
    beside = path.with_suffix(".part")
    beside.write_text(text, encoding="utf-8")
    beside.replace(path)


def _text(x: Any) -> str:
    return json.dumps(x, ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def run(path: Path, only: list[str]) -> None:
    found, begun, now = kept(path), time.perf_counter(), commit()
    for name, work in (case for group in (callers, simulated, recordings) for case in group.cases()):
        if name in found["answers"] or (only and not any(text in name for text in only)):
            continue
        answer = answered(work)
        if now not in found["commits"]:
            found["commits"].append(now)
        found["answers"][name] = rounded(answer)
        write(path, found)
        said = "+".join(answer.get("verdict", [])) or answer.get("refused") or answer.get("failed")
        true = "+".join(answer["truth"]["names"]) if "truth" in answer else "-"
        clock = f"{(time.perf_counter() - begun) / 60:5.1f} min"
        print(f"{clock}  {name}: {true} -> {said}  ({answer.get('seconds', 0.0):.1f} s)", flush=True)


def answered(work: Any) -> Answer:
    try:
        return work()
    except InputError as refusal:
        return {"refused": str(refusal)}
    except Exception as fault:
        return {"failed": f"{type(fault).__name__}: {str(fault)[:300]}"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, metavar="FILE", help="where the answers are kept")
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="cases with one of these in their name")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("OLD", "NEW"))
    parser.add_argument("--table", type=Path, metavar="FILE")
    given = parser.parse_args()
    if given.compare:
        print(differences(*(kept(path)["answers"] for path in given.compare)))
    elif given.table:
        print(all_verdicts(kept(given.table)["answers"]))
    elif given.out:
        torch.set_num_threads(1)
        print(f"avtorch at {Path(avtorch.__file__).parent}, commit {commit()}", flush=True)
        run(given.out, given.only)
    else:
        parser.error("needs --out, --compare or --table")


if __name__ == "__main__":
    main()
