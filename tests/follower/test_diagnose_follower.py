"""A follower with known law and plant: both are recovered, with the loop's stability, and bad input is refused."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.follower import (
    LAWS,
    FollowerDiagnosis,
    FollowerMeasurements,
    diagnose_follower,
    loop_errors,
    loop_stability,
)
from avtorch.follower.identify import followed, identified, widened
from avtorch.io import Log
from avtorch.vehicle.stability import local_stable, peak_gain, string_stable
from tests.follower.loops import CTG, DELAY, DT, IDM, T_L, followed_log

TRUTHS = {"constant_time_gap": CTG, "intelligent_driver": IDM}


def key_values(values: dict[str, float]) -> dict[str, float]:
    return {f"law.{k}": v for k, v in values.items()} | {"T_L": T_L, "dead_time.delay_s": DELAY}


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("name", TRUTHS)
def test_law_lag_and_delay_are_found(name: str, rotating_seed: int) -> None:
    log = followed_log(name, TRUTHS[name], seconds=240, rng=np.random.default_rng(rotating_seed))
    found = diagnose_follower(log, cause=False)
    assert found.law.name == name
    candidate = found.identified.candidate
    truth = candidate.z_of(key_values(TRUTHS[name]))
    z = {k: (x.mean(), x.std()) for k, x in zip(truth_names(found), drawn_z(found).T, strict=True)}
    for value, (mean, sd) in zip(truth, z.values(), strict=True):
        # widened by the spread of four parts, of which the sd is known to 40 %
        assert abs(mean - value) < 6 * sd + 0.02
    total = found.parameters["lag_with_delay_s"]
    assert total.mean == pytest.approx(T_L + DELAY, abs=6 * total.sd + 0.01)
    own, bare = found.loops[name], found.loops["without_delay"]
    assert own.speed < bare.speed < found.keeps_speed
    assert own.amplified_simulated == pytest.approx(own.amplified, rel=0.05)


def truth_names(found: FollowerDiagnosis) -> list[str]:
    return list(found.identified.candidate.coordinates)


def drawn_z(found: FollowerDiagnosis) -> np.ndarray:
    each = found.identified.candidate.coordinates
    return np.stack([p.unconstrain(torch.as_tensor(found.draws[key])).numpy() for key, p in each.items()], 1)


@pytest.mark.statistical
@pytest.mark.slow
def test_a_gap_changed_midway_gets_a_wide_interval(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    near, far = (followed_log("constant_time_gap", CTG | {"time_gap_s": h}, seconds=120, rng=rng) for h in (1.2, 1.8))
    columns = {n: np.concatenate([getattr(near, n), getattr(far, n)]) for n in ("speed", "spacing", "lead_speed")}
    time = np.concatenate([near.time, far.time + near.time[-1] + 30])
    both = replace(near, time=time, segment=np.repeat([0, 1], [near.rows, far.rows]), engaged=np.ones(len(time), bool))
    candidate = followed(replace(both, **columns), LAWS["constant_time_gap"])
    found = identified(candidate)
    wide = widened(found)
    assert (np.diag(wide) >= np.diag(found.covariance)).all()
    assert (np.linalg.eigvalsh(wide) > 0).all()
    # the two are 0.6 s apart; each time gap is identified to 0.01 s
    assert found.draws(wide)["law.time_gap_s"].std() > 0.1


@pytest.mark.slow
@pytest.mark.statistical
def test_a_driver_who_falls_back_is_no_part_of_the_law(rotating_seed: int) -> None:
    """The driver brakes while the law demands more; rollouts through those rows gave half a second of delay."""
    overrides = [(30.0, 34.0), (62.0, 66.0), (95.0, 99.0), (130.0, 134.0)]
    rng = np.random.default_rng(rotating_seed)
    log = followed_log("constant_time_gap", CTG, seconds=170, rng=rng, overrides=overrides)
    found = diagnose_follower(log, law="constant_time_gap", cause=False)
    total, gap = (found.parameters[name] for name in ("lag_with_delay_s", "headway_s"))
    # the spread of two parts widens its interval; what is left of it is known to a factor
    assert total.mean == pytest.approx(T_L + DELAY, abs=6 * total.sd + 0.03)
    assert total.mean < T_L + DELAY + 0.2
    assert gap.sd < 0.03
    # tested within one drive: the longest between overrides
    assert found.loops["constant_time_gap"].speed < found.keeps_speed


@pytest.mark.statistical
@pytest.mark.parametrize("name", TRUTHS)
def test_loop_of_the_truth_goes_with_the_drive(name: str, rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    log = followed_log(name, TRUTHS[name], seconds=120, rng=rng, noise=0.0)
    assert log.speed is not None
    assert log.spacing is not None
    assert log.lead_speed is not None
    seen = FollowerMeasurements(*(torch.as_tensor(x) for x in (log.spacing, log.speed, log.lead_speed)))
    errors = loop_errors(LAWS[name], key_values(TRUTHS[name]), seen, DT, seconds=40.0)
    # sensors' noise of 0.01 m/s and 0.02 m, the initial acceleration from a difference, and steps of 0.1 s
    assert errors.speed < 0.05
    assert errors.spacing < 0.15


def test_stability_is_that_of_the_exact_verdicts_without_delay(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    k_s, k_v, h, T = rng.uniform([[0.02], [0.1], [0.5], [0.1]], [[0.5], [1.5], [3.0], [1.0]], (4, 60))
    gains = torch.as_tensor(np.stack([k_s, k_v, np.zeros(60)], -1))
    setting = (torch.as_tensor(T), torch.ones(60, dtype=torch.float64), torch.as_tensor(h), gains)
    local, string, peak = local_stable(*setting), string_stable(*setting), peak_gain(*setting)
    for i in range(60):
        draws = {
            "law.spacing_gain_per_s2": k_s[[i]],
            "law.speed_gain_per_s": k_v[[i]],
            "law.time_gap_s": h[[i]],
            "law.standstill_m": np.zeros(1),
            "T_L": T[[i]],
        }
        (told,) = loop_stability(LAWS["constant_time_gap"], draws, [20.0])
        assert told.p_locally_stable == float(local[i])
        if not 1 < float(peak[i]) < 1 + 1e-3:
            assert told.p_string_stable == float(string[i] & local[i])


@pytest.mark.statistical
@pytest.mark.slow
def test_cause_is_conditional_on_the_law(rotating_seed: int) -> None:
    log = followed_log("constant_time_gap", CTG, seconds=240, rng=np.random.default_rng(rotating_seed))
    found = diagnose_follower(log, law="constant_time_gap", effects=["aerodynamic_drag", "road_grade"])
    assert found.diagnosis is not None
    assert not (found.diagnosis.winner.effects and found.diagnosis.winner.probability > 0.9)
    answer = found.to_dict()
    assert answer["schema"] == "avtorch.diagnosis/2"
    assert answer["follower"]["law"] == "constant_time_gap"
    assert any("conditional" in line for line in answer["follower"]["conditional"])


@pytest.mark.parametrize("name", ["speed", "spacing", "lead_speed"])
def test_what_is_missing_is_named(name: str) -> None:
    log = followed_log("constant_time_gap", CTG, seconds=60, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match=f"has no {name}"):
        diagnose_follower(replace(log, **{name: None}))


def test_a_short_drive_is_refused() -> None:
    log = followed_log("constant_time_gap", CTG, seconds=30, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="needs 40 s or more"):
        diagnose_follower(log)


@pytest.mark.statistical
@pytest.mark.slow
def test_drives_that_begin_their_time_anew_keep_their_own_rows(
    rotating_seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(rotating_seed)
    each = [followed_log("constant_time_gap", CTG, seconds=s, rng=rng) for s in (2.0, 50.0, 70.0)]
    columns = {n: np.concatenate([getattr(x, n) for x in each]) for n in ("time", "speed", "spacing", "lead_speed")}
    rows = [x.rows for x in each]
    whole = replace(each[0], segment=np.repeat([0, 1, 2], rows), engaged=np.ones(sum(rows), bool), **columns)
    candidate = followed(whole, LAWS["constant_time_gap"])
    # the first is too short to be a drive
    assert candidate.data.source[candidate.data.bounds[:-1]].tolist() == [rows[0], rows[0] + rows[1]]
    for seen, log in zip(candidate.seen, each[1:], strict=True):
        np.testing.assert_array_equal(seen.spacing.numpy(), log.spacing)

    given: list[Log] = []

    def only_look(log: Log, **_: object) -> None:
        given.append(log)

    monkeypatch.setattr(sys.modules[diagnose_follower.__module__], "diagnose", only_look)
    found = diagnose_follower(whole, law="constant_time_gap")
    (late,) = given
    # half of the rows in which the car follows, all in the last drive
    assert late.rows == (rows[1] + rows[2]) // 2
    np.testing.assert_array_equal(late.spacing, whole.spacing[-late.rows :])
    own = {k.removeprefix("law."): torch.tensor(v) for k, v in found.identified.values.items() if k.startswith("law.")}
    seen = FollowerMeasurements(
        *(torch.as_tensor(getattr(each[2], n)[-late.rows :]) for n in FollowerMeasurements._fields)
    )
    foretold = LAWS["constant_time_gap"].command(own, seen).numpy()
    # by the half that came first, hence not the same to a hair; another drive's commands would be off by their size
    assert np.std(late.accel_cmd - foretold) < 0.3 * np.std(foretold)
