"""Options that the paper names but does not work out, each with its figures.

``python -m benchmarks.options [--only gap,settings,driver,link,strategy,controllers,bounds,measures] [--out DIR]``

All drives are behind US06, the vehicle becomes (1.5 s, 0.5) at 26 s unless stated otherwise; seeds from 0 on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from benchmarks.options import black_box, bounds, gap, link


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="some of the parts, by comma; all by default")
    parser.add_argument("--runs", type=int, default=20, help="drives side by side where there are several")
    parser.add_argument("--out", type=Path, help="folder for the picture of the time gap")
    options = parser.parse_args()
    torch.set_num_threads(1)
    parts = {
        "gap": ("throughput against string stability", lambda: gap.trade_off(options.out)),
        "settings": ("the driver's settings {1, 1.6, 2.5} s, nothing else changed", gap.settings),
        "driver": ("a driver who complies later", lambda: gap.driver(options.runs)),
        "link": ("feed-forward with communication delay: exact verdict and simulation", link.verdict),
        "strategy": ("feed-forward as a strategy", link.strategy),
        "controllers": ("controllers of any structure under the same monitor", black_box.verdicts),
        "bounds": ("the posterior as design bounds", bounds.rechecked),
        "measures": ("comfort, energy, safe spacing", lambda: bounds.measures(options.runs)),
    }
    wanted = list(parts) if options.only is None else options.only.split(",")
    unknown = [name for name in wanted if name not in parts]
    if unknown:
        parser.error(f"--only: found {', '.join(unknown)}, needs some of {', '.join(parts)}")
    for name in wanted:
        title, show = parts[name]
        print(f"\n## {name}: {title}\n", flush=True)
        show()


if __name__ == "__main__":
    main()
