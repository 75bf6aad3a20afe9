"""All estimators through the stream: one interface, unused windows, resume, and what is refused."""

from __future__ import annotations

import pytest
import torch

from avtorch.decision import Monitor
from avtorch.decision.monitor import DETECTORS
from avtorch.decision.settings import Setting
from avtorch.decision.watch import Watch
from avtorch.errors import InputError
from avtorch.inference import BeliefStream, SamplerSettings
from avtorch.inference.estimators import ESTIMATORS, make_estimator
from avtorch.inference.jerk import JerkForm
from avtorch.inference.latent import LatentForm
from tests.bars import BAR

F64 = torch.float64
NAMES = list(ESTIMATORS)
FIELDS = ["mean", "sd", "q05", "q95", "draws"]
QUICK = SamplerSettings(chains=64, draws=16)


def stream_of(name, **options):
    more = {"settings": QUICK} if name == "sgld" else {}
    return BeliefStream(**{"vehicles": 2, "estimator": name, "kept": 200, "seed": 4, **more, **options})


@pytest.fixture(scope="module")
def drive(make_windows):
    """Ten seconds: the second vehicle is commanded nothing for the second half, and a row is masked NaN."""
    w = make_windows(5, [1.0, 0.7], T=[0.4, 0.9], K=[0.9, 0.7], rows=1000)
    columns = {name: value.clone() for name, value in w.columns.items()}
    for value in columns.values():
        value[1, 600:] = 0.0
        value[0, 50] = torch.nan
    usable = torch.ones(2, 1000, dtype=torch.bool)
    usable[0, 50] = False
    return w.time, columns, usable


@pytest.mark.parametrize("name", NAMES)
def test_every_estimator_finds_the_vehicles_and_keeps_its_belief(name, drive):
    time, columns, usable = drive
    stream = stream_of(name)
    windows = stream.feed(time, columns, usable=usable) + stream.flush()
    truth = torch.tensor([[0.4, 0.9], [0.9, 0.7]], dtype=F64)
    assert len(windows) == 5
    for w in windows[:3]:
        assert w.belief.excited.all() & w.belief.converged.all()
        assert ((w.belief.mean[:, :2] - truth).abs() < 5 * w.belief.sd[:, :2] + 0.02).all()
        assert w.belief.draws.shape == (200, 2, 3)
    last = windows[2].belief
    for w in windows[3:]:
        assert w.belief.excited.tolist() == [True, False]
        for field in FIELDS:
            vehicle = (slice(None), 1) if field == "draws" else (1,)
            assert getattr(w.belief, field)[vehicle].equal(getattr(last, field)[vehicle])


@pytest.mark.parametrize("name", NAMES)
def test_resume_is_equal_to_the_bit(name, drive):
    time, columns, usable = drive
    straight = stream_of(name)
    expected = straight.feed(time, columns, usable=usable)[-1].belief
    first = stream_of(name)
    first.feed(time[:530], {k: v[:, :530] for k, v in columns.items()}, usable=usable[:, :530])
    second = stream_of(name, seed=77)
    second.load_state_dict(first.state_dict())
    found = second.feed(time[530:], {k: v[:, 530:] for k, v in columns.items()}, usable=usable[:, 530:])[-1].belief
    for field in FIELDS:
        assert getattr(found, field).equal(getattr(expected, field)), field


@pytest.mark.parametrize("name", NAMES)
def test_the_monitor_takes_every_belief(name, drive):
    time, columns, usable = drive
    watch = Watch(stream_of(name), Monitor(2, detectors=DETECTORS))
    for watched in watch.feed(time, columns, Setting(scenarios=2), usable=usable):
        assert watched.report.p_string_stable.isfinite().all()
        assert set(watched.report.alerts) == set(DETECTORS)


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["map", pytest.param("ekf", marks=pytest.mark.slow), "ukf"])
def test_noisy_acceleration_alone_will_do(name, make_windows, rotating_seed):
    w = make_windows(rotating_seed, [1.0], T=0.5, K=0.9, rows=500)
    g = torch.Generator().manual_seed(rotating_seed)
    accel = w.a + 0.05 * torch.randn(w.a.shape, generator=g, dtype=F64)
    stream = BeliefStream(window=5.0, form=LatentForm(accel=True, speed=False), estimator=name)
    (window,) = stream.feed(w.time, {"accel_cmd": w.u, "accel": accel}) + stream.flush()
    belief = window.belief
    assert belief.converged.all()
    assert ((belief.mean[0, :2] - torch.tensor([0.5, 0.9])).abs() < BAR * belief.sd[0, :2]).all()
    # learned something: the prior's SDs are 0.25 s and 0.3
    assert (belief.sd[0, :2] < torch.tensor([0.15, 0.2])).all()


def test_unknown_names_and_options_are_refused():
    with pytest.raises(InputError, match="sgld, importance, map, rls, ekf, ukf"):
        make_estimator("kalman", JerkForm())
    with pytest.raises(InputError, match=r"^drift: .*'rls'.*forgetting"):
        make_estimator("rls", JerkForm(), drift=0.1)
    with pytest.raises(InputError, match=r"^mode: .*'ekf'.*drift"):
        make_estimator("ekf", JerkForm(), mode="lambda")


def test_a_state_of_another_estimator_is_refused():
    state = stream_of("ekf").state_dict()
    with pytest.raises(InputError, match=r"^state: saved by the estimator 'ekf'"):
        stream_of("ukf").load_state_dict(state)
