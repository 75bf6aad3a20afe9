"""Modes against a general optimiser, evidence against quadrature, a road's slope against the dense formula."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from avtorch.arrays import FloatArray
from avtorch.gap import (
    AerodynamicDrag,
    ConstantResistance,
    DeadTime,
    GapPlant,
    RoadGrade,
    SensorBias,
    SimulatorInput,
    plant,
)
from avtorch.gap.drive_record import Record
from avtorch.gap.effects.road_grade import GRAVITY
from avtorch.gap.likelihood.gauss_newton import finish, modes
from avtorch.gap.likelihood.grade_marginal import SIZES
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.simulator.effect_context import EffectContext
from tests.gap.records import QUIET, log_of


def _log_joint(hypothesis: Hypothesis, white: WhiteningFilter, z: FloatArray, onset: int | None = None) -> FloatArray:
    """Log likelihood plus log prior (its constant left out), z (column, coordinate)."""
    return white.log_likelihood(hypothesis.errors(z, onset)) - 0.5 * (z**2).sum(1)


def _case(
    car: GapPlant, name: str, rng: np.random.Generator, *, seconds: float = 42.0, **options: object
) -> tuple[Hypothesis, WhiteningFilter]:
    log = log_of(car, seconds=seconds, rng=rng, **options)  # type: ignore[arg-type]
    record = Record.of(log)
    return Hypothesis.named(record, name, plant()), WhiteningFilter(record, QUIET)


CARS = {
    "none": plant(T_L=0.4, K_L=0.95),
    "dead_time": plant([DeadTime(0.23)], T_L=0.4),
    "aerodynamic_drag": plant([AerodynamicDrag(5e-4)], T_L=0.4),
}


TRUTH = {
    "none": {"T_L": 0.4, "K_L": 0.95},
    "dead_time": {"T_L": 0.4, "K_L": 1.0, "dead_time.delay_s": 0.23},
    "aerodynamic_drag": {"T_L": 0.4, "K_L": 1.0, "aerodynamic_drag.drag_per_m": 5e-4},
}


@pytest.mark.parametrize("pinned", [None, 187353542])
@pytest.mark.parametrize("rate_hz", [20, 50])
@pytest.mark.parametrize("name", CARS)
def test_the_mode_is_the_optimisers(name: str, rate_hz: int, pinned: int | None, fresh_seed: int) -> None:
    """Under the pinned seed a dead time at 50 Hz has its mode at 11 rows exactly, where its density has a crease."""
    rng = np.random.default_rng(fresh_seed if pinned is None else pinned)
    hypothesis, white = _case(CARS[name], name, rng, rate_hz=rate_hz)
    start = hypothesis.z_of({"T_L": 0.3, "K_L": 1.0})
    found, values = modes(hypothesis, white, start[None], iterations=15)
    fit = finish(hypothesis, white, found[0])
    root = np.linalg.cholesky(fit.covariance)

    def cost(w: FloatArray) -> float:
        return -float(_log_joint(hypothesis, white, (found[0] + root @ w)[None])[0])

    # from half a standard deviation off, in the posterior's own coordinates
    best = minimize(cost, np.full(hypothesis.size, 0.5), method="BFGS", options={"gtol": 1e-3})
    assert values[0] == pytest.approx(-best.fun, abs=0.05)
    assert fit.log_joint == pytest.approx(-cost(np.zeros(hypothesis.size)), abs=1e-6)
    assert np.abs(best.x).max() < 0.3


@pytest.mark.statistical
@pytest.mark.parametrize("rate_hz", [20, 50])
@pytest.mark.parametrize("name", CARS)
def test_the_mode_is_where_the_truth_is(name: str, rate_hz: int, rotating_seed: int) -> None:
    """Within 6 standard deviations: the noise model is the errors' own."""
    hypothesis, white = _case(CARS[name], name, np.random.default_rng(rotating_seed), rate_hz=rate_hz)
    found, _ = modes(hypothesis, white, hypothesis.z_of({"T_L": 0.3, "K_L": 1.0})[None], iterations=15)
    fit = finish(hypothesis, white, found[0])
    for key, value in TRUTH[name].items():
        i = [c.key for c in hypothesis.coordinates].index(key)
        assert abs(found[0, i] - hypothesis.z_of({key: value})[i]) < 6 * np.sqrt(fit.covariance[i, i])


def test_many_starts_are_each_alone(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    hypothesis, white = _case(CARS["dead_time"], "dead_time", rng)
    starts = np.stack(
        [
            hypothesis.z_of({"T_L": t, "K_L": 1.0, "dead_time.delay_s": d})
            for t, d in ((0.3, 0.1), (0.5, 0.3), (0.2, 0.5))
        ]
    )
    kept = starts.copy()
    found, values = modes(hypothesis, white, starts)
    np.testing.assert_array_equal(starts, kept)
    for start, z, value in zip(starts, found, values, strict=True):
        alone, own = modes(hypothesis, white, start[None])
        np.testing.assert_allclose(alone[0], z, atol=1e-6)
        assert own[0] == pytest.approx(value, abs=1e-5)


@pytest.mark.statistical
def test_a_coarse_look_is_near(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    hypothesis, white = _case(CARS["dead_time"], "dead_time", rng, rate_hz=100)
    start = hypothesis.z_of({"T_L": 0.3, "K_L": 1.0, "dead_time.delay_s": 0.1})[None]
    coarse, _ = modes(hypothesis, white, start, coarse=True)
    fine, _ = modes(hypothesis, white, coarse, iterations=4)
    assert float(hypothesis.values(coarse)["dead_time.delay_s"]) == pytest.approx(0.23, abs=0.03)
    assert float(hypothesis.values(fine)["dead_time.delay_s"]) == pytest.approx(0.23, abs=0.02)


def _by_quadrature(
    hypothesis: Hypothesis, white: WhiteningFilter, z: FloatArray, covariance: FloatArray, nodes: int = 7
) -> float:
    """Log evidence by Gauss-Hermite nodes about the mode."""
    x, w = np.polynomial.hermite_e.hermegauss(nodes)
    grid = np.array(list(product(x, repeat=len(z))))
    weights = np.array([np.prod(v) for v in product(w, repeat=len(z))]) / (2 * np.pi) ** (len(z) / 2)
    at = z + grid @ np.linalg.cholesky(covariance).T
    joint = np.concatenate([_log_joint(hypothesis, white, part) for part in np.array_split(at, 12)])
    # density of the nodes' own normal distribution; the prior's constant cancels its own
    ratio = joint + 0.5 * (grid**2).sum(1) + 0.5 * float(np.linalg.slogdet(covariance)[1])
    top = ratio.max()
    return float(top + np.log((weights * np.exp(ratio - top)).sum()))


@pytest.mark.parametrize("rate_hz", [20, 50])
@pytest.mark.parametrize(
    ("name", "car"),
    [
        ("sensor_bias", plant([SensorBias(0.1)])),
        ("sensor_bias", plant()),
        ("constant_resistance", plant([ConstantResistance(0.12)])),
        ("none", plant()),
    ],
)
def test_laplace_is_the_evidence_of_what_is_linear(name: str, car: GapPlant, rate_hz: int, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    hypothesis, white = _case(car, name, rng, rate_hz=rate_hz)
    z, _ = modes(hypothesis, white, hypothesis.z_of({"T_L": 0.3, "K_L": 1.0})[None], iterations=12)
    fit = finish(hypothesis, white, z[0])
    exact = _by_quadrature(hypothesis, white, z[0], fit.covariance)
    assert fit.log_evidence == pytest.approx(exact, abs=0.1)


@pytest.mark.statistical
def test_evidence_prefers_the_cause_that_is_there(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    for car, sign in ((plant([SensorBias(0.1)]), 1), (plant(), -1)):
        with_bias, white = _case(car, "sensor_bias", rng)
        without = Hypothesis.named(with_bias.record, "none", plant())
        evidence = []
        for hypothesis in (with_bias, without):
            start = hypothesis.z_of({"T_L": 0.3, "K_L": 1.0})[None]
            evidence.append(
                finish(hypothesis, white, modes(hypothesis, white, start, iterations=12)[0][0]).log_evidence
            )
        # of the bias alone: its prior is some 0.4 m/s² wide, its posterior some 0.005
        assert sign * (evidence[0] - evidence[1]) > (15 if sign > 0 else -8)


def test_an_onset_counts_what_comes_after_it(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    hypothesis, white = _case(CARS["none"], "sensor_bias", rng)
    z = hypothesis.z_of({"T_L": 0.4, "K_L": 0.95})
    start = np.append(z[:2], 0.5)[None]
    onset = 400
    early, _ = modes(hypothesis, white, start, onset=onset, iterations=12)
    fit = finish(hypothesis, white, early[0], onset)
    assert fit.log_joint == pytest.approx(float(_log_joint(hypothesis, white, early, onset)[0]), abs=1e-6)
    whole = finish(hypothesis, white, modes(hypothesis, white, start, iterations=12)[0][0])
    # half of the drive is less informative
    assert fit.covariance[2, 2] > 1.4 * whole.covariance[2, 2]


# a road's slope ---------------------------------------------------------------------------------------------------


def _hills(rng: np.random.Generator, rms: float = 0.015) -> GapPlant:
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    return plant([RoadGrade(rms, profile=torch.randn(20, generator=generator, dtype=torch.float64))])


def _white_columns(hypothesis: Hypothesis, white: WhiteningFilter, onset: int | None) -> FloatArray:
    columns = hypothesis.grade_columns
    assert columns is not None
    if onset is not None:
        columns = columns.copy()
        columns[:, -1] -= columns[:, -1, onset, :1][:, :, None]
        columns[:, :, :onset] = 0.0
    return white(columns).reshape(len(columns), -1)


@pytest.mark.parametrize("onset", [None, 80])
def test_integrating_a_slope_out_is_the_dense_gaussian(onset: int | None, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    hypothesis, white = _case(_hills(rng), "road_grade", rng, speed0=30.0, seconds=14.0)
    z = hypothesis.z_of({"T_L": 0.3, "K_L": 1.0})
    fit = finish(hypothesis, white, z, onset)
    e = white(hypothesis.errors(z[None], onset))[0].ravel()
    columns = _white_columns(hypothesis, white, onset)
    sizes = np.exp(np.linspace(np.log(2e-4), np.log(0.1), 49))
    dense = []
    for rms in sizes:
        covariance = np.eye(len(e)) + rms**2 * columns.T @ columns
        root = np.linalg.cholesky(covariance)
        u = np.linalg.solve(root, e)
        dense.append(-0.5 * u @ u - np.log(np.diag(root)).sum())
    prior = -0.5 * ((np.log(sizes) - np.log(0.012)) / 1.2) ** 2 - np.log(1.2 * np.sqrt(2 * np.pi))
    joint = np.array(dense) + prior
    mass = np.log(np.exp(joint - joint.max()).sum() * np.log(sizes[1] / sizes[0])) + joint.max()
    assert fit.log_joint == pytest.approx(white.constant_of(coarse=False) + mass - 0.5 * z @ z, abs=0.05)
    assert fit.grade_rms == pytest.approx(sizes[int(np.argmax(joint))], rel=0.35)


@pytest.mark.parametrize("onset", [None, 80])
def test_the_reported_slope_is_the_posterior_mean(onset: int | None, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    hypothesis, white = _case(_hills(rng), "road_grade", rng, speed0=30.0, seconds=14.0)
    z = hypothesis.z_of({"T_L": 0.3, "K_L": 1.0})
    fit = finish(hypothesis, white, z, onset)
    assert fit.profile is not None
    assert fit.grade_rms is not None
    e = white(hypothesis.errors(z[None], onset))[0].ravel()
    columns = _white_columns(hypothesis, white, onset)
    # by every size of the grid on its own, and weighed by what the size explains
    means, worth = [], []
    for rms in SIZES:
        precision = columns @ columns.T + np.eye(len(columns)) / rms**2
        means.append(np.linalg.solve(precision, columns @ e))
        volume = np.linalg.slogdet(precision)[1] + 2 * len(columns) * np.log(rms)
        prior = -0.5 * ((np.log(rms) - np.log(0.012)) / 1.2) ** 2
        worth.append(0.5 * means[-1] @ columns @ e - 0.5 * volume + prior)
    shares = np.exp(np.array(worth) - max(worth))
    mean = shares @ np.array(means) / shares.sum()
    np.testing.assert_allclose(fit.profile, mean, atol=1e-6 * np.abs(mean).max())
    # and it explains the errors instead of doubling them
    left = white(fit.errors).ravel()
    np.testing.assert_allclose(left, e - mean @ columns, atol=1e-6)
    assert left @ left < e @ e


@pytest.mark.statistical
def test_the_reported_slope_is_the_roads(rotating_seed: int) -> None:
    """A plant given the profile found does what the log shows, all but the noise."""
    rng = np.random.default_rng(rotating_seed)
    car = _hills(rng)
    hypothesis, white = _case(car, "road_grade", rng, speed0=30.0)
    record = hypothesis.record
    z, _ = modes(hypothesis, white, hypothesis.z_of({"T_L": 0.3, "K_L": 1.0})[None])
    fit = finish(hypothesis, white, z[0])
    assert fit.profile is not None
    assert fit.grade_rms is not None
    values = {k: float(v) for k, v in hypothesis.values(z).items()}
    found = plant([RoadGrade(fit.grade_rms, profile=torch.as_tensor(fit.profile / fit.grade_rms))], **values)
    response = found.response(record.drives[0])
    shown = np.stack([record.at_counted_rows([response.accel_measured]), record.at_counted_rows([response.speed])])
    # after the start, at which the actuator makes up for the slope; what that adds to the speed is its offset
    apart = (record.measured - shown - fit.errors)[:, 80:]
    assert np.abs(apart[0]).max() < 1e-3
    assert np.ptp(apart[1]) < 0.02
    left = float((white(fit.errors) ** 2).mean())
    assert left == pytest.approx(1.0, abs=0.25)


def test_slope_columns_are_the_rollouts_derivatives(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    hypothesis, _ = _case(plant(), "road_grade", rng)
    columns, record = hypothesis.grade_columns, hypothesis.record
    assert columns is not None
    drive: SimulatorInput = record.drives[0]
    flat = plant().response(drive)
    for k in (0, len(columns) // 2, len(columns) - 1):
        unit = torch.zeros(len(columns), dtype=torch.float64)
        unit[k] = 1e-4
        response = plant([RoadGrade(1.0, profile=unit)]).response(drive)
        # at the start the actuator makes up for the slope, so that the first acceleration is the measured one
        late = record.time[record.source] > 8
        accel = record.at_counted_rows([response.accel_measured - flat.accel_measured])[late, 0]
        speed = record.at_counted_rows([response.speed - flat.speed])[late, 0]
        own = 1e-4 * columns[k][:, late, 0]
        np.testing.assert_allclose(accel, own[0], atol=1e-9)
        np.testing.assert_allclose(speed - speed[0], own[1] - own[1, 0], atol=1e-9)


def test_a_slope_over_several_drives(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    logs = [log_of(_hills(rng), seconds=s, name=f"{s} s", rng=rng, speed0=30.0) for s in (20.0, 30.0)]
    record = Record.of(logs)
    hypothesis, white = Hypothesis.named(record, "road_grade", plant()), WhiteningFilter(record, QUIET)
    fit = finish(hypothesis, white, hypothesis.z_of({"T_L": 0.3, "K_L": 1.0}))
    assert np.isfinite(fit.log_evidence)


@pytest.mark.statistical
def test_a_gap_in_a_drive_with_a_slope(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    log = log_of(_hills(rng), seconds=42.0, rng=rng, speed0=30.0)
    record = Record.of(replace(log, engaged=(log.time < 20) | (log.time > 24)))
    hypothesis, white = Hypothesis.named(record, "road_grade", plant()), WhiteningFilter(record, QUIET)
    fit = finish(hypothesis, white, hypothesis.z_of({"T_L": 0.3, "K_L": 1.0}))
    assert np.isfinite(fit.log_evidence)
    assert float((white(fit.errors) ** 2).mean()) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_what_a_slope_does_is_the_sum_of_its_columns(rate_hz: int, fresh_seed: int) -> None:
    """Over two drives, one of them with a gap, of hills of their own."""
    rng = np.random.default_rng(fresh_seed)
    first, second = (log_of(seconds=s, rate_hz=rate_hz, name=f"{s} s", rng=rng, speed0=30.0) for s in (20.0, 30.0))
    record = Record.of([first, replace(second, engaged=(second.time < 12) | (second.time > 15))])
    assert len(record.starts) == 3
    hypothesis = Hypothesis.named(record, "road_grade+sensor_bias", plant())
    columns, means = hypothesis.grade_columns, hypothesis.grade_means
    assert columns is not None
    assert means is not None
    white = WhiteningFilter(record, QUIET)
    for c in 0.02 * rng.standard_normal((3, len(columns))):
        whole = np.einsum("k,kwrg->wrg", c, columns)
        np.testing.assert_allclose(hypothesis.grade_response(c), whole, atol=1e-12)
        # of the means, by positions of averaged speeds: white errors of some 30 apart by some 0.2
        mean = white(whole.mean(-1, keepdims=True))
        apart = white(np.einsum("k,kwrg->wrg", c, means)) - mean
        assert np.linalg.norm(apart) <= (0.0 if rate_hz == 20 else 0.04) * np.linalg.norm(mean) + 1e-9
    assert means.shape == (*columns.shape[:-1], 1)
    # another hypothesis of the same record has the same slope, one without a slope none
    assert Hypothesis.named(record, "dead_time+road_grade", plant()).grade_means is means
    assert Hypothesis.named(record, "sensor_bias", plant()).grade_means is None
    assert Hypothesis.named(record, "sensor_bias", plant()).grade_columns is None
    # coefficients of the one drive do nothing in the other
    knots = _road(record.drives[0]).knots
    others = record.stretch > 0
    assert not columns[:knots][:, :, others].any()
    assert not columns[knots:][:, :, ~others].any()
    assert columns[knots:][:, :, others].any()


def _road(drive: SimulatorInput) -> RoadGrade:
    return RoadGrade().prepared(drive.time, drive.speed, drive.position)


def _row(drive: SimulatorInput) -> EffectContext:
    one = torch.tensor(1.0, dtype=torch.float64)
    return EffectContext(drive.time, drive.dt, drive.speed, drive.position, one, one)


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_the_size_along_the_road_is_that_of_the_slope_itself(rate_hz: int, fresh_seed: int) -> None:
    """By what the effect does at every row of both drives."""
    rng = np.random.default_rng(fresh_seed)
    logs = [log_of(seconds=s, rate_hz=rate_hz, name=f"{s} s", rng=rng, speed0=30.0) for s in (20.0, 30.0)]
    record = Record.of(logs)
    hypothesis = Hypothesis.named(record, "road_grade", plant())
    knots = [_road(drive).knots for drive in record.drives]
    coefficients = 0.02 * rng.standard_normal((4, sum(knots)))
    told = hypothesis.grade_along(coefficients)
    assert told.shape == (4,)
    for c, rms in zip(coefficients, told, strict=True):
        slopes = []
        for drive, own in zip(record.drives, np.split(c, knots[:1]), strict=True):
            push = RoadGrade(1.0, torch.as_tensor(own)).apply(torch.zeros_like(drive.time), _row(drive)).numpy()
            slopes.append(np.tan(np.arcsin(push / -GRAVITY)))
        assert rms == pytest.approx(np.sqrt((np.concatenate(slopes) ** 2).mean()), rel=1e-9 if rate_hz == 20 else 1e-2)
