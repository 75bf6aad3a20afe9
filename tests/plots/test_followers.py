"""Drawings of followers show the numbers of their diagnoses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.follower import FollowerDiagnosis, diagnose_follower
from avtorch.plots import followers as over_followers
from tests.follower.loops import CTG, followed_log


@pytest.fixture(scope="module")
def cars() -> list[FollowerDiagnosis]:
    log = followed_log("constant_time_gap", CTG, seconds=90, rng=np.random.default_rng(4))
    one = diagnose_follower(log, law="constant_time_gap", cause=False)
    lost = replace(one, name="another", stability=tuple(replace(s, peak_gain=None) for s in one.stability))
    return [one, lost]


def test_each_car_has_its_row_and_a_loop_that_may_be_unstable_no_peak(cars: list[FollowerDiagnosis]) -> None:
    headway, _, gain = over_followers.followers_figure(cars).axes
    (points,) = headway.lines
    np.testing.assert_allclose(np.asarray(points.get_xdata(), float), [c.parameters["headway_s"].mean for c in cars])
    assert [label.get_text() for label in headway.get_yticklabels()] == [c.name for c in cars]
    points = [line for line in gain.lines if line.get_marker() == "o"]
    assert len(points) == 1
    peak = cars[0].usual.peak_gain
    assert peak is not None
    assert float(np.asarray(points[0].get_xdata(), float)[0]) == pytest.approx(min(peak.mean, 4.0))
