"""Windows to validate on: what they range over, that a seed repeats them, and that a log's are those of the loop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.inference import BeliefStream, JerkDensity
from avtorch.io import Log
from avtorch.validation.windows import (
    AMPLITUDE,
    Windows,
    command,
    synthetic_windows,
    windows_of_log,
)
from avtorch.vehicle import GLVDPlant, Leader, simulate


@pytest.fixture(scope="module")
def log() -> Log:
    run = simulate(Leader.default(duration=13.0), plant=GLVDPlant(0.3, 1.0, sigma=0.1), duration=12.0, seeds=[1])
    return run.log()


def density(windows: Windows) -> JerkDensity:
    assert isinstance(windows.density, JerkDensity)
    return windows.density


def test_synthetic_windows_range_from_weak_to_strong() -> None:
    found = synthetic_windows(400, seed=3)
    assert found.name == "synthetic"
    assert found.form == "jerk"
    assert len(found) == 400
    assert found.n.unique(return_counts=True)[1].tolist() == [200, 200]
    assert found.truth is not None
    T, K, sigma = found.truth.unbind(-1)
    for value, (low, high) in ((T, (0.1, 2.0)), (K, (0.4, 1.1)), (sigma, (0.03, 0.3))):
        assert low <= float(value.min()) < low * 1.2
        assert high * 0.9 < float(value.max()) <= high
    assert 0.2 < float(found.excited.double().mean()) < 0.9
    assert torch.allclose(found.end_s, 0.01 * found.n)


def test_commands_have_the_size_asked_for() -> None:
    u = command(400, 500, generator=torch.Generator().manual_seed(0))
    peak = u.abs().amax(-1)
    low, high = AMPLITUDE
    assert low <= float(peak.min()) < 1.1 * low
    assert 0.9 * high < float(peak.max()) <= high
    # log-uniform: half of them below the geometric mean, within 5 sigma
    assert abs(float((peak < math.sqrt(low * high)).double().mean()) - 0.5) < 5 * 0.5 / 20
    # both kinds come with both numbers of points: a sum of sines is smooth, a piece of US06 has corners
    bend = u.diff(n=2).abs().amax(-1) / peak
    assert int((bend > 1e-10).sum()) == 400


def test_a_seed_repeats_and_another_does_not() -> None:
    first, again, other = (density(synthetic_windows(6, seed=s)).statistics for s in (1, 1, 2))
    assert torch.equal(first.jj, again.jj)
    assert not bool((first.jj == other.jj).any())


def test_windows_can_be_selected() -> None:
    found = synthetic_windows(5, seed=0)
    index = torch.tensor([3, 1])
    part = found.select(index)
    assert len(part) == 2
    assert part.truth is not None
    assert found.truth is not None
    assert torch.equal(part.truth, found.truth[index])
    assert torch.equal(density(part).statistics.jj, density(found).statistics.jj[index])
    for name in ("n", "excited", "start_s", "end_s"):
        assert torch.equal(getattr(part, name), getattr(found, name)[index])


def test_windows_of_a_log_are_those_of_the_loop(log: Log) -> None:
    engaged = np.ones(log.rows, bool)
    engaged[430:470] = False
    jerk = log.jerk.copy()  # type: ignore[union-attr]
    jerk[440] = np.nan
    segment = log.segment.copy()
    segment[700:] = 1
    log = replace(log, engaged=engaged, jerk=jerk, segment=segment)
    found = windows_of_log(log, window=2.0)
    stream = BeliefStream(window=2.0, gap=float("inf"))
    seen = []
    for part in log.segments():
        rows = {name: torch.from_numpy(getattr(log, name)[part]) for name in ("accel_cmd", "accel", "jerk")}
        seen += stream.feed(torch.from_numpy(log.time[part]), rows, usable=torch.from_numpy(log.usable[part]))
        seen += stream.flush()
    seen = [w for w in seen if int(w.n) >= 10]
    assert len(found) == len(seen)
    assert found.n.tolist() == [int(w.n) for w in seen]
    assert found.excited.tolist() == [bool(w.belief.excited) for w in seen]
    assert found.start_s.tolist() == pytest.approx([w.start_s for w in seen])
    assert found.end_s.tolist() == pytest.approx([w.end_s for w in seen], abs=0.011)
    assert found.truth is None
    assert found.form == "jerk"


def test_log_without_jerk_takes_the_latent_form(log: Log) -> None:
    found = windows_of_log(replace(log, jerk=None), window=3.0)
    assert found.form == "latent"
    assert found.names[:3] == ("T_L", "K_L", "process_noise")
    assert len(found) == 2
    assert bool(found.density.log_prob(found.density.initial()).isfinite().all())
    # the same number for a window alone as among others that are longer
    alone = found.select(torch.tensor([1]))
    z = found.density.initial()
    assert float(alone.density.log_prob(z[1:])) == pytest.approx(float(found.density.log_prob(z)[1]), rel=1e-8)


def test_a_count_takes_windows_evenly(log: Log) -> None:
    every = windows_of_log(log, window=2.0)
    assert windows_of_log(log, window=2.0, count=100).start_s.tolist() == every.start_s.tolist()
    few = windows_of_log(log, window=2.0, count=2)
    assert few.start_s.tolist() == [float(every.start_s[0]), float(every.start_s[-1])]


def test_what_cannot_be_used(log: Log) -> None:
    with pytest.raises(InputError, match="windows: found 0"):
        synthetic_windows(0)
    with pytest.raises(InputError, match="windows: found -1"):
        windows_of_log(log, count=-1)
    with pytest.raises(InputError, match="window: found nan"):
        windows_of_log(log, window=float("nan"))
    with pytest.raises(InputError, match=r"no window of 0\.05 s has 10 usable rows"):
        windows_of_log(log, window=0.05)
    with pytest.raises(InputError, match="accel_cmd"):
        windows_of_log(replace(log, accel_cmd=None))
