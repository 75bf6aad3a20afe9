"""What a recorder does to a log: each of its parts alone, all of them drawn, and which draws a case is made of."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import numpy as np
import pytest
from scipy.signal import welch

from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest import Recorder, draw_case, draw_recorder
from benchmarks.blindtest.drives import RATES_HZ
from tests.bars import BAR

RATE = 100
SHORT = {"seconds": 20.0, "manoeuvre": "steps"}


def drive(seconds: float = 60.0, rate: int = RATE, *, speed: float = 15.0, noise: float = 0.02) -> Log:
    rng, time = np.random.default_rng(0), np.arange(round(seconds * rate)) / rate
    return Log.from_arrays(
        time=time,
        accel_cmd=np.sin(0.4 * time),
        accel=np.sin(0.4 * time) + noise * rng.standard_normal(len(time)),
        speed=speed - 2.5 * np.cos(0.4 * time) + noise * rng.standard_normal(len(time)),
    )


def test_the_ideal_recorder_changes_nothing(fresh_seed: int) -> None:
    log = drive()
    assert Recorder.ideal() == Recorder()
    assert Recorder.ideal().record(log, fresh_seed) is log


def test_readings_are_multiples_of_their_quantum_and_nearest(fresh_seed: int) -> None:
    log = drive()
    quanta = np.random.default_rng(fresh_seed).uniform(0.01, 0.14, 2)
    seen = Recorder(speed_quantum=quanta[0], accel_quantum=quanta[1]).record(log, fresh_seed)
    for was, now, quantum in ((log.speed, seen.speed, quanta[0]), (log.accel, seen.accel, quanta[1])):
        np.testing.assert_allclose(now / quantum, np.round(now / quantum), atol=1e-9)
        assert np.abs(now - was).max() <= quantum / 2 * (1 + 1e-9)


@pytest.mark.parametrize(("rate", "hold", "each"), [(100, 20.0, [5]), (40, 20.0, [2]), (50, 20.0, [2, 3])])
def test_a_held_speed_is_the_first_reading_of_each_tick(rate: int, hold: float, each: list[int]) -> None:
    log = drive(20.0, rate)
    seen = Recorder(speed_hold_hz=hold).record(log, 0)
    assert seen.speed is not None
    assert log.speed is not None
    new = np.flatnonzero(np.diff(seen.speed, prepend=np.inf))
    assert set(np.diff(new)) == set(each)
    np.testing.assert_array_equal(seen.speed[new], log.speed[new])
    np.testing.assert_array_equal(seen.accel, log.accel)


def test_the_low_pass_keeps_the_mean_delays_a_ramp_and_smooths(fresh_seed: int) -> None:
    lag = float(np.random.default_rng(fresh_seed).uniform(0.02, 0.08))
    recorder, time = Recorder(speed_lag_s=lag), np.arange(2000) / RATE
    same = Log.from_arrays(time=time, accel_cmd=np.sin(time), speed=np.full(2000, 13.7))
    np.testing.assert_allclose(recorder.record(same, 0).speed, 13.7, rtol=1e-12)
    ramp = Log.from_arrays(time=time, accel_cmd=np.sin(time), speed=5 + 0.5 * time)
    late = ramp.speed - recorder.record(ramp, 0).speed  # type: ignore[operator]
    # a zero-order filter's ramp error: between lag and lag less a row
    assert 0.5 * (lag - 1 / RATE) < late[-1] < 0.5 * lag
    log = drive()
    seen = recorder.record(log, 0)
    # what a filter leaves of the sum is settled within a few lags
    assert abs(np.mean(seen.speed) - np.mean(log.speed)) < lag * np.ptp(log.speed) / 60 + 1e-9  # type: ignore[arg-type]
    assert np.diff(seen.speed).std() < np.diff(log.speed).std()  # type: ignore[arg-type]


def test_a_clock_that_is_late_shows_the_readings_of_before() -> None:
    log = drive(noise=0.0)
    seen = Recorder(accel_offset_s=0.02, speed_offset_s=-0.01).record(log, 0)
    np.testing.assert_allclose(seen.accel[2:], log.accel[:-2], atol=1e-9)  # type: ignore[index]
    np.testing.assert_allclose(seen.speed[:-1], log.speed[1:], atol=1e-9)  # type: ignore[index]
    np.testing.assert_array_equal(seen.accel_cmd, log.accel_cmd)


@pytest.mark.statistical
def test_vibration_has_its_frequency_and_grows_with_speed(rotating_seed: int, draws_factor: int) -> None:
    power = {}
    for speed in (10.0, 30.0):
        log = drive(300.0 * draws_factor, speed=speed, noise=0.0)
        seen = Recorder(vibration_mps2=0.1, vibration_hz=(8.0,)).record(log, rotating_seed)
        added = seen.accel - log.accel  # type: ignore[operator]
        power[speed] = float(np.mean(added**2) / np.mean(np.square(log.speed) / 900))  # type: ignore[arg-type]
        where, density = welch(added, RATE, nperseg=1024)
        assert abs(where[np.argmax(density)] - 8.0) < 0.5
        np.testing.assert_array_equal(seen.speed, log.speed)
    # in 300 s a peak of 0.24 Hz half width has some 450 independent pieces
    assert power[30.0] == pytest.approx(0.01, rel=0.3)
    assert power[30.0] == pytest.approx(power[10.0], rel=0.1)  # the same draws, weighed otherwise


@pytest.mark.statistical
def test_noise_has_the_tails_of_its_law(rotating_seed: int, draws_factor: int) -> None:
    log = drive(200.0 * draws_factor, noise=0.0)
    seen = Recorder(accel_noise_mps2=0.03, accel_noise_dof=4.0).record(log, rotating_seed)
    noise = (seen.accel - log.accel) / 0.03  # type: ignore[operator]
    rows = len(noise)
    for bound, share in ((0.741, 0.5), (2.776, 0.05)):  # Student's t of 4 degrees of freedom, two-sided
        found = float(np.mean(np.abs(noise) > bound))
        assert abs(found - share) < 5 * math.sqrt(share * (1 - share) / rows)


def test_rows_are_lost_and_repeated_and_time_stays_in_order(fresh_seed: int) -> None:
    log = drive(100.0)
    seen = Recorder(dropped=0.1, repeated=0.2).record(log, fresh_seed)
    lost = log.rows - seen.rows
    assert abs(lost - 0.1 * log.rows) < 6 * math.sqrt(0.09 * log.rows)
    assert (np.diff(seen.time) > 0).all()
    at = np.searchsorted(log.time, seen.time)
    np.testing.assert_array_equal(log.time[at], seen.time)
    np.testing.assert_array_equal(log.accel_cmd[at], seen.accel_cmd)  # type: ignore[index]
    assert seen.accel is not None
    assert seen.speed is not None
    repeats = np.diff(seen.accel, prepend=np.inf) == 0
    assert abs(repeats.sum() - 0.2 * seen.rows) < 6 * math.sqrt(0.16 * seen.rows)
    np.testing.assert_array_equal(repeats, np.diff(seen.speed, prepend=np.inf) == 0)
    np.testing.assert_array_equal(seen.accel[~repeats], log.accel[at][~repeats])  # type: ignore[index]


def test_a_driver_acts_against_the_logged_command(fresh_seed: int) -> None:
    """The motion is the driver's, and the controller that is not obeyed asks for the contrary."""
    log = drive(600.0, 20)
    seen = Recorder(overrides_per_min=3.0, override_s=4.0).record(log, fresh_seed)
    driver = ~seen.engaged
    np.testing.assert_array_equal(seen.accel, log.accel)
    np.testing.assert_array_equal(seen.speed, log.speed)
    np.testing.assert_array_equal(seen.accel_cmd[driver], -log.accel_cmd[driver])  # type: ignore[index]
    np.testing.assert_array_equal(seen.accel_cmd[~driver], log.accel_cmd[~driver])  # type: ignore[index]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], driver.astype(int), [0]])))
    lasts = (edges[1::2] - edges[::2]) / 20
    assert len(lasts) > 1
    # all but one at the end of the log last 4 s, or longer where two overlap
    assert (lasts[:-1] >= 4.0 - 0.051).all()
    again = Recorder(overrides_per_min=3.0, override_s=4.0, dropped=0.1).record(log, fresh_seed)
    np.testing.assert_array_equal(again.engaged, seen.engaged[np.searchsorted(log.time, again.time)])


@pytest.mark.statistical
def test_overrides_come_as_often_as_asked(rotating_seed: int) -> None:
    log = drive(3600.0, 10)
    seen = Recorder(overrides_per_min=0.5, override_s=0.2).record(log, rotating_seed)
    begins = int((np.diff(seen.engaged.astype(int)) == -1).sum())
    # 30 in an hour, by Poisson's law; so short that hardly two overlap
    assert abs(begins - 30) < BAR * math.sqrt(30) + 1


def test_a_case_is_overridden_and_keeps_its_motion() -> None:
    """Found by trying: which of the first cases have an override depends on their seed alone."""
    cases = [draw_case(i, 5, mix={"none": 1.0}, recorder="ordinary", seconds=60.0, manoeuvre="steps") for i in range(8)]
    logs = [case.log() for case in cases]
    overridden = [not log.engaged.all() for log in logs]
    assert any(overridden)
    assert not all(overridden)
    for case, log in zip(cases, logs, strict=True):
        at = np.searchsorted(case.run.time, log.time)
        sign = np.where(log.engaged, 1.0, -1.0)
        np.testing.assert_array_equal(log.accel_cmd, sign * case.run.command[at])
        assert log.usable.mean() > 0.2


def test_segments_are_recorded_apart(fresh_seed: int) -> None:
    time = np.concatenate([np.arange(300) / RATE, 100 + np.arange(300) / RATE])
    speed = np.repeat([10.0, 20.0], 300)
    log = Log.from_arrays(time=time, accel_cmd=np.sin(time), accel=0.1 * speed, speed=speed)
    many = Recorder(
        speed_lag_s=0.08, speed_offset_s=0.02, speed_hold_hz=7.0, accel_offset_s=-0.02, repeated=0.5, dropped=0.5
    )
    seen = many.record(log, fresh_seed)
    np.testing.assert_allclose(seen.speed, np.where(seen.time < 50, 10.0, 20.0), rtol=1e-12)
    np.testing.assert_allclose(seen.accel, 0.1 * np.asarray(seen.speed), rtol=1e-12)
    assert [len(part) for part in (seen.segments(), log.segments())] == [2, 2]


def test_one_channel_is_recorded_as_beside_the_other(fresh_seed: int) -> None:
    log, recorder = drive(), draw_recorder(np.random.default_rng(fresh_seed), RATE)
    both = recorder.record(log, fresh_seed)
    alone = recorder.record(Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, speed=log.speed), fresh_seed)
    assert alone.accel is None
    np.testing.assert_array_equal(alone.speed, both.speed)
    np.testing.assert_array_equal(alone.time, both.time)
    again = recorder.record(log, fresh_seed)
    np.testing.assert_array_equal(again.accel, both.accel)
    bare = recorder.record(Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=log.accel), fresh_seed)
    assert bare.speed is None
    assert np.isfinite(bare.accel).all()  # type: ignore[arg-type]


@pytest.mark.parametrize("rate", RATES_HZ)
def test_drawn_recorders_are_ordinary(rate: int, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    some = [draw_recorder(rng, rate) for _ in range(100)]
    assert len(set(some)) == 100
    assert {r.speed_hold_hz for r in some} == ({0.0, 20.0} if rate > 20 else {0.0})
    for r in some:
        assert 0.01 <= r.speed_quantum <= 0.14
        assert 0.02 <= r.speed_lag_s <= 0.08
        assert 1 <= len(r.vibration_hz) <= 3
        assert min(r.vibration_hz) >= 3
        assert max(r.vibration_hz) <= min(20.0, 0.5 * rate)
        assert 0.02 <= r.vibration_mps2 <= 0.15
        assert 0.01 <= r.accel_quantum <= 0.05
        assert 3 <= r.accel_noise_dof <= 10
        assert max(abs(x) for x in (r.accel_offset_s, r.speed_offset_s, r.accel_offset_s - r.speed_offset_s)) <= 0.02
        assert 0 <= r.dropped <= 0.02
        assert 0 <= r.repeated <= 0.02
        assert r.overrides_per_min == 0 or 0.5 <= r.overrides_per_min <= 1.5
        assert 2 <= r.override_s <= 6
    assert len({r.overrides_per_min == 0 for r in some}) == 2


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"speed_quantum": -0.1}, "speed_quantum: found -0.1"),
        ({"speed_hold_hz": math.inf}, "speed_hold_hz: found inf"),
        ({"accel_offset_s": math.nan}, "accel_offset_s: found nan"),
        ({"dropped": 1.0}, "dropped: found 1.0"),
        ({"accel_noise_dof": 0.0}, "accel_noise_dof: found 0.0"),
        ({"overrides_per_min": -1.0}, "overrides_per_min: found -1.0"),
        ({"vibration_mps2": 0.1}, "vibration_hz: found none"),
        ({"vibration_hz": (0.0,)}, r"vibration_hz: found \(0.0,\)"),
    ],
)
def test_what_it_refuses(change: dict, told: str) -> None:
    with pytest.raises(InputError, match=told):
        Recorder(**change)


def test_bad_seeds_rates_and_names_are_refused() -> None:
    with pytest.raises(InputError, match="seed: found -1"):
        Recorder().record(drive(2.0), -1)
    with pytest.raises(InputError, match="rate_hz: found 5"):
        draw_recorder(np.random.default_rng(0), 5)
    with pytest.raises(InputError, match="recorder: found 'poor'"):
        draw_case(0, 1, recorder="poor")  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("none", {}),
        ("single", {"effects": ["sensor_bias"], "tiers": ["easy"]}),
        ("pair", {"effects": ["sensor_bias", "dead_time"]}),
        ("outside", {"tiers": ["easy"], "outside": "calibration"}),
    ],
)
def test_every_kind_of_case_has_a_recorder(kind: str, more: dict) -> None:
    """The drive is that of the ideal case; the log is written by the recorder whose numbers the truth tells."""
    plain, case = (draw_case(3, 5, mix={kind: 1.0}, recorder=r, **more, **SHORT) for r in ("ideal", "ordinary"))
    assert plain.recorder == Recorder.ideal()
    truth = case.truth()
    told = truth.pop("recorder")
    assert truth == plain.truth() | {"oracle": {}}  # whose floors know nothing of a recorder
    assert told == asdict(case.recorder)
    assert json.loads(json.dumps(told))["speed_lag_s"] == case.recorder.speed_lag_s
    np.testing.assert_array_equal(case.run.accel, plain.run.accel)
    log, was = case.log(), plain.log()
    assert log.name == was.name
    assert log.rows <= was.rows
    ratio = np.asarray(log.speed) / told["speed_quantum"]
    np.testing.assert_allclose(ratio, np.round(ratio), atol=1e-6)
    np.testing.assert_array_equal(case.log(signals=("accel",)).accel, log.accel)
    np.testing.assert_array_equal(
        draw_case(3, 5, mix={kind: 1.0}, recorder="ordinary", **more, **SHORT).log().accel, log.accel
    )
