"""Drawings of followers show the numbers of their diagnoses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from avtorch.errors import InputError
from avtorch.follower import FollowerDiagnosis, diagnose_follower
from avtorch.plots import followers as over_followers
from tests.follower.loops import CTG, followed_log


@pytest.fixture(scope="module")
def cars() -> list[FollowerDiagnosis]:
    log = followed_log("constant_time_gap", CTG, seconds=90, rng=np.random.default_rng(4))
    one = diagnose_follower(log, law="constant_time_gap", cause=False)
    lost = replace(one, name="another", stability=tuple(replace(s, peak_gain=None) for s in one.stability))
    return [one, lost]


def test_each_car_has_its_row(cars: list[FollowerDiagnosis]) -> None:
    ax = over_followers.parameter_of_each(Figure().subplots(), cars, "headway_s")
    (points,) = ax.lines
    np.testing.assert_allclose(np.asarray(points.get_xdata(), float), [c.parameters["headway_s"].mean for c in cars])
    assert [label.get_text() for label in ax.get_yticklabels()] == [c.name for c in cars]
    with pytest.raises(InputError, match="needs one of"):
        over_followers.parameter_of_each(Figure().subplots(), cars, "colour")


def test_a_loop_that_may_not_be_stable_has_no_peak(cars: list[FollowerDiagnosis]) -> None:
    ax = over_followers.peak_gain_of_each(Figure().subplots(), cars)
    points = [line for line in ax.lines if line.get_marker() == "o"]
    assert len(points) == 1
    peak = cars[0].usual.peak_gain
    assert peak is not None
    assert float(np.asarray(points[0].get_xdata(), float)[0]) == pytest.approx(min(peak.mean, 4.0))


def test_figure_has_three_panels(cars: list[FollowerDiagnosis]) -> None:
    assert len(over_followers.followers_figure(cars).axes) == 3
