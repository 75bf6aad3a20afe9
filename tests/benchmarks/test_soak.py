"""The soak of the live watch, for seconds: what it counts, that it goes on, and that it finds what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import soak as soak_module
from benchmarks.soak import FAULTS, Progress, Soak, chunk, faults_of, slope, summary


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stretches of 4 s, the second of them killed, with ten times the faults."""
    monkeypatch.setattr(soak_module, "CHUNKS", 2)
    monkeypatch.setattr(soak_module, "KILL_EVERY", 2)
    monkeypatch.setattr(soak_module, "FAULTS", {kind: 10 * share for kind, share in FAULTS.items()})


def test_every_answer_is_the_batch_runs_through_faults_stops_and_a_kill(tmp_path: Path) -> None:
    for _ in range(2):  # the second goes on where the first ended
        one = Soak(tmp_path, cars=2)
        one.kill_after = 2
        one.stretch()
    p = one.progress
    assert (p.different, p.told_again, p.kills, p.stretches) == (0, 0, 1, 2)
    assert p.equal >= 2 * 3
    assert set(p.injected) == set(FAULTS)
    assert not faults_of(p), summary(p)
    # before the kill, and so nothing was read twice, the counts are exact
    first = Soak(tmp_path / "other", cars=2)
    first.stretch()
    assert {kind: first.progress.counted[kind] for kind in FAULTS} == first.progress.injected
    with pytest.raises(ValueError, match="is of 2 cars"):
        Soak(tmp_path, cars=3)


def test_a_row_that_is_not_the_batch_runs_is_found(tmp_path: Path, monkeypatch) -> None:
    """One number of one row, in its fifth decimal, of one car."""

    def spoiled(number: int, cars: int, seed: int = 0):
        made = chunk(number, cars, seed)
        made.rows[1][4, 50] += 1e-5
        return made

    monkeypatch.setattr(soak_module, "chunk", spoiled)
    one = Soak(tmp_path, cars=2)
    one.stretch()
    assert one.progress.different >= 1
    assert all('"car 1"' in example for example in one.progress.examples)
    assert "are not the batch run's" in faults_of(one.progress)[0]


def test_a_fault_that_is_not_counted_and_memory_that_grows_are_found() -> None:
    grows = [(0.1 * i, 300.0 + 0.5 * i + 0.1 * (i % 3)) for i in range(60)]
    found = slope(grows)
    assert found is not None
    np.testing.assert_allclose(found[0], 5.0, atol=found[1])
    assert found[1] < 1.0
    p = Progress(2, 0, injected={"late": 5}, counted={"late": 4, "failed": 1}, rss_mib=grows)
    assert set(faults_of(p)) == {
        "late: 5 injected, 4 counted",
        "failed: 0 injected, 1 counted",
        f"memory grows by {found[0]:.1f} MiB an hour",
    }
