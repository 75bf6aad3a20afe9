"""The quality check notes what is doubtful, and stays silent about good drives."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.io import Log, check

from .drives import drive

GOOD = drive()


def notes(**columns) -> str:
    return "\n".join(check(Log.from_arrays(**(GOOD | columns))).notes)


@pytest.mark.parametrize("lag", [0.1, 0.5, 1.5])
@pytest.mark.parametrize("gain", [0.4, 0.7, 1.0])
def test_a_good_drive_raises_no_doubt(lag, gain, fresh_seed):
    columns = drive(lag=lag, noise=0.05, seed=fresh_seed)
    columns["accel_cmd"] = columns["accel_cmd"] / gain  # the actuator gives the share `gain` of what is demanded
    seen = check(Log.from_arrays(**columns))
    assert seen.doubtful_units == ()
    assert seen.constant == ()
    assert len(seen.notes) == 1
    assert "1500 rows, 30.0 s in 1 segment, 50 Hz" in seen.notes[0]


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_the_scale_error_of_a_real_accelerometer_is_no_unit_mistake(scale):
    assert check(Log.from_arrays(**(GOOD | {"accel": GOOD["accel"] * scale}))).rows == 1500


def test_constant_signals_are_said_not_refused():
    still = np.zeros(1500)
    seen = check(Log.from_arrays(time=GOOD["time"], accel_cmd=still, accel=still, speed=still + 12))
    assert seen.constant == ("accel_cmd", "accel", "speed")
    assert "speed is constant (12): it excites nothing" in seen.notes


def test_doubtful_units_are_noted():
    assert "could it be km/h" in notes(speed=GOOD["speed"] + 50)
    # a command of which 1.8 times arrives: half the gain, and speed in km/h?
    assert "responds with" in notes(accel_cmd=GOOD["accel_cmd"] / 1.9)
    assert "accel implies" in notes(accel=GOOD["accel"] * 1.7)
    assert "the leader is" in notes(lead_speed=GOOD["speed"] * 2.3)
    jerk = np.gradient(GOOD["accel"], GOOD["time"])
    assert "jerk implies" in notes(jerk=jerk / 9.80665)
    calm = {"time": GOOD["time"], "accel_cmd": GOOD["accel_cmd"] / 9.80665, "accel": GOOD["accel"] / 9.80665}
    assert any("Only speed could show which" in note for note in check(Log.from_arrays(**calm)).notes)


def test_signals_that_contradict_each_other():
    assert "disagree" in notes(accel=np.roll(GOOD["accel"], 700))


def test_a_held_signal_is_recognised():
    assert "accel_cmd changes every 5 rows only: it comes at 10 Hz" in notes(
        accel_cmd=np.repeat(GOOD["accel_cmd"][::5], 5)
    )


def test_all_masked_and_missing_witnesses_are_said():
    assert "no row is left to estimate from" in notes(engaged=np.zeros(1500))
    one = {k: GOOD[k] for k in ("time", "accel_cmd", "speed")}
    seen = check(Log.from_arrays(**one))
    assert seen.missing == ("accel",)
    assert any("only channel" in note for note in seen.notes)


def test_many_gaps_are_counted_not_listed():
    jumps = 3.0 * (np.arange(1500) // 150)
    seen = check(Log.from_arrays(**(GOOD | {"time": GOOD["time"] + jumps})))
    assert seen.segments == 10
    assert len(seen.gaps) == 9
    assert "4 more gaps, each the start of a new segment" in seen.notes


def test_the_answer_is_json(tmp_path):
    from avtorch.io import write_json

    write_json(tmp_path / "q.json", check(Log.from_arrays(**GOOD)).to_dict())
    assert '"rate_hz"' in (tmp_path / "q.json").read_text()
