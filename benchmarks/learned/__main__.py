"""Learned rivals of the estimator and of the prediction, and a learned controller under the monitor.

``python -m benchmarks.learned posterior|prediction|policy [--seed 0] [--out PICTURE]``

`posterior`: an amortised posterior of a window (sbi) beside SGLD, NUTS, filters and quadrature. `prediction`: networks
that foretell the acceleration, beside GLVD; the recordings are left out without `AVTORCH_DATA`. `policy`: a
car-following policy learnt by reinforcement (stable-baselines3), monitored, adjusted and judged; `--out` draws it.
"""

from __future__ import annotations

import argparse
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("posterior", "prediction", "policy"))
    parser.add_argument("--seed", type=int, default=0, help="of simulated drives and of the training")
    parser.add_argument("--out", type=Path, help="picture of the policy's learning curve and drive")
    options = parser.parse_args()
    if options.part == "posterior":
        from benchmarks.learned import posterior

        posterior.compare(seed=options.seed)
    elif options.part == "prediction":
        from benchmarks.learned import prediction

        prediction.compare()
    else:
        from benchmarks.learned import policy

        policy.compare(seed=options.seed, out=options.out)


if __name__ == "__main__":
    main()
