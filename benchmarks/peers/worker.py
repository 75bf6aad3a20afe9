"""One method in a process of its own: ``python -m benchmarks.peers.worker NAME SETTINGS FOLDER CORE``.

It reads one JSON command per line and answers with a JSON line; arrays go through files in FOLDER. Output of libraries
goes to standard error.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
import warnings
from pathlib import Path
from typing import Any


def pin(core: int) -> None:
    """Keep this process and its threads on one core; set before any numerical library is imported."""
    if core >= 0 and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = "1"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["JAX_ENABLE_X64"] = "1"
    os.environ["JAX_PLATFORMS"] = "cpu"


def memory_mb(*, peak: bool) -> float:
    """Resident memory of this process [MB], now or at its peak.

    Not ``ru_maxrss``: on Linux that starts at the size of the process that started this one.
    """
    try:
        text = Path("/proc/self/status").read_text(encoding="ascii")
        key = "VmHWM:" if peak else "VmRSS:"
        return next(float(line.split()[1]) for line in text.splitlines() if line.startswith(key)) / 1024
    except (OSError, StopIteration):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "linux" else 1024**2)


def forget_peak() -> None:
    """Reset the peak to the present resident memory (Linux only)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def main() -> None:
    name, settings, folder, core = sys.argv[1], json.loads(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4])
    pin(core)
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    warnings.simplefilter("ignore")

    def answer(**fields: Any) -> None:
        out.write(json.dumps(fields) + "\n")
        out.flush()

    import numpy as np

    from benchmarks.peers.contract import as_log
    from benchmarks.peers.problem import Windows
    from benchmarks.peers.registry import METHODS

    begun = time.perf_counter()
    if "torch" in sys.modules:
        raise RuntimeError("the description of the methods imported torch")
    runner = METHODS[name].build(settings)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    forget_peak()
    baseline = memory_mb(peak=False)
    answer(ready=True, import_s=time.perf_counter() - begun)
    for line in sys.stdin:
        order = json.loads(line)
        if order["do"] == "end":
            break
        windows = Windows.load(folder / order["windows"])
        try:
            if order["do"] == "density":
                value = runner.log_density(windows, as_log(windows))
                answer(value=None if value is None else np.asarray(value).tolist())
                continue
            windows = windows.select(slice(order["first"], order["first"] + order["count"]))
            wall: list[float] = []
            processor: list[float] = []
            stop = time.perf_counter() + order.get("patience_s", 0.0)
            for repeat in range(order.get("repeats", 1)):
                begun, begun_processor = time.perf_counter(), time.process_time()
                found = runner.run(windows, order["seed"] + repeat)
                wall.append(time.perf_counter() - begun)
                processor.append(time.process_time() - begun_processor)
                if time.perf_counter() > stop:
                    break
            keep = order.get("keep", len(windows))
            fields = {"mean": found.mean, "sd": found.sd, "ess": found.ess}
            kept = {k: np.asarray(v)[:keep] for k, v in fields.items() if v is not None}
            if found.draws is not None:
                kept["draws"] = np.asarray(found.draws)[:, :, :keep]
            np.savez(folder / order["out"], **kept)
            answer(wall=wall, processor=processor, peak_mb=memory_mb(peak=True) - baseline)
        except Exception as error:  # a peer that fails is a line of the table, not the end of the run
            import traceback

            traceback.print_exc()
            answer(error=f"{type(error).__name__}: {error}"[:300])


if __name__ == "__main__":
    main()
