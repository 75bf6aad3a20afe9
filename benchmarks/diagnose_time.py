"""How long does a diagnosis of five minutes at 100 Hz take, whatever is in it?

``python -m benchmarks.diagnose_time [--n 24] [--seed 1]``

Blind cases of every kind (benchmarks/blindtest: no cause, one, two, several, and causes outside the table) on drives of
300 s at 100 Hz, every other one behind an ordinary recorder. Processor seconds of `diagnose`, with one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from itertools import count

import numpy as np
import torch

from avtorch import diagnose
from benchmarks.blindtest import Case, Recorder, draw_case

SECONDS, RATE_HZ = 300.0, 100
MIX = {"none": 0.2, "single": 0.35, "pair": 0.15, "outside": 0.15, "several": 0.15}


def cases(n: int, seed: int) -> Iterator[Case]:
    """`n` cases at the rate asked for; the others of the set are passed over."""
    found = 0
    for index in count():
        recorder = "ordinary" if found % 2 else "ideal"
        case = draw_case(index, seed, mix=MIX, seconds=SECONDS, recorder=recorder)
        if case.drive.rate_hz == RATE_HZ:
            yield case
            found += 1
        if found == n:
            return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(1)
    spent: list[float] = []
    for case in cases(given.n, given.seed):
        log = case.log()
        begun = time.process_time()
        found = diagnose(log)
        spent.append(time.process_time() - begun)
        recorder = "ideal" if case.recorder == Recorder.ideal() else "ordinary"
        print(
            f"{spent[-1]:6.1f} s  {case.kind:8} {case.truth_name} -> {'+'.join(found.verdict.names)}  {recorder}",
            flush=True,
        )
    median, high = np.quantile(spent, [0.5, 0.95])
    print(f"{len(spent)} logs: median {median:.1f}, 95 % {high:.1f}, most {max(spent):.1f} s")


if __name__ == "__main__":
    main()
