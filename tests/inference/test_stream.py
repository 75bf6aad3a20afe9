"""The stream: cutting into blocks, saving in mid window, gaps, masks, bounded memory, and what it refuses."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import BeliefStream, SamplerSettings, Window
from avtorch.inference.stream import packed, unpacked

F64 = torch.float64
SMALL = SamplerSettings(chains=8, draws=16, burn_in=4)


@pytest.fixture(scope="module")
def drive(make_windows):
    """Ten seconds of two vehicles: the second rests for some of them."""
    w = make_windows(1, [1.0, 0.8], T=[0.3, 0.8], rows=1000)
    w.u[1, 300:700], w.a[1, 300:700] = 0.0, 0.0
    return w


def block(w, part: slice) -> tuple[Tensor, dict[str, Tensor]]:
    return w.time[part], {name: value[:, part] for name, value in w.columns.items()}


def new(**options) -> BeliefStream:
    return BeliefStream(**{"vehicles": 2, "settings": SMALL, "kept": 50, "seed": 4, **options})


def assert_same(one: list[Window], other: list[Window]) -> None:
    assert [(w.start_s, w.end_s) for w in one] == [(w.start_s, w.end_s) for w in other]
    for a, b in zip(one, other, strict=True):
        assert a.n.equal(b.n)
        for name in ("mean", "sd", "q05", "q95", "draws", "excited", "converged"):
            assert getattr(a.belief, name).equal(getattr(b.belief, name)), (a.start_s, name)


def test_windows_lie_on_the_logs_own_clock(drive):
    time, columns = block(drive, slice(None))
    stream = new()
    windows = stream.feed(time + 100.0, columns)
    assert [(w.start_s, w.end_s) for w in windows] == [(100.0 + 2 * k, 102.0 + 2 * k) for k in range(4)]
    # the row at 108 s is the first of the fifth window, which nothing has closed yet
    assert all(w.n.tolist() == [200, 200] for w in windows)
    last = stream.feed(time[:0], {n: c[:, :0] for n, c in columns.items()}, until=110.0)
    assert [(w.start_s, w.end_s, w.n.tolist()) for w in last] == [(108.0, 110.0, [200, 200])]
    assert windows[0].belief.names == ("T_L", "K_L", "sigma")


@pytest.mark.slow
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, 600), max_size=12), st.integers(0, 12))
def test_neither_cuts_nor_saving_change_a_bit(drive, cuts, save_at):
    whole = new()
    expected = whole.feed(*block(drive, slice(0, 600)), until=6.0)
    assert len(expected) == 3
    stream, windows = new(), []
    edges = [0, *sorted(cuts), 600]
    for k, (first, last) in enumerate(pairwise(edges)):
        windows += stream.feed(*block(drive, slice(first, last)))
        if k == save_at:
            state = packed(stream.state_dict())
            stream = new(seed=99)
            stream.load_state_dict(unpacked(state, Path("state"), ""))
    windows += stream.flush()
    assert_same(expected, windows)


def test_the_end_of_the_open_window_is_known(drive):
    stream = new(estimator="map", window=2.0)
    assert stream.closes_at is None
    time, columns = block(drive, slice(0, 250))
    stream.feed(time + 1_700_000_000.0, columns)
    # on the clock of the rows, whose float64 comes in steps of 2.4e-7 s
    assert stream.closes_at == pytest.approx(1_700_000_000.0 + float(time[0]) + 4.0, abs=1e-6)
    stream.flush()
    assert stream.closes_at is None


@pytest.mark.slow
def test_memory_is_bounded(drive):
    """After an hour of rows the state is as large as after the first window, and what a block brings is not kept."""
    stream = new(vehicles=1)
    time = 0.01 * torch.arange(6000, dtype=F64)
    zero = torch.zeros(6000, dtype=F64)
    sizes = []
    for k in range(60):
        stream.feed(time + 60.0 * k, {"accel_cmd": zero, "accel": zero, "jerk": zero})
        state = stream.state_dict()
        sizes.append(sum(v.untyped_storage().nbytes() for v in state["rows"].values()))
        sizes[-1] += sum(v.untyped_storage().nbytes() for v in state["inference"].values() if isinstance(v, Tensor))
    assert max(sizes) <= sizes[0]
    assert state["rows"]["time"].shape[-1] <= 200


@pytest.mark.parametrize("cut", [0, 250, 300, 301])
def test_a_gap_restarts_the_grid(drive, cut):
    """Rows from 3.01 s to 4.2 s are lost: the open window ends with its rows, the next starts behind the gap."""
    keep = torch.cat([torch.arange(301), torch.arange(420, 1000)])
    time, columns = drive.time[keep], {n: c[:, keep] for n, c in drive.columns.items()}
    stream = new()
    windows = stream.feed(time[:cut], {n: c[:, :cut] for n, c in columns.items()})
    windows += stream.feed(time[cut:], {n: c[:, cut:] for n, c in columns.items()})
    windows += stream.flush()
    bounds = [(round(w.start_s, 9), round(w.end_s, 9), int(w.n[0])) for w in windows]
    assert bounds == [(0.0, 2.0, 200), (2.0, 3.01, 101), (4.2, 6.2, 200), (6.2, 8.2, 200), (8.2, 10.0, 180)]


def test_a_gap_is_seen_although_the_window_before_it_is_closed(drive):
    stream = new()
    first = stream.feed(*block(drive, slice(0, 200)), until=2.0)
    rest = stream.feed(*block(drive, slice(330, 1000)))
    assert [w.start_s for w in first + rest] == pytest.approx([0.0, 3.3, 5.3, 7.3])


def test_a_short_gap_is_none(drive):
    keep = torch.cat([torch.arange(250), torch.arange(290, 1000)])
    windows = new().feed(drive.time[keep], {n: c[:, keep] for n, c in drive.columns.items()})
    assert [(w.start_s, int(w.n[0])) for w in windows] == [(0.0, 200), (2.0, 160), (4.0, 200), (6.0, 200)]


def test_the_clock_closes_windows_that_no_row_reaches(drive):
    stream = new()
    windows = stream.feed(*block(drive, slice(0, 200)), until=7.0)
    assert [(w.start_s, int(w.n[0])) for w in windows] == [(0.0, 200), (2.0, 0), (4.0, 0)]
    assert windows[0].belief.excited.all()
    assert not windows[1].belief.excited.any()
    assert windows[2].belief.mean.equal(windows[0].belief.mean)


def test_masked_rows_do_not_count_and_may_hold_anything(drive):
    time, columns = block(drive, slice(0, 400))
    usable = torch.ones(2, 400, dtype=torch.bool)
    usable[0, 20:60] = False
    usable[1, 150:400] = False
    garbled = {n: torch.where(usable, c, torch.nan) for n, c in columns.items()}
    clean = new().feed(time, columns, usable=usable, until=4.0)
    dirty = new().feed(time, garbled, usable=usable, until=4.0)
    assert_same(clean, dirty)
    assert [w.n.tolist() for w in clean] == [[160, 150], [200, 0]]
    assert clean[1].belief.excited.tolist() == [True, False]
    assert clean[1].belief.mean[1].equal(clean[0].belief.mean[1])
    # a mask alone, (time,), is for every vehicle
    half = new().feed(time, columns, usable=usable[1], until=4.0)
    assert [w.n.tolist() for w in half] == [[150, 150], [0, 0]]


def test_resting_leaves_the_belief(drive):
    windows = new().feed(*block(drive, slice(None)), until=10.0)
    # vehicle 1 rests from 3 s to 7 s: the window from 4 s to 6 s teaches nothing
    assert windows[2].belief.excited.tolist() == [True, False]
    assert windows[2].belief.draws[:, 1].equal(windows[1].belief.draws[:, 1])


def test_what_is_refused_and_that_nothing_of_it_stays(drive):
    time, columns = block(drive, slice(0, 250))
    stream = new()
    stream.feed(time, columns)
    before = stream.state_dict()
    more, next_columns = block(drive, slice(250, 300))
    not_finite = {**next_columns, "accel": next_columns["accel"].index_fill(1, torch.tensor(7), math.nan)}
    swapped = more.clone()
    swapped[[10, 11]] = more[[11, 10]]
    doubled = more.clone()
    doubled[10] = more[9]
    infinite = more.clone()
    infinite[3] = math.inf
    cases = [
        (more - 1.0, next_columns, r"^time: does not increase at 1\.5 s"),
        (swapped, next_columns, r"^time: does not increase at 2\.6 s"),
        (doubled, next_columns, r"^time: does not increase at 2\.59 s"),
        (infinite, next_columns, r"^time: of shape \(50,\), needs finite numbers"),
        (more[:, None], next_columns, r"^time: of shape \(50, 1\)"),
        (more, {"accel": next_columns["accel"]}, "^columns: accel_cmd is missing"),
        (more[:-1], next_columns, r"^usable|^accel_cmd: of shape \(2, 50\)"),
        (more, {**next_columns, "jerk": next_columns["jerk"][:1].repeat(3, 1)}, r"^jerk: of shape \(3, 50\)"),
        (more, {**next_columns, "jerk": torch.tensor(0.0)}, r"^jerk: of shape \(\)"),
        (more, not_finite, r"^accel: not finite at 2\.57 s"),
    ]
    for bad_time, bad_columns, message in cases:
        with pytest.raises(InputError, match=message) as caught:
            stream.feed(bad_time, bad_columns)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"^usable: of shape \(3, 50\)"):
        stream.feed(more, next_columns, usable=torch.ones(3, 50, dtype=torch.bool))
    after = stream.state_dict()
    for name, value in before["rows"].items():
        assert value.equal(after["rows"][name])
    assert stream.feed(more, next_columns) == []


def test_rows_of_a_closed_window_are_refused(drive):
    stream = new()
    stream.feed(*block(drive, slice(0, 150)), until=2.0)
    with pytest.raises(InputError, match=r"^time: a row at 1\.5 s, .* closed"):
        stream.feed(*block(drive, slice(150, 260)))
    # time goes on behind a flush, too
    stream.flush()
    with pytest.raises(InputError, match=r"^time: does not increase"):
        stream.feed(*block(drive, slice(100, 260)))


@pytest.mark.parametrize(
    ("options", "name"), [({"window": 0.0}, "window"), ({"window": math.nan}, "window"), ({"gap": -1.0}, "gap")]
)
def test_bad_arguments_are_refused_by_name(options, name):
    with pytest.raises(InputError, match=rf"^{name}: "):
        BeliefStream(**options)


def test_a_state_of_another_stream_is_refused():
    state = new().state_dict()
    for options in ({"window": 5.0}, {"vehicles": 3}, {"mode": "posterior"}):
        with pytest.raises(InputError, match=r"^state: "):
            new(**options).load_state_dict(state)


@pytest.mark.slow
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, 1000), max_size=8), st.integers(0, 8))
def test_a_driver_masks_his_rows_and_the_settling_after_them(drive, cuts, save_at):
    """One vehicle of two is taken over: what it holds then and in the 2 s after may be anything, however it is cut."""
    time, columns = block(drive, slice(None))
    engaged = torch.ones(2, 1000, dtype=torch.bool)
    engaged[0, 250:420] = False
    usable = engaged.clone()
    usable[0, 250:620] = False
    expected = new().feed(time, columns, usable=usable, until=10.0)
    assert [int(w.n[0]) for w in expected] == [200, 50, 0, 180, 200]
    garbled = {n: torch.where(usable, c, torch.nan) for n, c in columns.items()}
    stream, windows = new(), []
    for k, (first, last) in enumerate(pairwise([0, *sorted(cuts), 1000])):
        part = slice(first, last)
        # `engaged` may be omitted while no driver is in charge: the settling continues
        on = None if bool(engaged[:, part].all()) else engaged[:, part]
        windows += stream.feed(time[part], {n: c[:, part] for n, c in garbled.items()}, engaged=on)
        if k == save_at:
            state = packed(stream.state_dict())
            stream = new(seed=99)
            stream.load_state_dict(unpacked(state, Path("state"), ""))
    assert_same(expected, windows + stream.feed(time[:0], {n: c[:, :0] for n, c in columns.items()}, until=10.0))


def test_a_driver_is_given_by_vehicle_and_row(drive):
    time, columns = block(drive, slice(0, 10))
    with pytest.raises(InputError, match=r"engaged: of shape \(2, 9\), needs \(2, 10\)"):
        new().feed(time, columns, engaged=torch.ones(2, 9, dtype=torch.bool))
    # what is neither 0 nor 1 once counted as engaged
    for odd in (0.5, float("nan"), -1.0):
        with pytest.raises(InputError, match=r"engaged: found .*, needs 0 \(driver\) or 1"):
            new().feed(time, columns, engaged=torch.full((2, 10), odd))
    stream = new()
    broken = {n: torch.full_like(c, torch.nan) for n, c in columns.items()}
    with pytest.raises(InputError, match="not finite"):
        stream.feed(time, broken, engaged=torch.tensor([[False], [True]]).expand(2, 10))
    # nothing of a block that is refused is taken in, the driver neither
    stream.feed(time, columns)
    (window,) = stream.flush()
    assert window.n.tolist() == [10, 10]
