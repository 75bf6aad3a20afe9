"""`estimate` on logs of known vehicles and on recordings: what it recovers, what it leaves out, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from avtorch.decision import Estimates, Monitor, Setting, estimate
from avtorch.decision.dead_time import GRID_S
from avtorch.decision.estimation import _delayed
from avtorch.errors import InputError
from avtorch.inference.latent_model import discretise
from avtorch.inference.sampler import SamplerSettings
from avtorch.io import Log
from avtorch.pedals import fit_pedals
from avtorch.results import estimates_answer
from avtorch.vehicle import GLVDPlant, Leader, simulate
from tests.bars import BAR
from tests.overridden import taken_over

COLUMNS = ("time", "accel_cmd", "accel", "speed", "jerk", "engaged", "segment")
YES = torch.ones(1, dtype=torch.bool)
QUICK = SamplerSettings(chains=32, draws=30)


def drive(T=0.5, K=0.9, *, seconds=20.0, sigma=0.1, seed=1, leader=None):
    leader = Leader.default(start=48) if leader is None else leader
    return simulate(leader, duration=seconds, seeds=seed, plant=GLVDPlant(T, K, sigma)).log()


def columns(log):
    return {name: getattr(log, name).copy() for name in COLUMNS if getattr(log, name) is not None}


def joined(*logs, **more):
    """Logs one after the other, each a segment of its own, on the clocks they came with."""
    parts = [columns(log) for log in logs]
    made = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    made["segment"] = np.repeat(np.arange(len(logs)), [log.rows for log in logs])
    return Log.from_arrays(**(made | more))


def spans(estimates):
    return [(w.window.start_s, w.window.end_s) for w in estimates.windows]


def assert_same_belief(some, others):
    for name in ("mean", "sd", "q05", "q95", "draws"):
        assert torch.equal(getattr(some, name), getattr(others, name))


@pytest.fixture(scope="module")
def healthy():
    return drive()


@pytest.mark.statistical
def test_the_jerk_form_recovers_the_truth(rotating_seed):
    truth = (1.2, 0.7, 0.2)
    found = estimate(drive(*truth[:2], sigma=truth[2], seed=rotating_seed, seconds=24.0), mode="posterior")
    assert found.form == "jerk"
    assert found.excited_share >= 0.6
    belief = found.windows[-1].window.belief
    for i, value in enumerate(truth):
        assert abs(float(belief.mean[0, i]) - value) < BAR * float(belief.sd[0, i])
    # hundreds of rows: it has learned something, too
    assert float(belief.sd[0, 0]) < 0.05
    assert float(belief.sd[0, 1]) < 0.03
    assert found.seconds_per_window > 0.0
    assert len(found.windows) == 12


@pytest.mark.slow
def test_the_verdict_is_on_the_setting_given(healthy):
    weak = drive(1.5, 0.5)
    for setting in (None, Setting(T_hat=1.5, K_hat=0.5), Setting(time_gap=2.5)):
        found = estimate(weak, setting=setting)
        setting = Setting() if setting is None else setting
        assert found.setting.as_dict() == setting.as_dict()
        last = found.windows[-1]
        T_L, K_L = (last.window.belief.draws[..., i].mT for i in range(2))
        assert torch.equal(last.report.p_string_stable, setting.p_string_stable(T_L, K_L))
    assert any("stability" in w.report.names() for w in estimate(weak).windows)
    assert not any("stability" in w.report.names() for w in estimate(healthy).windows)


def test_the_monitor_given_is_the_one_asked(healthy):
    found = estimate(healthy, monitor=Monitor(detectors=("accepted_change",), accepted=(2.0, 0.9)))
    assert next(w.report.names() for w in found.windows if bool(w.window.belief.excited)) == ["accepted_change"]


def test_a_drivers_rows_and_those_at_standstill_are_masked():
    """Rows under a driver or at standstill hold arbitrary numbers here, and none of them affects the belief."""
    log = drive(seconds=16.0, leader=Leader.default(start=44))
    given = columns(log)
    still = log.speed < 0.3
    assert 100 < still.sum() < 800
    driven, settling = (log.time >= 9.0) & (log.time < 10.5), (log.time >= 10.5) & (log.time < 12.5)
    given["engaged"] = np.where(driven, 0, 1)
    clean = estimate(Log.from_arrays(**given))
    for name in ("accel", "jerk", "accel_cmd"):
        given[name] = np.where(driven | settling | still, 3.0 * np.sin(37.0 * log.time), given[name])
    rubbish = estimate(Log.from_arrays(**given))
    for k, (a, b) in enumerate(zip(clean.windows, rubbish.windows, strict=True)):
        rows = slice(200 * k, 200 * k + 200)
        assert int(a.window.n[0]) == int((~still & ~driven & ~settling)[rows].sum())
        assert_same_belief(a.window.belief, b.window.belief)
    assert any(bool(w.window.belief.excited) for w in clean.windows)
    # half a window or less is not used
    assert not bool(clean.windows[4].window.belief.excited)


def test_a_gap_restarts_the_grid(healthy):
    keep = (healthy.time < 7.3) | (healthy.time >= 9.55)
    log = Log.from_arrays(**{k: v[keep] for k, v in columns(healthy).items() if k not in ("engaged", "segment")})
    found = estimate(log)
    expected = [(0, 2), (2, 4), (4, 6), (6, 7.3), *((9.55 + 2 * k, 11.55 + 2 * k) for k in range(5)), (19.55, 20.01)]
    assert np.array(spans(found)) == pytest.approx(np.array(expected), abs=0.011)
    assert [int(w.window.n[0]) for w in found.windows[1:]] == pytest.approx([200, 200, 130, *[200] * 5, 45], abs=1)
    assert len(found.quality.gaps) == 1


def test_segments_that_follow_at_once_are_still_two_drives(healthy):
    made = columns(healthy)
    made["segment"] = (healthy.time >= 5.0).astype(int)
    found = estimate(Log.from_arrays(**made))
    ends = [end for _, end in spans(found)]
    assert ends[:4] == pytest.approx([2.0, 4.0, 5.0, 7.0])


def test_progress_is_reported_in_rows(healthy):
    log, seen = joined(healthy, drive(seed=2, seconds=8.0)), []
    estimate(log, progress=lambda done, of: seen.append((done, of)), settings=QUICK)
    assert [of for _, of in seen] == [log.rows] * len(seen)
    assert [done for done, _ in seen] == [*range(200, 2801, 200)]  # window by window


@pytest.mark.statistical
def test_windows_that_know_little_do_not_pass_for_spread(rotating_seed, draws_factor):
    rng = np.random.default_rng(rotating_seed)
    windows = 400 * draws_factor
    for stretch in (1.0, 2.0):
        sds = np.exp(rng.uniform(np.log(0.003), np.log(0.3), windows))
        means = 0.4 + stretch * sds * rng.standard_normal(windows)
        beliefs = [
            SimpleNamespace(stat=lambda _, m=m, s=s: {"mean": m, "sd": s}, excited=YES, converged=YES)
            for m, s in zip(means.tolist(), sds.tolist(), strict=True)
        ]
        made = Estimates([SimpleNamespace(window=SimpleNamespace(belief=b)) for b in beliefs], 0.0, "jerk", None, None)
        # the root of a chi-square over its degrees of freedom
        assert made.spread_ratio("T_L") == pytest.approx(stretch, rel=BAR / np.sqrt(2 * (windows - 1)))


def test_the_seed_decides(healthy):
    one, again, other = (estimate(healthy, seed=s) for s in (3, 3, 4))
    for a, b in zip(one.windows, again.windows, strict=True):
        assert_same_belief(a.window.belief, b.window.belief)
    last, another = (x.windows[-1].window.belief for x in (one, other))
    assert not torch.equal(last.draws, another.draws)
    # but not the belief: thousands of draws leave far less than a tenth of an SD, and earlier windows about as much
    assert bool(((last.mean - another.mean).abs() < 0.3 * last.sd).all())


def test_further_keywords_reach_the_inference(healthy):
    tight, loose = (estimate(healthy, mode="lambda", lam=lam).windows[-1].window.belief for lam in (1e-6, 0.25))
    assert float(tight.sd[0, 0]) < 0.1 * float(loose.sd[0, 0]) + 1e-3
    with pytest.raises(InputError, match="lam"):
        estimate(healthy, lam=-1.0)


@pytest.mark.statistical
@pytest.mark.slow
def test_the_latent_form_as_it_is_answered(rotating_seed):
    """Noisy acceleration and speed, no jerk: `noise` stands in place of `sigma`, and the belief covers the truth."""
    rng = np.random.default_rng(rotating_seed)
    full = drive(sigma=0.3, seed=rotating_seed, seconds=15.0, leader=Leader.default(start=48, dt=0.05))
    accel, speed = (x + sd * rng.standard_normal(full.rows) for x, sd in ((full.accel, 0.05), (full.speed, 0.02)))
    log = Log.from_arrays(time=full.time, accel_cmd=full.accel_cmd, accel=accel, speed=speed)[100:]
    assert log.jerk is None
    found = estimate(log, window=5.0, seed=rotating_seed)
    assert found.form == "latent"
    answer = estimates_answer(found)
    assert answer["form"] == "latent"
    names = {"process_noise", "road_noise", "speed_noise", "accel_noise", "coloured_sd", "coloured_time"}
    for window in answer["windows"]:
        assert "sigma" not in window
        assert set(window["noise"]) == names
        assert set(window["noise"]["speed_noise"]) == {"mean", "sd", "q05", "q95"}
        assert isinstance(window["excited"], bool)
    used = [w for w in answer["windows"] if w["used"]]
    assert used
    for name, truth in (("T_L", 0.5), ("K_L", 0.9)):
        for window in used:
            stat = window[name]
            assert stat["q05"] < stat["mean"] < stat["q95"]
            # the reverse of a 5 sigma interval, in the logarithm as the posterior is skewed
            assert abs(np.log(stat["mean"] / truth)) < BAR * stat["sd"] / stat["mean"]


@pytest.mark.slow
def test_behind_a_recorded_leader_rest_and_cruise_teach_nothing(data_dir):
    """A production car at AstaZero stands, pulls off to 19 m/s and cruises: only the pull-off is informative about the
    actuator."""
    path = data_dir / "openacc_astazero" / "ASta_040719_platoon7.csv"
    leader = Leader.read(path, vehicle=1, duration=100.0)
    log = drive(0.5, 0.9, seconds=100.0, seed=3, leader=leader)
    windows = estimate(log).windows
    kinds = {"standstill": 0, "cruise": 0, "excited": 0}
    for k, (before, watched) in enumerate(zip([windows[0], *windows], windows, strict=False)):
        rows = slice(200 * k, 200 * k + 200)
        belief = watched.window.belief
        if (log.speed[rows] < 0.3).all():
            kind = "standstill"
            assert int(watched.window.n[0]) == 0
        elif log.speed[rows].min() > 15.0 and np.sqrt(np.mean(log.accel[rows] ** 2)) < 0.1:
            kind = "cruise"
        else:
            kinds["excited"] += bool(belief.excited)
            continue
        kinds[kind] += 1
        assert not bool(belief.excited)
        assert watched.report.names() == []
        assert_same_belief(belief, before.window.belief)
    assert kinds["standstill"] >= 1
    assert kinds["cruise"] >= 20
    assert kinds["excited"] >= 1
    last = windows[-1].window.belief
    for i, truth in enumerate((0.5, 0.9)):
        assert abs(float(last.mean[0, i]) - truth) < 5 * float(last.sd[0, i])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"window": 0.0}, "window"),
        ({"window": -2.0}, "window"),
        ({"window": float("nan")}, "window"),
        ({"window": float("inf")}, "window"),
        ({"window": 20.5}, "longest segment"),
        ({"form": "best"}, "form"),
        ({"mode": "none"}, "mode"),
        ({"forgetting": 0.0}, "forgetting"),
        ({"monitor": Monitor(2)}, "monitor"),
        ({"setting": Setting(scenarios=2)}, "setting"),
        ({"estimator": "oracle"}, "sgld, importance, map, rls, ekf, ukf"),
        ({"dead_time": -0.1}, "dead_time: found"),
        ({"dead_time": 2.0}, "dead_time: found"),
        ({"dead_time": float("nan")}, "dead_time: found"),
    ],
)
def test_what_is_refused(healthy, change, message):
    with pytest.raises(InputError, match=message) as refused:
        estimate(healthy, **change)
    assert "\n" not in str(refused.value)


def test_a_log_that_lacks_what_a_form_needs_is_refused(healthy):
    made = columns(healthy)
    silent = Log.from_arrays(**{k: v for k, v in made.items() if k != "jerk"})
    with pytest.raises(InputError, match="jerk"):
        estimate(silent, form="jerk")
    following = Log.from_arrays(
        time=healthy.time, speed=healthy.speed, spacing=healthy.spacing, lead_speed=healthy.lead_speed, following=True
    )
    with pytest.raises(InputError, match="accel_cmd"):
        estimate(following)


def test_a_window_as_long_as_the_log_is_taken(healthy):
    """Two thousand rows at 0.01 s span 19.99 s, and are 20 s of log."""
    (only,) = estimate(healthy, window=20.0, settings=QUICK).windows
    assert int(only.window.n[0]) == int(healthy.usable.sum())


@pytest.mark.parametrize("estimator", ["map", "rls", "ekf", "ukf"])
def test_other_estimators_answer_in_the_same_terms(estimator, healthy):
    found = estimate(healthy, estimator=estimator)
    answer = estimates_answer(found)
    assert answer["estimator"] == estimator
    last = answer["windows"][-1]
    for name, truth in (("T_L", 0.5), ("K_L", 0.9)):
        assert last[name]["q05"] < last[name]["mean"] < last[name]["q95"]
        assert abs(last[name]["mean"] - truth) < 5 * last[name]["sd"]


@pytest.mark.slow
@pytest.mark.statistical
def test_a_known_dead_time_is_taken_out(rotating_seed):
    """Commands sent 0.2 s earlier: without the dead time the lag is too long; with it the lag is right, and P accounts
    for it."""
    late = 20
    log = drive(0.5, 0.9, seed=rotating_seed, seconds=16.0)
    sent = columns(log)
    sent["accel_cmd"] = np.append(sent["accel_cmd"][late:], np.repeat(sent["accel_cmd"][-1], late))
    early = Log.from_arrays(**sent)
    told = estimate(early, dead_time=0.2, mode="posterior")
    blind = estimate(early, mode="posterior")
    plain = estimate(log, mode="posterior")
    assert told.dead_time == 0.2
    away = {}
    for name, found in (("told", told), ("blind", blind)):
        belief = found.windows[-1].window.belief
        away[name] = float(((belief.mean[0, :2] - torch.tensor([0.5, 0.9])).abs() / belief.sd[0, :2]).max())
    assert away["told"] < BAR
    assert away["blind"] > 8
    for ours, theirs in zip(told.windows[1:], plain.windows[1:], strict=True):
        assert ours.window.n[0] == theirs.window.n[0]  # the start alone is masked
    # the same car with a delay in its loop is no more string stable than without
    assert float(told.windows[-1].report.p_string_stable[0]) <= float(plain.windows[-1].report.p_string_stable[0])
    assert estimates_answer(told)["assumed"]["dead_time_s"] == 0.2


def test_a_dead_time_between_rows_takes_the_mean_of_what_acts():
    time = np.arange(6) * 0.1
    log = Log.from_arrays(time=time, accel_cmd=[0.0, 1.0, 1.0, 3.0, 3.0, 3.0], speed=20 + time)
    command, known = _delayed(log, 0.05)
    np.testing.assert_allclose(command, [0.0, 0.5, 1.0, 2.0, 3.0, 3.0], atol=1e-12)
    assert known.tolist() == [False, True, True, True, True, True]
    command, known = _delayed(log, 0.2)
    np.testing.assert_allclose(command, [0.0, 0.0, 0.0, 1.0, 1.0, 3.0], atol=1e-12)
    assert known.tolist() == [False, False, True, True, True, True]
    assert _delayed(log, 0.0)[0].tolist() == [0.0, 1.0, 1.0, 3.0, 3.0, 3.0]


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("form", ["jerk", "latent"])
def test_a_driver_who_acts_against_the_command_teaches_nothing(form, rotating_seed):
    """The state after an override decays first: lag and gain are the car's, as precise as the remaining rows permit."""
    rng = np.random.default_rng(rotating_seed)
    truth = {"T_L": 0.5, "K_L": 0.9}
    overrides = [(4.0, 6.0), (10.0, 12.0), (16.0, 18.0)]
    log = taken_over(seconds=24.0, overrides=overrides, rng=rng, rate_hz=20, delay_s=0.2, jerk=True, **truth)
    found = estimate(log, form=form, estimator="map", mode="posterior", dead_time=0.2)
    belief = found.windows[-1].window.belief
    for i, value in enumerate(truth.values()):
        # beliefs take a jerk that is sampled in a row for that of the row's whole step: a tenth of a step here
        assert abs(float(belief.mean[0, i]) - value) < BAR * float(belief.sd[0, i]) + 0.005
        assert float(belief.sd[0, i]) < 0.05
    # a window with nothing but a driver and the car settling after him leaves the belief
    by_hand = [w.window for w in found.windows if 4.0 <= w.window.start_s < 7.9]
    assert [int(w.n[0]) for w in by_hand] == [0, 0]
    assert not any(bool(w.belief.excited[0]) for w in by_hand)
    assert any("3 returns to engaged" in note for note in found.quality.notes)


@pytest.mark.slow
def test_a_dead_time_reaches_for_no_command_that_nobody_obeyed(healthy):
    """Arbitrary commands under the driver change nothing, even where they would act after the return."""
    given = columns(healthy)
    given["engaged"] = np.where((healthy.time >= 5.0) & (healthy.time < 7.0), 0, 1)
    clean = Log.from_arrays(**given)
    for name in ("accel", "jerk", "accel_cmd"):
        given[name] = np.where(given["engaged"] == 0, 3.0 * np.sin(37.0 * healthy.time), given[name])
    rubbish = Log.from_arrays(**given)
    # longer than the car takes to settle otherwise
    found, other = (estimate(x, 4.0, dead_time=2.5, settings=QUICK) for x in (clean, rubbish))
    for a, b in zip(found.windows, other.windows, strict=True):
        assert_same_belief(a.window.belief, b.window.belief)
    # 2.5 s of commands are on their way at 7 s, and the lag's rows follow
    assert int(found.windows[2].window.n[0]) == pytest.approx(250, abs=1)


def test_a_log_of_which_no_row_counts_is_refused(healthy):
    """Once twenty windows "not excited", and the advice to make them longer."""
    given = columns(healthy) | {"engaged": np.zeros(healthy.rows)}
    with pytest.raises(InputError, match=r"has no row to use; all are driven by hand \(engaged 0\)"):
        estimate(Log.from_arrays(**given), 4.0, estimator="map")


# The dead time of a log, from its likelihood.
def driven(dead_time: float, seed: int, *, jitter: float = 0.0, seconds: float = 40.0, rate: float = 50.0) -> Log:
    """Speed of a car with T_L 0.3 s and K_L 0.9 that obeys steps of the command ``dead_time`` [s] later."""
    random = np.random.default_rng(seed)
    rows, late = int(seconds * rate), round(dead_time * rate)
    time = (np.arange(rows) + jitter * random.uniform(-1, 1, rows)) / rate
    u = random.normal(size=rows)[np.cumsum(random.random(rows) < 1.0 / rate)]
    obeyed = np.concatenate([np.zeros(late), u[: rows - late]])
    steps = torch.from_numpy(np.diff(time))
    values = (torch.tensor(x, dtype=torch.float64) for x in (0.3, 0.9, 0.1, 0.005, 0.1, 1.5))
    step = discretise(*values, steps)
    root = torch.linalg.cholesky(step.noise + 1e-18 * torch.eye(4)).numpy()
    phi, gain = step.transition.numpy(), step.gain.numpy()
    x, speed = np.array([20.0, 0.0, 0.0, 0.1 * random.normal()]), []
    for k in range(rows):
        speed.append(x[0] + x[2] + 0.01 * random.normal())
        if k + 1 < rows:
            x = phi[k] @ x + gain[k] * obeyed[k] + root[k] @ random.normal(size=4)
    return Log.from_arrays(time=time - time[0], accel_cmd=u, speed=np.array(speed))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_a_dead_time_is_found_and_the_lag_behind_it(jitter: float, rotating_seed: int) -> None:
    found = estimate(driven(0.2, rotating_seed, jitter=jitter), window=10.0, dead_time=None, seed=rotating_seed)
    assert found.inferred is not None
    # a step of the command falls anywhere within a row's 20 ms where the clock jitters
    assert abs(found.dead_time - 0.2) < 0.04
    assert found.inferred.nats > 10.0
    last = found.windows[-1].window.belief.stat("T_L")
    assert abs(last["mean"] - 0.3) < 5 * last["sd"] + 0.04


@pytest.mark.slow
@pytest.mark.statistical
def test_none_is_claimed_where_there_is_none(rotating_seed: int) -> None:
    found = estimate(driven(0.0, rotating_seed), window=10.0, dead_time=None, seed=rotating_seed)
    assert found.inferred is not None
    assert found.dead_time == 0.0
    assert 0.0 <= found.inferred.q05 <= found.inferred.q95 < GRID_S[2]


def test_a_given_dead_time_is_not_inferred(fresh_seed: int) -> None:
    found = estimate(driven(0.0, fresh_seed, seconds=8.0), window=4.0, dead_time=0.1, estimator="map")
    assert found.inferred is None
    assert found.dead_time == 0.1


# The latent form on a real car: a Hyundai Genesis, commanded acceleration and measured speed, three laps.
@pytest.fixture(scope="module")
def laps(data_dir: Path) -> list[Estimates]:
    return [estimate(Log.read(data_dir / "genesis" / f"lap{i}.csv"), window=10.0) for i in (1, 2, 3)]


def excited(found: Estimates, name: str) -> np.ndarray:
    """``(window, 2)``: mean and SD of a parameter over the whole 10 s windows that were used."""
    rows = []
    for w in found.windows:
        belief = w.window.belief
        if bool(belief.excited[0] & belief.converged[0]) and int(w.window.n[0]) > 950:
            stat = belief.stat(name)
            rows.append((stat["mean"], stat["sd"]))
    return np.array(rows)


@pytest.mark.slow
def test_lag_and_gain_of_the_genesis(laps: list[Estimates]) -> None:
    """Lag and delay together are about 0.32 s there, the gain about 0.96, by whole-lap fits of others."""
    T, K = (np.concatenate([excited(lap, name) for lap in laps]) for name in ("T_L", "K_L"))
    assert len(T) >= 9
    assert abs(np.median(T[:, 0]) - 0.32) <= 0.06
    assert abs(np.median(K[:, 0]) - 0.96) <= 0.05
    medians = [np.median(excited(lap, "T_L")[:, 0]) for lap in laps]
    assert max(medians) - min(medians) <= 0.08


@pytest.mark.slow
def test_spread_of_windows_is_relative_to_their_posteriors(laps: list[Estimates]) -> None:
    """Spread over posterior SD: about 1 for the lag; about 2 for the gain, which differs along the lap (see README)."""
    T, K = (np.concatenate([excited(lap, name) for lap in laps]) for name in ("T_L", "K_L"))
    ratio_T, ratio_K = (x[:, 0].std(ddof=1) / np.median(x[:, 1]) for x in (T, K))
    print(f"spread over posterior SD: T_L {ratio_T:.2f}, K_L {ratio_K:.2f}")
    assert ratio_T <= 1.5
    # 1.5 is the aim; the bar is today's value plus a tenth, so that a regression is detected
    assert ratio_K <= 2.2


@pytest.mark.slow
def test_lag_and_gain_of_the_av21(data_dir: Path) -> None:
    """Behind the filter of its accelerometer, of 2.5 s, the lag seems 3.7 s; on its map's commands it is 0.2 s."""
    file = data_dir / "indy_av21" / "Putnam_park2023_run4_2.csv"
    log = Log.read(file, map=["throttle=throttle_pct", "brake=brake_kPa"], unit=["throttle=%", "brake=kPa"])
    fit = fit_pedals(log)
    found = estimate(fit.map.commanded(log), dead_time=None)
    assert found.late is not None
    assert not found.late.recoverable
    used = [w.window.belief for w in found.windows if bool(w.window.belief.excited[0] & w.window.belief.converged[0])]
    lag, gain = (float(np.median([belief.stat(name)["mean"] for belief in used])) for name in ("T_L", "K_L"))
    assert len(used) > 20
    # the map's own lag, 0.07 s, is less than that by five of its standard errors, which are too small here
    assert abs(lag + found.dead_time - fit.map.T_L - fit.map.dead_time) < 0.15
    # the map's own gain is 1; that of 37 windows of 2 s has a spread of a sixth, so 5 sigma of their median
    assert abs(gain - 1) < 5 * 1.25 * 0.17 / np.sqrt(len(used))
