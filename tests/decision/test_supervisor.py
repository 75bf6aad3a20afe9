"""The supervisor end to end: its input, its alerts, the settings it puts in force, and when."""

import dataclasses

import pytest
import torch

from avtorch.decision import Grid, Monitor, Setting, Strategist, Supervisor
from avtorch.decision.supervisor import HISTORY_S, read_setting
from avtorch.errors import InputError
from avtorch.inference import BeliefStream
from avtorch.inference.latent import LatentForm
from avtorch.inference.sampler import SamplerSettings
from avtorch.vehicle import MPC, ClosedLoop, GLVDPlant, Leader, LinearController, LowerLevel, simulate

# The second pull-off of US06: full excitation from the third second on.
LEADER = Leader.default(start=48)
WIDE, REAL = (-60.0, 60.0), (-6.0, 4.0)


def make_loop(n=1, *, seeds=7, limits=REAL, **given):
    given.setdefault("lower_level", LowerLevel(accel_min=limits[0], accel_max=limits[1]))
    given.setdefault("plant", GLVDPlant(0.3, 1.0, 0.1))
    return ClosedLoop(given.pop("leader", LEADER), scenarios=n, seeds=seeds, **given)


def becomes(T, K):
    def change(loop):
        loop.plant = GLVDPlant(T, K, 0.1)

    return change


def mpc_gains(gap):
    return MPC(time_gap=gap).gains


def mpc_strategist(**more):
    return Strategist(Grid(allowed=frozenset({1, 2}), gains_of_gap=mpc_gains), **more)


class Spy(Strategist):
    """A strategist that notes what it was asked."""

    def decide(self, *args, **how):
        decision = super().decide(*args, **how)
        self.asked.append((args, how, decision))
        return decision

    @property
    def asked(self):
        return self.__dict__.setdefault("_asked", [])


class Obedient(Spy):
    """A strategist that answers with a setting prepared beforehand, to follow what is done with it."""

    def decide(self, *args, **how):
        decision = super().decide(*args, **how)
        chosen = self.__dict__["answer"]
        return dataclasses.replace(decision, setting=chosen, changes=chosen.differs(how["current"]))


def obedient(answer, **rules):
    made = Obedient(**rules)
    object.__setattr__(made, "answer", answer)
    return made


def test_events_between_windows_happen_when_they_are_due():
    """Rows equal bit for bit those of the same drive without monitoring; windows stay on their grid."""
    events = [(7.31, becomes(0.8, 0.7)), (3.07, becomes(0.5, 0.9)), (20.0, becomes(9.0, 0.1))]
    run = Supervisor(make_loop()).run(11.0, events=events)
    schedule = [(3.07, {"plant": GLVDPlant(0.5, 0.9, 0.1)}), (7.31, {"plant": GLVDPlant(0.8, 0.7, 0.1)})]
    alone = simulate(LEADER, duration=11.0, seeds=7, plant=GLVDPlant(0.3, 1.0, 0.1), schedule=schedule)
    for name, value in vars(run.rows).items():
        expected = getattr(alone, name)
        assert torch.equal(value, expected if name == "time" else expected[:, 0])
    assert [w.window.start_s for w in run.windows] == pytest.approx([0, 2, 4, 6, 8])
    assert [w.window.end_s for w in run.windows] == pytest.approx([2, 4, 6, 8, 10])
    assert [int(w.window.n[0]) for w in run.windows[1:]] == [200] * 4


def test_alerts_are_those_of_the_windows_and_begin_with_the_change():
    loop = make_loop(3)
    controller, lower = loop.controller, loop.lower_level
    supervisor = Supervisor(loop)
    change = becomes(torch.tensor([1.5, 0.3, 0.3]), torch.tensor([0.5, 1.0, 0.5]))
    run = supervisor.run(16.0, events=[(8.0, change)])
    for i in range(3):
        expected = [(w.window.end_s, d) for w in run.windows for d in w.report.names(i)]
        assert [(a.time_s, a.detector) for a in run.alerts[i]] == expected
        assert all("\n" not in a.why for a in run.alerts[i])
    assert run.alerts[0][0].time_s == pytest.approx(10.0)
    assert run.alerts[0][0].detector == "stability"
    assert "string stable" in run.alerts[0][0].why
    assert run.alerts[1] == []
    assert {a.detector for a in run.alerts[2]} >= {"accepted_change"}
    # watching alone changes nothing
    assert run.actions == [[], [], []]
    assert (loop.controller, loop.lower_level) == (controller, lower)
    assert supervisor.setting is supervisor.default


def test_the_estimator_gets_the_command_after_clipping():
    """A narrow actuator and a lower level that inverts: what was demanded is far from what was sent."""
    lower = LowerLevel(1.0, 0.8, accel_min=-1.5, accel_max=1.2)
    loop = make_loop(lower_level=lower, plant=GLVDPlant(1.0, 0.8, 0.1))
    run = Supervisor(loop, seed=3).run(16.0)
    assert float(run.rows.clipped.double().mean()) > 0.3
    last = run.windows[-1].window.belief
    assert abs(float(last.mean[0, 0]) - 1.0) < 5 * float(last.sd[0, 0])
    assert abs(float(last.mean[0, 1]) - 0.8) < 5 * float(last.sd[0, 1])
    rows = run.rows

    def belief(u):
        stream = BeliefStream(window=2.0, seed=3)
        columns = {"accel_cmd": u, "accel": rows.accel, "jerk": rows.jerk}
        stream.feed(rows.time, columns, usable=rows.speed >= 0.3, until=16.0)
        return stream.inference.belief

    assert torch.equal(last.draws, belief(rows.accel_cmd).draws)
    assert abs(float(belief(rows.demanded).mean[0, 1]) - 0.8) > 0.2


@pytest.mark.parametrize(
    ("setting", "delay"),
    [
        (Setting(time_gap=2.5), 0.0),
        (Setting(T_hat=1.4, K_hat=0.55, T_d=0.9, time_gap=1.6, gains=(1.5, 4.0, -3.0)), 0.0),
        (Setting(T_hat=1.4, K_hat=0.55, T_d=0.9, time_gap=1.6, gains=(1.5, 4.0, -3.0)), 3.33),
    ],
    ids=["time gap", "all", "all, by the driver"],
)
def test_what_is_decided_is_put_in_force(setting, delay):
    """Every row's demand and command, recomputed from the laws of SPEC section 1, at once but for the time gap."""
    strategist = obedient(setting, driver_delay=delay, required=1e-6, ramp_rate=0.08)
    supervisor = Supervisor(make_loop(), strategist=strategist)
    run = supervisor.run(18.0, events=[(8.0, becomes(1.5, 0.5))])
    (action,) = run.actions[0]
    assert action.time_s == pytest.approx(10.0)
    assert action.setting is not None
    assert action.setting.as_dict() == setting.as_dict()
    waits = delay if float(setting.time_gap) > 1.0 else 0.0
    assert action.driver_delay_s == pytest.approx(waits)

    r, t = run.rows, run.rows.time
    new = t >= 10.0 - 1e-9
    moved = 0.08 * (t - 10.0 - waits).clamp_min(0.0)
    gap = torch.minimum(1.0 + moved, setting.time_gap)
    k = torch.where(new[:, None], setting.gains, torch.tensor([1.5, 1.5, -0.8], dtype=torch.float64))
    error = r.spacing[0] - gap * r.speed[0] - 5.0
    demand = k[:, 0] * error + k[:, 1] * (r.lead_speed[0] - r.speed[0]) + k[:, 2] * r.accel[0]
    # a few operations on numbers below 100
    assert torch.allclose(r.demanded[0], demand, rtol=0, atol=1e-11)
    sent = setting.lower_level().command(r.accel[0], r.demanded[0])
    assert torch.equal(r.accel_cmd[0], torch.where(new, sent, r.demanded[0].clamp(-6.0, 4.0)))
    # evaluated with the setting in force: the longer gap only from the first window after the driver has set it
    for w in run.windows:
        expected = Setting().as_dict() if w.window.start_s < 9.99 else setting.as_dict()
        if w.window.end_s <= 10.0 + waits + 1e-6:
            expected["time_gap_s"] = 1.0
        assert w.setting.as_dict() == expected


def test_an_action_is_reported_with_its_true_peak_gain():
    supervisor = Supervisor(make_loop(limits=WIDE), strategist=Strategist())
    run = supervisor.run(12.0, events=[(8.0, becomes(1.5, 0.5))])
    (action,) = run.actions[0]
    assert action.strategies == [1]
    assert action.sufficient
    assert action.p_string_stable >= 0.95
    assert action.peak_gain_true == float(action.setting.peak_gain(1.5, 0.5)[0])
    assert action.why
    assert supervisor.setting.as_dict() == action.setting.as_dict()
    assert supervisor.default.as_dict() == Setting().as_dict()
    # the new normal is what was believed when it was acted on
    acted_on = next(w for w in run.windows if w.window.end_s == pytest.approx(10.0))
    assert float(supervisor.watch.monitor.accepted[0][0]) == pytest.approx(float(acted_on.report.mean[0][0]))
    assert float(supervisor.watch.monitor.accepted[0][0]) == pytest.approx(1.5, abs=0.3)


def test_a_chosen_setting_that_still_works_stays():
    """The lag falls by more than the accepted change: noted and accepted, but the inverted model is good enough."""
    first, second = becomes(1.5, 0.5), becomes(1.2, 0.5)
    strategist = Spy()
    supervisor = Supervisor(make_loop(limits=WIDE), strategist=strategist)
    run = supervisor.run(22.0, events=[(8.0, first), (14.0, second)])
    assert [a.time_s for a in run.actions[0]] == pytest.approx([10.0])
    later = [a for a in run.alerts[0] if a.time_s > 14.01]
    assert [a.detector for a in later] == ["accepted_change"]
    assert float(supervisor.watch.monitor.accepted[0][0]) == pytest.approx(1.2, abs=0.1)
    # the strategist, if called, would have changed the lower level again
    (args, how, _) = strategist.asked[0]
    last = run.windows[-1].window.belief.draws
    fresh = Strategist().decide(
        last[:, :, 0].mT, last[:, :, 1].mT, args[2], current=supervisor.setting, default=supervisor.default,
        accel_min=how["accel_min"], accel_max=how["accel_max"],
    )  # fmt: skip
    assert fresh.changes.tolist() == [True]


def test_the_strategist_is_asked_for_alarmed_scenarios_only():
    strategist = Spy()
    change = becomes(torch.tensor([0.3, 1.0, 0.3, 1.5]), torch.tensor([1.0, 0.6, 1.0, 0.5]))
    supervisor = Supervisor(make_loop(4, limits=WIDE), strategist=strategist)
    run = supervisor.run(12.0, events=[(8.0, change)])
    assert [len(a) for a in run.actions] == [0, 1, 0, 1]
    ((T_L, _, _), how, _) = strategist.asked[0]
    assert T_L.mean(1).tolist() == pytest.approx([1.0, 1.5], abs=0.2)
    assert how["model_wrong"].tolist() == [True, True]
    assert supervisor.setting.T_hat[[0, 2]].tolist() == [0.3, 0.3]
    assert supervisor.setting.T_hat[[1, 3]].tolist() == T_L.mean(1).tolist()


@pytest.mark.slow
def test_the_strategist_replays_the_last_seconds():
    strategist = Spy()
    supervisor = Supervisor(make_loop(2), strategist=strategist)
    run = supervisor.run(32.0, events=[(3.17, becomes(1.5, 0.5)), (27.0, becomes(0.3, 1.0))])
    lengths = []
    for (_, _, history), _, _ in strategist.asked:
        rows = history.lead_speed.shape[1]
        # all scenarios have the same leader, so its stretch identifies the time
        ends = [w.window.end_s for w in run.windows]
        at = [e for e in ends if rows <= round(e / 0.01)]
        matches = [
            e
            for e in at
            if torch.equal(run.rows.lead_speed[0, round(e / 0.01) - rows : round(e / 0.01)], history.lead_speed[0])
        ]
        assert len(matches) == 1
        first = round(matches[0] / 0.01) - rows
        assert rows == min(round(matches[0] / 0.01), round(HISTORY_S / 0.01) + 1)
        assert any(torch.equal(history.speed[:1], run.rows.speed[i : i + 1, first]) for i in range(2))
        lengths.append(history.seconds)
    assert min(lengths) < 10.0
    assert max(lengths) == pytest.approx(HISTORY_S)
    # no more of a drive is kept than that, and one block
    assert sum(len(b.time) for b in supervisor._recent) <= round(HISTORY_S / 0.01) + 1 + 200


@pytest.mark.slow
def test_a_run_may_be_cut_anywhere():
    """Pieces equal the whole, actions at a cut included, also where a piece is one row."""
    change = (8.0, becomes(1.5, 0.5))

    def pieces(*durations):
        supervisor = Supervisor(make_loop(limits=WIDE), strategist=Strategist(), seed=5)
        runs = [supervisor.run(d, events=[change] if i == 0 else []) for i, d in enumerate(durations)]
        rows = torch.cat([r.rows.accel for r in runs], -1)
        actions = [(a.time_s, a.setting.as_dict()) for r in runs for a in r.actions[0]]
        return rows, actions, [w.window.belief.draws for r in runs for w in r.windows]

    whole = pieces(14.0)
    assert len(whole[1]) == 1
    for cut in ((10.0, 4.0), (9.99, 0.01, 4.0), (8.5, 2.5, 3.0)):
        other = pieces(*cut)
        assert torch.equal(whole[0], other[0])
        assert whole[1] == other[1]
        assert all(torch.equal(a, b) for a, b in zip(whole[2], other[2], strict=True))


def test_a_loop_under_way_is_watched_on_its_own_grid():
    loop = make_loop(limits=WIDE)
    loop.advance(333)
    supervisor = Supervisor(loop, strategist=Strategist())
    run = supervisor.run(10.0, events=[(7.33, becomes(1.5, 0.5))])
    assert [w.window.end_s for w in run.windows] == pytest.approx([5.33, 7.33, 9.33, 11.33, 13.33])
    assert [a.time_s for a in run.actions[0]] == pytest.approx([9.33])


def test_a_scenario_gets_the_same_noise_in_any_batch():
    change = (6.0, becomes(1.5, 0.5))
    batch = Supervisor(make_loop(3, seeds=[3, 8, 11])).run(12.0, events=[change])
    alone = Supervisor(make_loop(1, seeds=[8])).run(12.0, events=[change])
    for name, value in vars(batch.rows).items():
        if name != "time":
            assert torch.equal(value[1:2], getattr(alone.rows, name))
    for a, b in zip(batch.windows, alone.windows, strict=True):
        one, other = a.window.belief, b.window.belief
        assert bool(one.excited[1]) == bool(other.excited[0])
        if bool(other.excited[0]):
            # independent sampler noise: some 64 chains of 60 draws each, so SD/20 is more than 5 sigma of the mean
            assert bool(((one.mean[1] - other.mean[0]).abs() < 0.2 * other.sd[0]).all())


@pytest.mark.slow
def test_an_action_leaves_the_other_scenarios_alone():
    """Scenario 0 is on its way to a longer gap when scenario 1 is changed: it continues undisturbed."""

    def drive(n):
        longer = Setting(time_gap=2.5, scenarios=n)
        supervisor = Supervisor(make_loop(n, seeds=[4, 9][:n]), strategist=obedient(longer, required=1e-6))
        run = supervisor.run(12.0, events=[(8.0, becomes(1.5, 0.5))])
        assert [len(a) for a in run.actions] == [1] * n
        return supervisor, run

    both, run = drive(2)
    alone, run_alone = drive(1)
    both._order(both.setting.replace(T_hat=torch.tensor([0.3, 1.4], dtype=torch.float64)))
    later, later_alone = both.run(12.0), alone.run(12.0)
    assert torch.equal(run.rows.accel[:1], run_alone.rows.accel)
    # a ramp retargeted midway differs by round-off
    assert torch.allclose(later.rows.accel[:1], later_alone.rows.accel, rtol=0, atol=1e-9)
    assert float(later.rows.demanded[1].sub(later.rows.accel_cmd[1]).abs().max()) > 0.1


def test_the_seed_decides():
    def drive(seed, noise=4):
        supervisor = Supervisor(make_loop(2, seeds=noise, limits=WIDE), strategist=Strategist(), seed=seed)
        return supervisor.run(12.0, events=[(6.0, becomes(1.5, 0.5))])

    one, again, other = drive(1), drive(1), drive(2)
    assert torch.equal(one.rows.accel, again.rows.accel)
    assert one.alerts == again.alerts
    assert [a.setting.as_dict() for x in one.actions for a in x] == [
        a.setting.as_dict() for x in again.actions for a in x
    ]
    for a, b in zip(one.windows, again.windows, strict=True):
        assert torch.equal(a.window.belief.draws, b.window.belief.draws)
    # another sampler seed: the same plant noise until the first action
    acted = round(min(x[0].time_s for x in other.actions if x) / 0.01)
    assert torch.equal(one.rows.accel[:, :acted], other.rows.accel[:, :acted])
    assert not torch.equal(one.windows[3].window.belief.draws, other.windows[3].window.belief.draws)


def test_rows_of_a_crashed_car_are_not_used():
    loop = make_loop(2, spacing0=torch.tensor([0.5, 10.0]), speed0=torch.tensor([8.0, 0.0]), seeds=1)
    supervisor = Supervisor(loop, strategist=Strategist())
    run = supervisor.run(14.0, events=[(6.0, becomes(torch.tensor([1.5, 1.5]), torch.tensor([0.5, 0.5])))])
    assert loop.collided.tolist() == [True, False]
    assert [int(w.window.n[0]) for w in run.windows] == [0] * 7
    assert not any(bool(w.window.belief.excited[0]) for w in run.windows)
    assert run.alerts[0] == []
    assert run.actions[0] == []
    assert run.alerts[1]
    assert torch.equal(run.windows[0].window.belief.draws[:, 0], run.windows[-1].window.belief.draws[:, 0])


def test_the_setting_is_read_off_the_loop():
    gains = torch.tensor([[1.5, 1.5, -0.8], [3.0, 3.0, -1.8]], dtype=torch.float64)
    lower = LowerLevel(torch.tensor([0.3, 1.5]), 0.9, T_d=0.4, K_d=0.8)
    loop = make_loop(2, controller=LinearController(gains, torch.tensor([1.0, 1.6])), lower_level=lower)
    setting = read_setting(loop)
    expected = {"T_hat": 1.5, "K_hat": 0.9, "T_d": 0.4, "K_d": 0.8, "time_gap": 1.6}
    assert {name: float(getattr(setting, name)[1]) for name in expected} == pytest.approx(expected, rel=1e-6)
    assert setting.gains.tolist() == gains.tolist()
    supervisor = Supervisor(loop)
    assert supervisor.watch.monitor.accepted[0].tolist() == pytest.approx([0.3, 1.5])
    assert supervisor.watch.monitor.accepted[1].tolist() == pytest.approx([0.9, 0.9])
    mpc = MPC(time_gap=1.3)
    assert read_setting(make_loop(2, controller=mpc)).gains.tolist() == [list(mpc.gains)] * 2
    assert read_setting(make_loop(controller=mpc)).time_gap.tolist() == [1.3]


def of_unknown_structure(state):
    return LinearController()(state) + 0.0


def test_a_controller_of_unknown_structure_takes_a_given_setting():
    with pytest.raises(InputError, match="controller"):
        Supervisor(make_loop(controller=of_unknown_structure))
    loop = make_loop(2, controller=of_unknown_structure, limits=WIDE)
    with pytest.raises(InputError, match="strategist"):
        Supervisor(loop, setting=Setting(), strategist=Strategist())
    supervisor = Supervisor(loop, setting=Setting(), strategist=Strategist(Grid(allowed=frozenset({1}))))
    run = supervisor.run(14.0, events=[(6.0, becomes(1.5, 0.5))])
    assert all(a.strategies == [1] for x in run.actions for a in x)
    assert all(run.actions)
    assert loop.controller is of_unknown_structure
    assert loop.lower_level.T_hat.tolist() == [x[-1].setting.T_hat[0] for x in run.actions]
    assert float(run.windows[-1].report.mean[0][0]) == pytest.approx(1.5, abs=0.3)


def test_an_mpc_is_evaluated_by_its_equivalent_gains_and_given_a_new_time_gap():
    loop = make_loop(controller=MPC(), leader=LEADER)
    supervisor = Supervisor(loop, strategist=mpc_strategist())
    assert supervisor.setting.gains[0].tolist() == list(mpc_gains(1.0))
    run = supervisor.run(14.0, events=[(6.0, becomes(1.5, 0.5))])
    assert run.actions[0]
    assert {a.detector for a in run.alerts[0]} >= {"stability"}
    last = run.actions[0][-1]
    gap = last.setting.as_dict()["time_gap_s"]
    assert 3 not in last.strategies
    assert isinstance(loop.controller, MPC)
    assert loop.controller.time_gap == gap
    assert last.setting.gains[0].tolist() == pytest.approx(list(mpc_gains(gap)))
    assert supervisor.setting.as_dict() == last.setting.as_dict()


def test_an_mpc_keeps_its_gains_until_the_driver_has_set_the_gap():
    """A leaf of the same law: gains that follow from the gap follow it when it comes."""
    target = Setting(time_gap=2.5, gains=mpc_gains(2.5))
    strategist = obedient(target, grid=Grid(allowed=frozenset({2}), gains_of_gap=mpc_gains), driver_delay=3.0,
                          required=1e-6)  # fmt: skip
    supervisor = Supervisor(make_loop(controller=MPC()), strategist=strategist)
    run = supervisor.run(14.0, events=[(6.0, becomes(1.5, 0.5))])
    (action,) = run.actions[0]
    seen = {round(w.window.end_s): w.setting.as_dict() for w in run.windows if w.window.end_s > action.time_s}
    done = action.time_s + 3.0
    for end, setting in seen.items():
        gap = 2.5 if end > done else 1.0
        assert setting["time_gap_s"] == gap
        assert setting["gains"] == pytest.approx(list(mpc_gains(gap)))


def test_what_an_mpc_cannot_do_is_refused():
    with pytest.raises(InputError, match="gains_of_gap"):
        Supervisor(make_loop(controller=MPC()), strategist=Strategist())
    with pytest.raises(InputError, match="scenarios"):
        Supervisor(make_loop(2, controller=MPC()), strategist=mpc_strategist())
    Supervisor(make_loop(2, controller=MPC()), strategist=Strategist(Grid(allowed=frozenset({1}))))
    Supervisor(make_loop(2, controller=MPC()))


@pytest.mark.slow
def test_a_driver_is_not_asked_twice_for_one_gap():
    """While the driver is asked the alarm over the setting in force goes on, but the order stands, and so its time."""
    longer = Setting(time_gap=2.5)

    def drive(delay):
        strategist = obedient(longer, driver_delay=delay)
        supervisor = Supervisor(make_loop(limits=WIDE), strategist=strategist)
        return strategist, supervisor.run(20.0, events=[(6.0, becomes(1.0, 0.6))])

    strategist, run = drive(7.0)
    (action,) = run.actions[0]
    assert action.time_s == pytest.approx(8.0)
    assert action.driver_delay_s == 7.0
    alarms = [a.time_s for a in run.alerts[0] if a.detector == "stability"]
    assert any(8.01 < time < 15.0 for time in alarms)
    assert not any(time > 16.01 for time in alarms)
    assert len(strategist.asked) == 1
    for w in run.windows:
        assert float(w.setting.time_gap) == (1.0 if w.window.end_s < 15.0 else 2.5)
    # the spacing begins to open only then
    _, soon = drive(0.0)
    assert torch.equal(soon.rows.spacing[0, :801], run.rows.spacing[0, :801])
    assert float(soon.rows.spacing[0, 1500]) > float(run.rows.spacing[0, 1500]) + 5.0


def test_an_order_overtaken_before_the_driver_complies():
    """A new, shorter gap while a long one is asked for starts its own time; the default back cancels the order."""
    supervisor = Supervisor(make_loop(), strategist=Strategist(driver_delay=5.0))
    supervisor.run(1.0)
    supervisor._order(Setting(time_gap=2.5))
    supervisor.run(1.0)
    supervisor._order(Setting(time_gap=2.5, T_hat=0.4))
    assert supervisor._due.tolist() == [600]
    assert supervisor.setting.as_dict() == Setting(T_hat=0.4).as_dict()
    supervisor._order(Setting(time_gap=1.6))
    assert supervisor._due.tolist() == [700]
    supervisor._order(Setting())
    supervisor.run(7.0)
    assert supervisor.setting.as_dict() == Setting().as_dict()
    assert float(supervisor.loop.controller.time_gap_at(9.0)) == 1.0


@pytest.mark.slow
def test_a_plant_without_jerk_is_estimated_by_the_latent_form():
    truth = GLVDPlant(0.3, 1.0, 0.1)

    def silent():
        slow = Leader.default(start=48, dt=0.05)
        return make_loop(plant=lambda a, v, u, dt, eps: truth.step(a, v, u, dt, eps), leader=slow)

    assert isinstance(Supervisor(silent()).watch.stream.form, LatentForm)
    assert not isinstance(Supervisor(make_loop()).watch.stream.form, LatentForm)
    quick = SamplerSettings(chains=8, draws=10, burn_in=5, attempts=1)
    stream = BeliefStream(window=5.0, form=LatentForm(accel=True, speed=True), settings=quick)
    run = Supervisor(silent(), window=5.0, stream=stream).run(10.0)
    assert run.windows[-1].window.belief.names == stream.form.names
    assert any(bool(w.window.belief.excited) for w in run.windows)


def test_progress_is_reported_window_by_window():
    seen = []
    Supervisor(make_loop()).run(5.0, progress=lambda done, of: seen.append((done, of)))
    assert seen == [pytest.approx((done, 5.0)) for done in (2.0, 4.0, 5.0)]


def test_one_action_uses_the_monitors_dead_time():
    supervisor = Supervisor(make_loop(), strategist=Strategist(dead_time=0.4))
    assert supervisor.watch.monitor.dead_time == 0.4
    # string unstable with that dead time as it stands (SPEC section 2), so alarmed without any change of the vehicle
    run = supervisor.run(8.0)
    assert {a.detector for a in run.alerts[0]} == {"stability"}
    assert Supervisor(make_loop()).run(8.0).alerts == [[]]


@pytest.mark.parametrize("window", [0.0, 0.01, 2.005, -2.0])
def test_a_window_that_is_no_multiple_of_the_step_is_refused(window):
    with pytest.raises(InputError, match="window"):
        Supervisor(make_loop(), window=window)


@pytest.mark.parametrize("duration", [0.0, -1.0, 0.001, float("nan"), float("inf")])
def test_a_duration_of_no_step_is_refused(duration):
    with pytest.raises(InputError, match="duration"):
        Supervisor(make_loop()).run(duration)


def test_parts_that_do_not_go_together_are_refused():
    with pytest.raises(InputError, match="platoon"):
        Supervisor(ClosedLoop(LEADER, vehicles=2))
    with pytest.raises(InputError, match="stream"):
        Supervisor(make_loop(2), stream=BeliefStream(window=2.0))
    with pytest.raises(InputError, match="stream"):
        Supervisor(make_loop(), stream=BeliefStream(window=1.0))
    with pytest.raises(InputError, match="monitor"):
        Supervisor(make_loop(2), monitor=Monitor(3))
    with pytest.raises(InputError, match="setting"):
        Supervisor(make_loop(2), setting=Setting(scenarios=3))
    with pytest.raises(InputError, match="ends at"):
        Supervisor(make_loop(leader=Leader.constant(20.0, 5.0))).run(10.0)
