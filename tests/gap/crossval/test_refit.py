"""A find fitted to a part of its drives."""

import numpy as np
import pytest

from avtorch.gap import AerodynamicDrag, DeadTime, Gust, SensorScale
from avtorch.gap.blocks import folds
from avtorch.gap.crossval.noise_floor import drawn, expected
from avtorch.gap.crossval.refit import Refit
from avtorch.gap.crossval.scores import FoldScorer, parameter_spread
from avtorch.gap.rollout_errors import rollout_metrics
from tests.gap.finds import found_of


@pytest.mark.statistical
@pytest.mark.parametrize("effects", [[DeadTime(0.2)], [AerodynamicDrag()], [Gust(0.3, 2.0)]])
def test_a_part_agrees_within_its_uncertainty(effects: list, rotating_seed: int) -> None:
    found = found_of(effects, seconds=120.0, rng=np.random.default_rng(rotating_seed))
    for part in folds(found.hypothesis.record):
        refit = Refit.of(found, part.fits)
        away = (refit.z - found.z) @ np.linalg.solve(refit.covariance, refit.z - found.z)
        # chi-squared of some three coordinates, of which the two fits share three quarters of the data
        assert away < 30
        assert refit.errors.shape == found.errors.shape
        white = refit.white(part.held_out)
        assert 0.5 < (white(refit.errors[:, part.rows]) ** 2).mean() < 2.0


def test_the_whole_is_the_find_itself() -> None:
    found = found_of([SensorScale(1.2)], seconds=60.0)
    refit = Refit.whole(found)
    np.testing.assert_allclose(refit.errors, found.errors, atol=1e-9)
    assert refit.values == pytest.approx(found.values)


@pytest.mark.slow
@pytest.mark.statistical
def test_what_is_owed_is_what_draws_of_the_posterior_cost(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = found_of([SensorScale(1.2)], seconds=90.0, rng=rng)
    record = found.hypothesis.record
    part = folds(record)[0]
    refit = Refit.of(found, part.fits)
    judge = FoldScorer(record, part, rollout_metrics(record.channels), 0.35)
    floor = judge.floor(refit, parameter_spread(refit))
    draws = rng.multivariate_normal(np.zeros(len(refit.z)), refit.covariance, size=400)
    around = refit.around(np.concatenate([np.zeros((1, len(refit.z))), draws]))
    cost = sum(judge.products(one[None]) for one in around[1:] - around[:1])[..., 0, 0] / 400
    # 400 draws of a sum of squares: 7 % a standard deviation at most; rollouts bend a little
    owed = expected(floor.squares) - floor.squares[..., 0, 0]
    np.testing.assert_allclose(owed.sum(1), cost.sum(1), rtol=0.4)
    assert (expected(floor.nats) >= floor.nats[:, 0, 0]).all()
    # whole rollouts under the posterior, as long as they do not bend: medians of 400 against 4000
    squares = np.stack([judge.products(record.measured[None] - one)[..., 0, 0] for one in around[1:]])
    told = drawn(floor.squares, rng.standard_normal((4000, floor.axes)))
    away = np.median(told.sum(-1), 0) - np.median(squares.sum(-1), 0)
    assert (np.abs(away) < 0.5 * squares.sum(-1).std(0)).all()
