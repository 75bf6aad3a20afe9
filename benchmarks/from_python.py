"""Does `avtorch.diagnose` in a script take the processor time of the command? Neither sets OMP_NUM_THREADS.

``python -m benchmarks.from_python LOG [LOG ...]``

Threads that wait for each other burn processor time without an answer (5 to 13 times the command's where the library
does not limit them). Seconds of processor and of the clock, start and import included, one after the other.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCRIPT = "import sys, avtorch; print(avtorch.diagnose(sys.argv[1]).verdict.names)"


def seconds(command: list[str]) -> tuple[float, float]:
    """Of the processor and of the clock, for a command that has to succeed."""
    threads = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    environment = {key: value for key, value in os.environ.items() if key not in threads}
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path)
    for log in parser.parse_args().logs:
        with tempfile.TemporaryDirectory() as out:
            command = seconds([sys.executable, "-m", "avtorch.cli", "diagnose", str(log), "--quiet", "--out", out])
        script = seconds([sys.executable, "-c", SCRIPT, str(log)])
        print(
            f"{log.name}: command {command[0]:.1f} s of processor in {command[1]:.1f} s, "
            f"script {script[0]:.1f} s in {script[1]:.1f} s: {script[0] / command[0]:.2f} times",
            flush=True,
        )


if __name__ == "__main__":
    main()
