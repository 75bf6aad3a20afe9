"""Constants belong to this likelihood: it reproduces the numbers stored when they were fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.gap.likelihood import grade_marginal as slope
from avtorch.gap.likelihood import hypothesis as candidate
from avtorch.gap.likelihood import noise_fit
from avtorch.gap.search import lost_messages as losses
from avtorch.gap.search import outliers as chance
from avtorch.gap.search import own_noise_fit
from avtorch.gap.selection import adequacy as remainder
from avtorch.gap.selection.calibration import document
from benchmarks.fit_calibration.__main__ import COMMAND
from benchmarks.fit_calibration.drives import normal
from benchmarks.fit_calibration.fingerprint import FIXED_PLACE, PARTS, differences

FAST = (FIXED_PLACE,)  # half a second; the searches take one to two seconds each


@pytest.mark.parametrize("part", [p if p in FAST else pytest.param(p, marks=pytest.mark.slow) for p in PARTS])
def test_the_likelihood_is_the_one_that_the_constants_were_fitted_to(part: str) -> None:
    changed = differences(part, document()["fingerprint"][part], PARTS[part]())
    assert not changed, (
        "the likelihood has changed, and the constants behind probabilities were not fitted again: probabilities are "
        f"no longer calibrated. Fit them anew, which takes hours: {COMMAND} --seed SEED --cases 170 "
        "(docs/calibration.md); or undo the change. " + "; ".join(changed)
    )


def test_every_part_is_stored() -> None:
    assert document()["fingerprint"].keys() == PARTS.keys()


def test_a_difference_is_reported() -> None:
    stored = {"none": 1000.0, "dead_time": 1100.0}
    assert differences("late", stored, {"none": 1000.04, "dead_time": 1100.0}) == []
    assert differences("late", stored, {"none": 1000.06, "dead_time": 1100.0}) == [
        "late: none: stored 1000, computed 1000.06"
    ]
    assert differences(FIXED_PLACE, stored, {"none": 1000.0005, "dead_time": 1100.0}) == []
    assert differences(FIXED_PLACE, stored, {"none": 1000.002, "dead_time": 1100.0}) != []
    assert differences("late", stored, {"none": 1000.0}) == ["late: dead_time: only stored"]


def test_drives_are_normal_noise() -> None:
    z = normal(1, 3, 20000)
    assert np.abs(z.mean(1)).max() < 5 / np.sqrt(20000)
    assert np.abs(z.var(1) - 1).max() < 5 * np.sqrt(2 / 20000)
    assert np.abs(np.corrcoef(z) - np.eye(3)).max() < 5 / np.sqrt(20000)


def test_a_prior_of_the_effects_is_felt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidate, "_WIDER", 1.01 * candidate._WIDER)
    assert differences(FIXED_PLACE, document()["fingerprint"][FIXED_PLACE], PARTS[FIXED_PLACE]())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "of", "name", "value"),
    [
        ("late", noise_fit.PRIORS, "force_sd", (np.log(0.01), 0.5, 1.5)),
        ("late", own_noise_fit, "onset_evidence", lambda tried, dt: 0.0),
        ("late", remainder, "SCALES", replace(remainder.SCALES, sizes=(2.0, 5.0, 15.0, 50.0))),
        ("chance", chance, "_TAIL_PRIOR", ((np.log(0.02), 1.5), (np.log(7.0), 0.4))),
        ("chance", losses, "_CENTRE", losses._CENTRE + 0.5),
        ("road", noise_fit.GUST, "force_sd", (np.log(0.2), 1.0, 4.0)),
        (FIXED_PLACE, slope, "_SPREAD", 1.5),
    ],
)
def test_every_part_of_the_likelihood_is_felt(
    monkeypatch: pytest.MonkeyPatch, part: str, of: object, name: str, value: object
) -> None:
    (monkeypatch.setitem if isinstance(of, dict) else monkeypatch.setattr)(of, name, value)  # type: ignore[operator]
    assert differences(part, document()["fingerprint"][part], PARTS[part]())
