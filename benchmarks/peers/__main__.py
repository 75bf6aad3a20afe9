"""avtorch's SGLD beside its peers: the same windows, one core each, in one run; prints tables of ratios.

    python -m benchmarks.peers [--only NAME,...] [--windows 5] [--batch 1000] [--quick] [--markdown] [--json FILE]

Tables go to standard output, progress to standard error. README.md describes each peer and its settings.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.peers.aims import aims
from benchmarks.peers.batch import batch
from benchmarks.peers.registry import METHODS
from benchmarks.peers.scaling import in_own_process
from benchmarks.peers.score import WANTED
from benchmarks.peers.single import Plan, single
from benchmarks.peers.tables import Table, details, growth, many_windows, markdown, one_window, text

PARTS = ("one", "many", "growth")


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help=f"methods, comma-separated, of: {', '.join(METHODS)}")
    parser.add_argument("--parts", default=",".join(PARTS), help=f"tables, comma-separated, of: {', '.join(PARTS)}")
    parser.add_argument("--windows", type=int, default=5, help="windows timed one at a time")
    parser.add_argument("--points", type=int, default=200, help="rows of a window")
    parser.add_argument("--batch", type=int, default=1000, help="windows taken at once")
    parser.add_argument("--seed", type=int, default=0, help="of the windows")
    parser.add_argument("--core", type=int, help="the core that all are pinned to; the last one by default, -1: none")
    parser.add_argument("--quick", action="store_true", help="smoke: no trials of settings, small sizes, no repeats")
    parser.add_argument("--markdown", action="store_true", help="tables in Markdown")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    parser.add_argument("--log", type=Path, default=Path(os.devnull), help="where the peers' own output goes")
    parser.add_argument("--clock", choices=("wall", "processor"), default="wall", help="processor: on a busy machine")
    options = parser.parse_args(given)
    options.parts = options.parts.split(",")
    names = list(METHODS) if options.only is None else options.only.split(",")
    for name, known in [(n, METHODS) for n in names] + [(p, PARTS) for p in options.parts]:
        if name not in known:
            parser.error(f"{name!r} is none of {', '.join(known)}")
    options.methods = [METHODS[name] for name in METHODS if name in names]
    if options.core is None:
        options.core = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else -1
    return options


def main(given: list[str] | None = None) -> int:
    o = arguments(given)
    import torch

    torch.set_num_threads(1)
    plan = Plan(o.methods, o.windows, o.points, o.quick, o.core, o.seed, o.log, o.clock)
    one = single(plan) if "one" in o.parts else []
    many = batch(plan, min(o.batch, 20) if o.quick else o.batch) if "many" in o.parts else []
    grown = in_own_process(o.core, quick=o.quick) if "growth" in o.parts else None
    verdicts = [] if o.quick else aims(one, many, grown)

    def show(title: str, table: Table) -> None:
        print(f"\n### {title}\n" if o.markdown else f"\n{title}")
        print(markdown(table) if o.markdown else text(table))

    print(f"{platform.machine()}, core {o.core}, Python {platform.python_version()}, torch {torch.__version__}")
    if one:
        show(f"One window of {o.points} points; medians over {o.windows} windows", one_window(one))
        print(f"\n* scaled up in proportion: fewer than {WANTED} effective draws came out.")
    if many:
        show("Many windows at once", many_windows(many))
    if grown is not None:
        titles = ("with windows", "with chains", "with points per window", "without sufficient statistics, 16 chains")
        for title, table in zip(titles, growth(grown), strict=True):
            show(f"Growth {title}", table)
    if verdicts:
        show("Aims", (["aim", "figure", "verdict"], [list(v) for v in verdicts]))
    for part in (one, many):
        if part:
            print("\nSettings\n" + "\n".join(details(part)))
    if o.json is not None:
        results = {"one": list(map(asdict, one)), "many": list(map(asdict, many)), "growth": grown}
        o.json.write_text(json.dumps({**results, "aims": verdicts}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
