"""How a test that draws is run: recorded seeds first, then a new one, and a failed bar once more with more samples.

A pytest plugin, loaded by `tests/conftest.py`. It replaces pytest-rerunfailures, which cannot run a recorded seed
before a new one, also repeats failures in a fixture or while an AssertionError was handled, and does not distinguish an
assertion of the test from one inside the package. With xdist the workers draw; their reports carry the seeds to the
controller, which counts and writes.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import pytest
from _pytest.runner import runtestprotocol

from tests import failed_seeds

REDRAWS = 2
"""Redraws that a run may take. Bars are such that a run takes one in a hundred (`tests.bars`)."""
LARGER = 4
"""Times as many samples in a redraw and for a recorded seed."""


@dataclass(frozen=True)
class Draw:
    """One run of one test: its seed, and how many times the usual number of samples it takes."""

    seed: int
    factor: int = 1
    origin: Literal["new", "recorded", "named"] = "new"

    def __str__(self) -> str:
        return f"AVTORCH_SEED={self.seed}" + (f" AVTORCH_DRAWS={self.factor}" if self.factor > 1 else "")


DRAW = pytest.StashKey[Draw]()
OWN_ASSERTION = pytest.StashKey[bool]()
RECORDED = pytest.StashKey[failed_seeds.Seeds]()


@pytest.fixture
def rotating_seed(request: pytest.FixtureRequest) -> int:
    """A seed that changes with every run, for tests marked `statistical`; printed when the test fails.

    A failed bar is drawn once more. AVTORCH_SEED repeats a failure, with AVTORCH_DRAWS where the print names it.
    """
    return _seed(request)


@pytest.fixture
def fresh_seed(request: pytest.FixtureRequest) -> int:
    """The same for exact properties under random inputs: each must hold, so that a failure is not drawn again."""
    return _seed(request)


def _seed(request: pytest.FixtureRequest) -> int:
    draw = request.node.stash[DRAW]
    kept = f", recorded in {failed_seeds.NAME}" if draw.origin == "recorded" else ""
    print(f"{draw} for {request.node.nodeid}{kept}")
    return draw.seed


@pytest.fixture
def draws_factor(request: pytest.FixtureRequest) -> int:
    """How many times as many samples to draw: 1, or 4 after a failed bar and for a recorded seed.

    A bar of k standard errors that is computed from the number of samples becomes half as wide. A correct program
    misses it as rarely as the first. A bias that stands at z standard errors in the first draw stands at 2 z in the
    second: one of the bar's own size, which a first draw detects half the time, fails the second.
    """
    return request.node.stash[DRAW].factor


def own_assertion(excinfo: pytest.ExceptionInfo[BaseException], item: pytest.Item) -> bool:
    """Whether the test itself asserted: every frame from the test on lies in the tests or in an array comparison.

    An AssertionError out of the package or of a library is a crash, whatever its name.
    """
    if type(excinfo.value) is not AssertionError:
        return False
    home = item.config.rootpath / item.nodeid.split("::")[0].split("/")[0]

    def in_tests(entry: pytest.TracebackEntry) -> bool:
        return home == entry.path or home in getattr(entry.path, "parents", ())

    frames = list(excinfo.traceback)
    while frames and not in_tests(frames[0]):  # pytest's own
        frames.pop(0)
    compared = ("numpy.testing", "torch.testing", "contextlib")
    return bool(frames) and all(
        in_tests(f) or str(f.frame.f_globals.get("__name__", "")).startswith(compared) for f in frames
    )


def pytest_configure(config: pytest.Config) -> None:
    try:
        config.stash[RECORDED] = failed_seeds.recorded(config.rootpath)
    except ValueError as wrong:
        raise pytest.UsageError(str(wrong)) from wrong
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Count(config), "redraws-count")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    report = yield
    if DRAW in item.stash and report.failed:
        item.stash[OWN_ASSERTION] = bool(
            call.when == "call" and call.excinfo is not None and own_assertion(call.excinfo, item)
        )
        draw = item.stash[DRAW]
        report.failed_draw = {"seed": draw.seed, "said": str(draw), "origin": draw.origin}
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    if not {"rotating_seed", "fresh_seed"} & set(getattr(item, "fixturenames", ())):
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for report in _reports(item, nextitem):
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def _reports(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[pytest.TestReport]:
    """Of all draws of a test what is to be reported: a pass of a recorded seed is not, a redrawn failure is."""
    named = os.environ.get("AVTORCH_SEED")
    if named is not None:
        yield from _drawn(item, nextitem, Draw(int(named), int(os.environ.get("AVTORCH_DRAWS", "1")), "named"))
        return
    for seed in item.config.stash[RECORDED].get(item.nodeid, ()):
        reports = _drawn(item, nextitem, Draw(seed, LARGER, "recorded"))
        if any(r.failed for r in reports):
            yield from reports
            return
    reports = _drawn(item, nextitem, Draw(secrets.randbelow(2**31)))
    failed = [r for r in reports if r.failed]
    again = item.get_closest_marker("statistical") and len(failed) == 1 and item.stash.get(OWN_ASSERTION, False)
    if again:
        # not "failed": a session counts those, and ends with them
        failed[0].outcome = "redrawn"  # type: ignore[assignment]
        yield failed[0]
        reports = _drawn(item, nextitem, Draw(secrets.randbelow(2**31), LARGER))
    yield from reports


def _drawn(item: pytest.Item, nextitem: pytest.Item | None, draw: Draw) -> list[pytest.TestReport]:
    """Fixtures, test and teardown with one seed. Fixtures of a module may be built anew before the next draw."""
    item.stash[DRAW] = draw
    item.stash[OWN_ASSERTION] = False
    return runtestprotocol(item, nextitem=nextitem, log=False)


def pytest_report_teststatus(report: pytest.TestReport) -> tuple[str, str, tuple[str, dict[str, bool]]] | None:
    if report.outcome == "redrawn":
        return "redrawn", "R", ("REDRAWN", {"yellow": True})
    return None


class Count:
    """Adds up over all workers: writes the seeds that failed, and fails a run that was drawn again too often."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.again: list[str] = []
        self.failed: failed_seeds.Seeds = {}
        self.written = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        draw = getattr(report, "failed_draw", None)
        if draw is None:
            return
        if draw["origin"] == "new":
            self.failed.setdefault(report.nodeid, []).append(draw["seed"])
        if report.outcome == "redrawn":
            self.again.append(f"{draw['said']} for {report.nodeid}")

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if len(self.again) > REDRAWS and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        if self.failed:
            try:
                path = failed_seeds.add(self.config.rootpath, self.failed)
            except OSError as fault:  # a checkout that cannot be written to: the seeds are on the terminal
                self.written = f"not kept: {fault}"
            else:
                self.written = f"kept in {path}: drawn first from now on"

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """What was drawn again is shown in full: a mismatch too small to fail twice is still to be read."""
        line = terminalreporter.write_line
        if self.again:
            terminalreporter.section("drawn again after a failure")
        for report in terminalreporter.stats.get("redrawn", []):
            line(f"{report.nodeid}\n{report.longreprtext}\n{report.capstdout}")
        if self.failed:
            terminalreporter.section("seeds that failed")
            for test, seeds in failed_seeds.merged(self.failed).items():
                line(f"{test}: {', '.join(map(str, seeds))}")
            line(self.written)
        if len(self.again) > REDRAWS:
            line(f"FAILED: {len(self.again)} tests were drawn again, at most {REDRAWS} may be:", red=True)
            for one in self.again:
                line(f"  {one}", red=True)
