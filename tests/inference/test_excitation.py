"""The rule of excitation: a function of a, u and the noise level, with the SDs that least squares really has."""

from __future__ import annotations

import pytest
import torch

from avtorch.inference import ExcitationRule, JerkStatistics
from tests.bars import BAR

F64 = torch.float64


@pytest.mark.statistical
def test_predicted_sds_are_those_of_repeated_least_squares(make_windows, rotating_seed, draws_factor):
    """2000 noises on one window whose truth is the reference: the spread of T_L and K_L is the predicted one."""
    w = make_windows(rotating_seed, [1.0], T=1.0, K=1.0, sigma=0.05)
    clean = (w.u - w.a) / 1.0
    repeats = 2000 * draws_factor
    g = torch.Generator().manual_seed(rotating_seed)
    jerk = clean + 0.05 * torch.randn(repeats, w.u.shape[1], generator=g, dtype=F64)
    statistics = JerkStatistics.from_samples(w.a.expand(repeats, -1), w.u.expand(repeats, -1), jerk)
    inverse_lag, gain_over_lag, _ = statistics.least_squares()
    predicted = torch.stack([x.square().mean().sqrt() for x in ExcitationRule().predicted_sd(statistics)])
    found = torch.stack([(1 / inverse_lag).std(), (gain_over_lag / inverse_lag).std()])
    # an SD from 2000 draws is good to 1/sqrt(4000); the delta method's own error is of order (SD/T)^2
    slack = BAR / (2 * repeats) ** 0.5 + 6 * predicted.max().item() ** 2
    assert predicted.max() < 0.06
    assert ((found - predicted) / predicted).abs().max() < slack


def test_windows_without_excitation_are_not_excited(make_windows):
    w = make_windows(0, [1.0, 0.0, 1e-3])
    constant = torch.full((1, 200), 0.7, dtype=F64)
    g = torch.Generator().manual_seed(1)
    noise = 0.1 * torch.randn(1, 200, generator=g, dtype=F64)
    cruise = JerkStatistics.from_samples(constant, constant, noise)
    assert ExcitationRule()(w.statistics, 200).tolist() == [True, False, False]
    assert ExcitationRule()(cruise, 200).tolist() == [False]
    for sd in ExcitationRule().predicted_sd(cruise):
        assert sd.isposinf().all()


def test_the_rule_depends_on_rows_noise_and_signals_only(make_windows):
    quiet, loud = (make_windows(0, [0.6], sigma=s).statistics for s in (0.05, 3.0))
    assert ExcitationRule()(quiet, 200).all()
    assert not ExcitationRule()(loud, 200).any()
    # half the rows must be usable
    assert not ExcitationRule()(quiet, 401).any()
    assert ExcitationRule(share=0.4)(quiet, 401).all()


@pytest.mark.parametrize("rows", [0, 1, 2, 3])
def test_a_handful_of_rows_is_never_excited(rows, make_windows):
    w = make_windows(0, [5.0], sigma=1e-6)
    statistics = JerkStatistics.from_samples(w.a[:, :rows], w.u[:, :rows], w.jerk[:, :rows])
    assert not ExcitationRule()(statistics, rows).any()
