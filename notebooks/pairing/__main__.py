"""Execute every notebook that is out of step with its source, or those named, and write them beside their sources."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from notebooks.pairing.execute import executed, write
from notebooks.pairing.pair import FOLDER, RECORDINGS, SOURCES, faults, pair_of


def main(names: list[str]) -> int:
    """`--all`: every one; a number or a name: that one; nothing: those that are out of step."""
    if names and names != ["--all"]:
        chosen = [s for s in SOURCES if any(s.stem == Path(n).stem or s.stem.startswith(f"{n}_") for n in names)]
    else:
        chosen = [s for s in SOURCES if names or faults(s)]
    if not chosen:
        print("every notebook is in step with its source" if not names else f"no notebook in {FOLDER.name} is so named")
        return bool(names)
    left = 0
    for source in chosen:
        if source.stem in RECORDINGS and not os.environ.get("AVTORCH_DATA"):
            print(f"{source.name}: left as it is; it needs recordings, in a folder that AVTORCH_DATA names")
            left += 1
            continue
        begun = time.perf_counter()
        path = write(source, executed(source))
        print(f"{path.name}: {time.perf_counter() - begun:.0f} s, {path.stat().st_size / 1e3:.0f} kB", flush=True)
        for fault in faults(source):
            print(f"  {fault}")
            left += 1
    size = sum(pair_of(s).stat().st_size for s in SOURCES if pair_of(s).exists())
    print(f"all together: {size / 1e6:.1f} MB")
    return int(left > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
