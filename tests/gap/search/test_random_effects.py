"""A user's random effect, one for each kind of change of the noise: named where it acts, and only there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import avtorch
from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap import (
    DeadTime,
    Effect,
    EffectContext,
    GapPlant,
    Gust,
    NoiseChange,
    Outliers,
    Parameter,
    SimulatorInput,
    plant,
)
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.steady_kalman import error_dynamics
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.command_errors import command_error_gains
from avtorch.gap.search.row_response import image_of_row
from avtorch.io import Log
from tests.gap.records import QUIET, covariance, drawn_errors


@dataclass(frozen=True)
class RoadRoughness(Effect):
    """A force of its own time constant."""

    sd_mps2: Any = 0.5
    time_s: Any = 0.08

    name, place, memory, random = "road_roughness", "body", True, True
    meaning, equation = "the road shakes the car", "df = -f / time dt + sd sqrt(2 / time) dW"
    parameters = (
        Parameter("sd_mps2", "m/s²", 0.0, 0.1, 1.0),
        Parameter("time_s", "s", None, 0.05, 0.5),
    )

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Tensor, Any]:
        if row.normal is None:
            return torch.zeros_like(x), None
        keep = torch.zeros(()) if state is None else torch.exp(-row.dt / self.time_s)
        force = (0.0 if state is None else keep * state) + self.sd_mps2 * torch.sqrt(1 - keep**2) * row.normal
        return force, force

    def noise(self, u: Tensor) -> NoiseChange:
        return NoiseChange(force_sd=self.sd_mps2, force_time=self.time_s)


@dataclass(frozen=True)
class Crosstalk(Effect):
    """Heavy tails of the accelerometer."""

    share: Any = 0.05
    size: Any = 6.0
    noise_sd: float = 0.05

    name, place, random = "crosstalk", "sensor", True
    meaning, equation = "another signal breaks into the accelerometer's", "a + size sigma e, with probability share"
    parameters = (
        Parameter("share", "-", 0.0, 0.01, 0.2, "unit"),
        Parameter("size", "sigma", None, 3.0, 12.0),
    )

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        if row.normal is None:
            return x
        level = torch.special.ndtr(row.normal)
        hit = level < self.share
        error = torch.special.ndtri(torch.where(hit, level / self.share, 0.5).clamp(1e-9, 1 - 1e-9))
        return x + torch.where(hit, self.size * self.noise_sd * error, 0.0)

    def noise(self, u: Tensor) -> NoiseChange:
        return NoiseChange(tail_fraction=self.share, tail_scale=self.size)


@dataclass(frozen=True)
class ValveJitter(Effect):
    """Errors of the command in proportion to it; declared to need the speed."""

    share: Any = 0.4

    name, place, random, needs_speed = "valve_jitter", "command", True, True
    meaning, equation = "the valve hits the command only roughly", "u (1 + share e)"
    parameters = (Parameter("share", "-", 0.0, 0.05, 1.0),)

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return x if row.normal is None else x * (1 + self.share * row.normal)

    def noise(self, u: Tensor) -> NoiseChange:
        return NoiseChange(command_variance=(torch.as_tensor(self.share) * u) ** 2)


ALL = (RoadRoughness, Crosstalk, ValveJitter)


def _log(effects: list[Effect], seed: int, *, seconds: float = 50.0, rate: int = 20) -> Log:
    """Steps twice a second, the random effects drawn."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    command = np.repeat(rng.uniform(-1.5, 1.5, round(2 * seconds)), rate // 2)
    drive = SimulatorInput(
        torch.as_tensor(time), torch.as_tensor(command), torch.full((len(time),), 20.0).double(), 0.0
    )
    seen = plant(effects).response(drive, generator=torch.Generator().manual_seed(seed))
    accel, speed = drawn_errors(QUIET, len(time), 1 / rate, rng) + np.stack([seen.accel_measured, seen.speed])
    return Log.from_arrays(time=time, accel_cmd=command, accel=accel, speed=speed)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("kind", ALL)
def test_it_is_named_where_it_acts(kind: type[Effect], rotating_seed: int) -> None:
    found = avtorch.diagnose(_log([kind()], rotating_seed), effects=["dead_time", kind], pairs=False)
    evidence = {c.name: c.log_evidence for c in found.candidates if c.log_evidence is not None}
    # none is some 10 to 150 nats behind, a delay does nothing of the kind
    assert max(evidence, key=lambda name: evidence[name]) == kind.name
    # held-out blocks do not see a random effect, so where the likelihood answers `unknown` they answer none
    assert found.verdict.name in (kind.name, "unknown", "none")
    told = next(c for c in found.candidates if c.name == kind.name)
    if found.verdict.name == kind.name:
        assert told.probability > 10 * found.probability("none")
    first = kind.parameters[0].name
    size = told.parameters[first]
    # glitches of a small draw pass for noise, so tails are found too seldom, as by the built-in search
    assert 0.4 < size.mean / float(getattr(kind(), first)) < 1.5
    if found.plant is not None:
        again = GapPlant.from_toml(found.plant.to_toml(), effects=[kind])
        assert [e.name for e in again.effects] == [kind.name]


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("kind", ALL)
def test_it_is_not_named_where_it_does_not(kind: type[Effect], rotating_seed: int) -> None:
    found = avtorch.diagnose(_log([], rotating_seed), effects=["dead_time", kind], pairs=False)
    told = {c.name: c.log_evidence for c in found.candidates if c.log_evidence is not None}
    # a likelihood ratio against what is true exceeds x nats in exp(-x) of all drives
    assert told.get(kind.name, 0.0) < 12
    assert found.scope is not None
    assert kind.name in found.scope.scored


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
def test_a_pair_with_the_leading_effect(kind: type[Effect], rotating_seed: int) -> None:
    log = _log([DeadTime(0.25), kind()], rotating_seed)
    found = avtorch.diagnose(log, effects=["dead_time", kind])
    pair = "+".join(sorted(["dead_time", kind.name]))
    evidence = {c.name: c.log_evidence for c in found.candidates if c.log_evidence is not None}
    assert max(evidence, key=lambda name: evidence[name]) == pair
    told = next(c for c in found.candidates if c.name == pair).parameters
    assert told["dead_time.delay_s"].mean == pytest.approx(0.25, abs=0.03)
    assert f"{kind.name}.{kind.parameters[0].name}" in told


@pytest.mark.slow
@pytest.mark.statistical
def test_one_derived_from_a_built_in_is_a_users_own(rotating_seed: int) -> None:
    """It has the built-in's class behind it, not its name: it must not be searched, and reported, under that."""

    class Wobble(Gust):
        name = "wobble"

    log = _log([Wobble(0.3, 2.0)], rotating_seed)
    found = avtorch.diagnose(log, effects=[Wobble, "dead_time"], pairs=False)
    told = {c.name: c for c in found.candidates}
    built_in = avtorch.diagnose(log, effects=["gust", "dead_time"], pairs=False)
    # as much as the built-in's own search finds, which counts an onset, too; the draw decides how much (0 to 60 nats)
    gust = next(c.log_evidence for c in built_in.candidates if c.name == "gust")
    assert told["wobble"].log_evidence == pytest.approx(gust, abs=4.0)
    assert set(told["wobble"].parameters) == {"sd_mps2", "time_constant_s"}
    assert "gust" not in told


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (None, "found nothing"),
        (NoiseChange(), "found nothing"),
        (NoiseChange(force_sd=0.1), "found force_sd, needs"),
        (NoiseChange(force_sd=0.1, force_time=1.0, tail_fraction=0.1, tail_scale=5.0), "and tail_scale, needs"),
        (NoiseChange(force_sd=float("nan"), force_time=1.0), "force_sd nan, needs one finite number"),
        (NoiseChange(force_sd=0.1, force_time=torch.zeros(())), "needs one finite number above 0"),
        (NoiseChange(tail_fraction=torch.ones(3), tail_scale=5.0), "tail_fraction"),
        (NoiseChange(command_variance=torch.tensor(-1.0)), "command_variance below 0"),
    ],
)
def test_a_noise_without_a_usable_change_is_refused_in_a_line(change: NoiseChange | None, said: str) -> None:
    class Mute(Outliers):
        name = "mute"

        def noise(self, u: Tensor) -> NoiseChange:
            return change  # type: ignore[return-value]

    with pytest.raises(InputError, match=rf"^mute\.noise: .*{said}") as raised:
        avtorch.diagnose(_log([], 1, seconds=20.0), effects=[Mute], pairs=False)
    assert "\n" not in str(raised.value)


def test_a_further_force_has_its_own_state() -> None:
    """The filter's steps against the covariance of both processes and their integral, by another formula."""
    noise, dt = NoiseModel(process_sd=1e-6, force_sd=0.2, force_time=1.5, more_sd=0.3, more_time=0.4), 0.05
    move, driven = error_dynamics(noise, dt)
    at = np.diag([0.0, 1e-12, 0.2**2, 0.3**2])
    for _ in range(7):
        at = move @ at @ move.T + driven
    time = np.array([0.0, 7 * dt])
    each = [covariance(sd, lag, time) for sd, lag in ((0.2, 1.5), (0.3, 0.4))]
    assert at[0, 0] == pytest.approx(sum(x[3, 3] for x in each), rel=1e-6)
    assert [at[0, 2], at[0, 3]] == pytest.approx([x[1, 3] for x in each], rel=1e-6)
    # and behind a late sensor the same motion
    late, more = error_dynamics(noise.replaced(sensor_lag=0.1), dt)
    assert late[:4, :4] == pytest.approx(move, abs=1e-9)
    assert more[:4, :4] == pytest.approx(driven, abs=1e-9)


def test_errors_of_the_command_against_the_whole_covariance() -> None:
    """The chunked filter against the density of all white errors at once."""
    log = _log([], 2, seconds=14.0, rate=20)
    record = Record.of([log], rate_hz=1e9)
    noise = NoiseModel(process_sd=0.05, process_time=0.3)
    white = WhiteningFilter(record, noise)
    rng = np.random.default_rng(4)
    errors = 0.05 * rng.standard_normal((2, record.rows, 1))
    variance: FloatArray = rng.uniform(0.0, 0.4, record.rows)
    gained = command_error_gains(white, errors, variance, 0.3, 1.0)
    image = image_of_row(white, 0.3, 1.0)
    rows, length = record.rows, image.shape[1]
    columns = np.zeros((rows, 2, rows))  # white image of one unit of error in each row's command
    for k in range(rows):
        reach = min(length, rows - k)
        columns[k, :, k : k + reach] = image[:, :reach]
    flat = columns.reshape(rows, -1)
    dense = np.eye(2 * rows) + flat.T @ (variance[:, None] * flat)
    e = white(errors)[..., 0].reshape(-1)
    expected = 0.5 * (e @ e - e @ np.linalg.solve(dense, e) - np.linalg.slogdet(dense)[1])
    # the few states of the image, and chunks that begin with a warm-up, cost some thousandths
    assert gained.sum() == pytest.approx(expected, rel=0.01)
    assert np.abs(command_error_gains(white, errors, 0 * variance, 0.3, 1.0)).max() < 1e-12
