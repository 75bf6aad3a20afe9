"""Watch: belief and monitor as one, in step, and resumed to the bit."""

import copy

import pytest
import torch

from avtorch.decision import DETECTORS, Monitor, Setting, Watch
from avtorch.errors import InputError
from avtorch.inference import BeliefStream
from avtorch.inference.sampler import SamplerSettings
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader

QUICK = SamplerSettings(chains=16, draws=20)
NEW = Setting(T_hat=1.5, K_hat=0.5, scenarios=2)


@pytest.fixture(scope="module")
def blocks():
    """A supervisor's drive: uneven blocks, standstill, a change for one of two cars, a crash of none."""
    loop = ClosedLoop(Leader.default(start=46), scenarios=2, seeds=3)
    out = [loop.advance(steps) for steps in (200, 200, 137, 63, 200)]
    loop.plant = GLVDPlant(torch.tensor([1.5, 0.3]), torch.tensor([0.5, 1.0]), 0.1)
    return [*out, *(loop.advance(steps) for steps in (200, 1, 199, 200, 150, 50, 200))]


def make(seed=11, detectors=DETECTORS):
    return Watch(BeliefStream(window=2.0, vehicles=2, seed=seed, settings=QUICK), Monitor(2, detectors=detectors))


def drive(watch, blocks, first=0, between=lambda watch, i: watch):
    """Feed as the supervisor does, with a new setting and an acceptance on the way; `between` may swap the watch."""
    windows = []
    for i, block in enumerate(blocks[first:], first):
        watch = between(watch, i)
        columns = {"accel_cmd": block.accel_cmd, "accel": block.accel, "speed": block.speed, "jerk": block.jerk}
        setting = NEW if i > 8 else Setting(scenarios=2)
        until = float(block.time[-1]) + 0.01
        windows += watch.feed(block.time, columns, setting, usable=block.speed >= 0.3, until=until)
        if i == 8:
            watch.monitor.accept(torch.tensor([True, False]))
    return watch, windows


@pytest.fixture(scope="module")
def uncut(blocks):
    return drive(make(), blocks)


def assert_alike(some, others):
    assert len(some) == len(others)
    for a, b in zip(some, others, strict=True):
        assert (a.window.start_s, a.window.end_s) == (b.window.start_s, b.window.end_s)
        for name in ("mean", "sd", "q05", "q95", "draws", "excited", "converged"):
            assert torch.equal(getattr(a.window.belief, name), getattr(b.window.belief, name))
        assert a.report.alerts.keys() == b.report.alerts.keys()
        for kind in ("alerts", "statistics"):
            one, other = getattr(a.report, kind), getattr(b.report, kind)
            assert all(torch.equal(one[name], other[name]) for name in one)
        assert torch.equal(a.report.p_string_stable, b.report.p_string_stable)
        assert all(torch.equal(x, y) for x, y in zip(a.report.accepted, b.report.accepted, strict=True))


def flat(state, path=""):
    """The leaves of a state, by path."""
    if isinstance(state, dict):
        return {k: v for key, value in state.items() for k, v in flat(value, f"{path}/{key}").items()}
    if isinstance(state, list):
        return {k: v for i, value in enumerate(state) for k, v in flat(value, f"{path}/{i}").items()}
    return {path: state}


def test_windows_are_watched_under_the_setting_they_were_fed_with(uncut):
    _, windows = uncut
    # 18 s of rows, minus a window that has yet to end
    assert [w.window.end_s for w in windows] == pytest.approx([2.0 * k for k in range(1, 10)])
    changed = [w for w in windows if w.window.end_s > 13.5]
    assert all(w.setting is NEW for w in changed[-2:])
    for w in windows:
        T_L, K_L = (w.window.belief.draws[..., i].mT for i in range(2))
        assert torch.equal(w.report.p_string_stable, w.setting.p_string_stable(T_L, K_L))
        used = w.window.belief.excited & w.window.belief.converged
        assert not bool((w.report.any & ~used).any())
    first = {i: [w.window.end_s for w in windows if bool(w.report.alerts["stability"][i])] for i in range(2)}
    assert first[0][0] == pytest.approx(10.0)
    assert first[1] == []


@pytest.mark.parametrize("save_at", [1, 3, 7, 9, 11])
def test_a_resumed_watch_goes_on_to_the_bit(blocks, uncut, save_at, tmp_path):
    """Saved between any two blocks, in the midst of a window or not, to a file that holds no code, into a fresh watch
    of another seed."""
    whole_end, whole = uncut

    def resume(watch, i):
        if i != save_at:
            return watch
        torch.save(watch.state_dict(), tmp_path / "watch.pt")
        fresh = make(seed=999)
        fresh.load_state_dict(torch.load(tmp_path / "watch.pt", weights_only=True))
        return fresh

    end, resumed = drive(make(), blocks, between=resume)
    assert_alike(whole, resumed)
    one, other = flat(whole_end.state_dict()), flat(end.state_dict())
    assert one.keys() == other.keys()
    assert all(torch.equal(v, other[k]) if torch.is_tensor(v) else v == other[k] for k, v in one.items())


def test_a_saved_state_stays_as_it_was(blocks):
    """Going on with the watch does not reach back into the state it gave."""
    watch, _ = drive(make(), blocks[:7])
    state = watch.state_dict()
    kept = {k: v.clone() if torch.is_tensor(v) else v for k, v in flat(state).items()}
    _, first = drive(watch, blocks, first=7)
    assert all(torch.equal(v, kept[k]) if torch.is_tensor(v) else v == kept[k] for k, v in flat(state).items())
    again = make(seed=1)
    again.load_state_dict(state)
    assert_alike(first, drive(again, blocks, first=7)[1])


def test_a_flushed_window_is_watched_too(blocks):
    watch = make()
    _, windows = drive(watch, blocks[:5])
    block = blocks[5]
    columns = {"accel_cmd": block.accel_cmd, "accel": block.accel, "jerk": block.jerk}
    half = {k: v[:, :120] for k, v in columns.items()}
    assert watch.feed(block.time[:120], half, NEW) == []
    (last,) = watch.flush(NEW)
    assert last.setting is NEW
    assert last.window.end_s == pytest.approx(9.2)
    assert last.window.n.tolist() == [120, 120]
    assert watch.flush(NEW) == []
    assert [w.window.end_s for w in windows] == pytest.approx([2.0, 4.0, 6.0, 8.0])


def test_a_watch_of_another_kind_is_refused():
    with pytest.raises(InputError, match="monitor"):
        Watch(BeliefStream(vehicles=2), Monitor(3))
    state = make().state_dict()
    with pytest.raises(InputError, match="state"):
        make(detectors=("stability",)).load_state_dict(state)
    with pytest.raises(InputError, match="state"):
        Watch(BeliefStream(window=1.0, vehicles=2), Monitor(2, detectors=DETECTORS)).load_state_dict(state)
    with pytest.raises(InputError, match="state"):
        Watch(BeliefStream(vehicles=3), Monitor(3, detectors=DETECTORS)).load_state_dict(state)


def test_a_refused_state_leaves_the_whole_watch_as_it_was(blocks):
    """A damaged monitor state makes the whole state refused, the stream's included."""
    state = drive(make(), blocks[:2])[0].state_dict()
    changes = [
        lambda s: s.pop("monitor"),
        lambda s: s.update(monitor=None),
        lambda s: s["monitor"].pop("mean"),
        lambda s: s["monitor"]["mean"].__setitem__(0, s["monitor"]["mean"][0] * torch.nan),
        lambda s: s["monitor"].update(has_baseline=torch.zeros(3, dtype=torch.bool)),
        lambda s: s["monitor"]["charts"].popitem(),
    ]
    for change in changes:
        other = copy.deepcopy(state)
        change(other)
        watch = make(seed=9)
        before = flat(watch.state_dict())
        with pytest.raises(InputError, match=r"^state: "):
            watch.load_state_dict(other)
        after = flat(watch.state_dict())
        assert before.keys() == after.keys()
        assert all(torch.equal(v, after[k]) if torch.is_tensor(v) else v == after[k] for k, v in before.items())
