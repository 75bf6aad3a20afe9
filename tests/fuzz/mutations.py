"""How the fuzzer damages valid inputs, how many it tries, and which outcomes it accepts.

Every run draws anew; AVTORCH_SEED repeats one, and a failure prints it. AVTORCH_FUZZ is the number of inputs in all
(default 1,500; 100,000 for a night: `make fuzz`), shared out by the weights of the targets.
"""

from __future__ import annotations

import os
import re
import signal
import threading
import time
import tracemalloc
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from hypothesis import HealthCheck, note, seed, settings
from hypothesis import strategies as st

from avtorch.errors import InputError, printable

SEED = int(os.environ.get("AVTORCH_SEED", time.time_ns() % 2**31))
TOTAL = int(os.environ.get("AVTORCH_FUZZ", "1500"))
WEIGHTS = {
    "csv": 400, "csv_cells": 200, "parquet": 200, "arrays": 150, "leaders": 100, "mapping": 150, "plant": 200,
    "words": 150, "options": 100, "check": 60,
}  # fmt: skip

_SECONDS = 20.0  # for one input; the slowest takes a few hundredths
_LONGEST = 500  # characters of a message
_PEAK = 50e6  # bytes that reading 10 kB may take, of those that Python allocates
_MEASURED = 25  # every so many inputs, as measuring slows them down

T = TypeVar("T")


def fuzzed(target: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Settings of a test of the fuzzer: its share of the inputs, a seed of this run, no memory of earlier runs."""
    share = max(1, round(TOTAL * WEIGHTS[target] / sum(WEIGHTS.values())))
    chosen = settings(
        max_examples=share,
        deadline=None,  # `outcome` stops one that hangs; the machine may be busy
        database=None,
        derandomize=False,
        print_blob=True,
        suppress_health_check=list(HealthCheck),
    )
    return lambda test: seed(SEED)(chosen(test))


_count = 0


def outcome(read: Callable[[], T], *, most: int = _LONGEST) -> T | None:
    """The result of `read`, or None where it refuses with one printable line. Anything else fails: another exception, a
    warning, an input that takes longer than 20 s, or, of every 25th input, more than 50 MB."""
    global _count
    _count += 1
    note(f"AVTORCH_SEED={SEED}")
    measured = _count % _MEASURED == 0
    main = threading.current_thread() is threading.main_thread()
    if main:
        before = signal.signal(signal.SIGALRM, _late)
        signal.setitimer(signal.ITIMER_REAL, _SECONDS)
    if measured:
        tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            answer = read()
    except InputError as fault:
        said = str(fault)
        assert printable(said) == said, said
        assert 0 < len(said) <= most, said
        answer = None
    finally:
        if main:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        peak = tracemalloc.get_traced_memory()[1] if measured else 0
        if measured:
            tracemalloc.stop()
    assert peak < _PEAK, f"took {peak / 1e6:.0f} MB"
    return answer


def _late(*_: Any) -> None:
    raise TimeoutError(f"took longer than {_SECONDS:g} s")


AWKWARD = [
    b"", b"\x00", b"\xff", b"\xef\xbb\xbf", b"\xff\xfe", b"\xc2", b"\xed\xb2\x80", b'"', b'""', b"'", b",", b",,", b";",
    b"\t", b"\n", b"\r", b"\r\n", b"\n\n\n", b"\x0b", b"\x0c", b"\x1c", b"\x85", b"\x1b[2J", b"\x07", b"\\", b"#", b"=",
    "\u2028".encode(), "\u202e".encode(), "\u00a0".encode(), "\ufeff".encode(), "１２".encode(), "٣".encode(),
    b"nan", b"NaN", b"inf", b"-Infinity", b"1e400", b"-1e-400", b"1e308", b"-0", b"0", b"1_0", b"0x1F", b"1,5", b".5",
    b"5.", b"1e5", b"+1", b"--1", b"9" * 400, b"99999999999999999999", b"true", b"false", b"null", b"None", b"[", b"]",
    b"{", b"}", b"[[", b"]]", b"[[[[" * 300, b"a." * 100, b"x" * 3000, b"time", b"speed", b"accel_cmd", b"engaged",
    b"segment", b"2026-11-22", b"12:00:01", b"1979-05-27T07:32:00Z", b"PAR1", b"${7*7}", b"{{7*7}}", b"<script>",
    b"../",
]  # fmt: skip


class Raw(bytes):
    """Bytes whose beginning is shown where a test fails; a seed brings back the rest."""

    def __repr__(self) -> str:
        return repr(bytes(self[:1000])) + (f" and {len(self) - 1000} more" if len(self) > 1000 else "")


@st.composite
def mutated(draw: st.DrawFn, whole: Sequence[bytes]) -> Raw:
    """One of the `whole` inputs with one to four damages; now and then none, as whole ones must pass."""
    raw = bytearray(draw(st.sampled_from(list(whole))))
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, len(raw)))
        length = draw(st.integers(1, 24))
        kinds = ["flip", "digit", "digit", "insert", "replace", "delete", "repeat", "move", "cut", "swap"]
        kind = draw(st.sampled_from(kinds))
        if kind == "flip" and at < len(raw):
            raw[at] ^= draw(st.integers(1, 255))
        elif kind == "digit" and (number := re.search(rb"[0-9]", raw[at:])):  # it stays a number, but another one
            raw[at + number.start()] = draw(st.sampled_from(b"0123456789"))
        elif kind == "insert":
            raw[at:at] = draw(st.sampled_from(AWKWARD) | st.binary(max_size=8))
        elif kind == "replace":
            raw[at : at + length] = draw(st.sampled_from(AWKWARD) | st.binary(max_size=8))
        elif kind == "delete":
            del raw[at : at + length]
        elif kind == "repeat":
            raw[at:at] = raw[at : at + length] * draw(st.integers(1, 50))
        elif kind == "move":
            piece = raw[at : at + length]
            del raw[at : at + length]
            to = draw(st.integers(0, len(raw)))
            raw[to:to] = piece
        elif kind == "cut":
            del raw[at:]
        elif kind == "swap":
            one, other = draw(
                st.sampled_from([(b",", b";"), (b"\n", b"\r"), (b"\n", b"\r\n"), (b".", b","), (b"=", b":")])
            )
            raw = bytearray(bytes(raw).replace(one, other))
    if draw(st.integers(0, 19)) == 0:
        to = draw(st.sampled_from(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "latin-1", "utf-7", "cp500"]))
        return Raw(bytes(raw).decode("latin-1").encode(to, "replace"))
    return Raw(raw)
