"""The screening of a hypothesis: its form, its starts, and whether it has an onset."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.blindtest import Car, simulate
from avtorch.blindtest.drives import Recorded
from avtorch.gap import Saturation
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search import screening
from avtorch.gap.search.initial_values import start_points
from avtorch.gap.search.screening import Screened, screen
from avtorch.gap.simulator.plant import plant
from avtorch.io import Log
from tests.gap.records import QUIET, command_over, log_of

NOISE = NoiseModel(process_sd=0.03, process_time=0.4, force_sd=0.004, accel_sd=0.05, speed_sd=0.02)
CASES = {
    "dead_time": ("delay_s", 0.3),
    "sensor_bias": ("bias_mps2", 0.2),
    "constant_resistance": ("resistance_mps2", 0.25),
    "rate_limit": ("jerk_max_mps3", 1.0),
}


def _drive(name: str, parameters: dict[str, float], onset: float, seed: int, seconds: float = 60.0) -> Record:
    """A drive of the reference vehicle, which shares no code with this."""
    command = command_over(np.arange(round(seconds * 20)) / 20)
    run = simulate(
        Car(),
        Recorded(command, start_speed=25.0),
        seconds=seconds,
        rate_hz=20,
        effects={name: parameters},
        onset=onset,
        seed=seed,
    )
    return Record.of(Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed))


def _begin(record: Record, white: WhiteningFilter, name: str) -> tuple[Hypothesis, FloatArray, float]:
    """The hypothesis, its starts as a search makes them, and what the bare baseline comes to."""
    none, hypothesis = (Hypothesis.named(record, n, plant()) for n in ("none", name))
    z, value = modes(none, white, none.z_of({"T_L": 0.3, "K_L": 1.0})[None], coarse=True)
    return hypothesis, start_points(hypothesis, {k: float(v) for k, v in none.values(z).items()}), float(value[0])


def _at(look: Screened) -> float:
    record = look.hypothesis.record
    assert look.onset is not None
    return float(record.time[record.source[look.onset]])


@pytest.mark.statistical
@pytest.mark.parametrize("name", CASES)
def test_an_onset_late_in_the_drive_is_found_though_the_whole_fit_is_diluted(name: str, rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    at = float(np.round(rng.uniform(34, 46), 1))
    key, size = CASES[name]
    record = _drive(name, {key: size}, at, int(rng.integers(2**31)))
    white = WhiteningFilter(record, NOISE)
    hypothesis, begin, floor = _begin(record, white, name)
    whole, late = screen(hypothesis, white, begin, floor=floor)
    assert whole.onset is None
    told = [float(hypothesis.values(look.z[None])[f"{name}.{key}"]) for look in (whole, late)]
    # an effect of some 10 nats a second over a quarter of the drive or more; the command moves every 3.5 s at the
    # latest
    assert abs(_at(late) - at) < 3.6
    assert late.value > whole.value + 60
    assert told[1] == pytest.approx(size, rel=0.25)  # five standard deviations of the worst of them
    assert abs(told[0] / size - 1) > 0.3  # of the whole drive, the effect of its last quarter is a fraction


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["dead_time", "rate_limit"])
def test_starts_show_an_onset_that_the_whole_fit_misses(
    name: str, rotating_seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the fit to the whole drive ends at zero effect, no row contains information about an onset."""
    rng = np.random.default_rng(rotating_seed)
    at = float(np.round(rng.uniform(34, 46), 1))
    key, size = CASES[name]
    record = _drive(name, {key: size}, at, int(rng.integers(2**31)))
    white = WhiteningFilter(record, NOISE)
    hypothesis, begin, floor = _begin(record, white, name)
    told = screening.rough_onset
    asked: list[FloatArray] = []

    def nothing_of_the_whole(white: WhiteningFilter, hypothesis: Hypothesis, z: FloatArray) -> tuple[int, float]:
        asked.append(z)
        return told(white, hypothesis, z) if len(asked) > 1 else (100, -1.0)

    monkeypatch.setattr(screening, "rough_onset", nothing_of_the_whole)
    whole, late = screen(hypothesis, white, begin, floor=floor)
    np.testing.assert_array_equal(asked[0], whole.z)
    assert abs(_at(late) - at) < 3.6
    assert late.value > whole.value + 60


@pytest.mark.statistical
@pytest.mark.parametrize("name", CASES)
def test_no_onset_is_offered_where_the_effect_is_there_from_the_start(name: str, rotating_seed: int) -> None:
    key, size = CASES[name]
    record = _drive(name, {key: size}, 0.0, rotating_seed)
    white = WhiteningFilter(record, NOISE)
    hypothesis, begin, floor = _begin(record, white, name)
    # the first seconds without it cost a hundred nats
    (only,) = screen(hypothesis, white, begin, floor=floor)
    assert only.onset is None
    assert only.value > floor + 100
    assert float(hypothesis.values(only.z[None])[f"{name}.{key}"]) == pytest.approx(size, rel=0.1)


def test_none_is_looked_for_unless_asked(fresh_seed: int) -> None:
    record = _drive("dead_time", {"delay_s": 0.3}, 40.0, fresh_seed)
    white = WhiteningFilter(record, NOISE)
    hypothesis, begin, floor = _begin(record, white, "dead_time")
    (only,) = screen(hypothesis, white, begin, floor=floor, onsets=False)
    both = screen(hypothesis, white, begin, floor=floor)
    assert only.onset is None
    np.testing.assert_array_equal(only.z, both[0].z)
    assert only.value == both[0].value


def _faint(size: float) -> tuple[Hypothesis, WhiteningFilter, FloatArray, float]:
    """A bias of `size` [m/s²] from the middle of a drive on, without noise: the result does not depend on chance."""
    log = log_of(seconds=50.0, noise=None, speed0=25.0)
    accel = log.accel + size * (log.time > 26)
    record = Record.of(Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=accel, speed=log.speed))
    white = WhiteningFilter(record, QUIET)
    hypothesis, _, floor = _begin(record, white, "sensor_bias")
    return hypothesis, white, hypothesis.z_of({"T_L": 0.3, "K_L": 1.0, "sensor_bias.bias_mps2": 0.0})[None], floor


def test_a_faint_onset_counts_where_the_effect_shows_over_the_whole_drive() -> None:
    hypothesis, white, begin, floor = _faint(0.007)
    (whole, late) = screen(hypothesis, white, begin)  # no floor given: anything shows
    gain = late.value - whole.value
    assert 0.3 < gain < 4.0  # with so small a gain an onset is screened only where the effect exists
    assert abs(_at(late) - 26) < 1.0
    assert [look.onset for look in screen(hypothesis, white, begin, floor=whole.value - 5)] == [None, late.onset]
    assert [look.onset for look in screen(hypothesis, white, begin, floor=whole.value - 3)] == [None]
    assert whole.value < floor + 4
    # with more of it the floor does not matter
    hypothesis, white, begin, _ = _faint(0.04)
    whole, late = screen(hypothesis, white, begin, floor=np.inf)
    assert late.value > whole.value + 10


def test_the_best_starts_are_followed_and_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    record = Record.of(log_of(plant(T_L=0.4), seconds=20.0, noise=None))
    white = WhiteningFilter(record, QUIET)
    hypothesis = Hypothesis.named(record, "dead_time", plant())
    delays = (0.5, 0.02, 0.3, 0.1)
    begin = np.stack([hypothesis.z_of({"T_L": 0.4, "K_L": 1.0, "dead_time.delay_s": d}) for d in delays])
    followed: list[FloatArray] = []

    def kept(
        hypothesis: Hypothesis, white: WhiteningFilter, z: FloatArray, **options: object
    ) -> tuple[FloatArray, FloatArray]:
        followed.append(z)
        return modes(hypothesis, white, z, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(screening, "modes", kept)
    best = []
    for keep in (1, 2, 4):
        followed.clear()
        (only,) = screen(hypothesis, white, begin, onsets=False, keep=keep)
        best.append(only.value)
        # a car without delay: the shorter, the better
        np.testing.assert_array_equal(followed[0], begin[[1, 3, 2, 0][:keep]])
    assert best == sorted(best)


@pytest.mark.parametrize("limits", [(0.5, -0.6), (0.79, -0.88), (0.54, -0.64)])
def test_limits_on_both_sides_are_found_from_the_starts(limits: tuple[float, float]) -> None:
    """The bare fit, where the starts begin, has taken the gain for what both limits do to it."""
    car = plant([Saturation(*limits)], T_L=0.4)
    record = Record.of(log_of(car, seconds=40.0, noise=None, speed0=25.0))
    white = WhiteningFilter(record, QUIET)
    hypothesis, begin, floor = _begin(record, white, "saturation")
    truth = hypothesis.z_of({k: float(v) for k, v in car.values().items()})
    top = float(modes(hypothesis, white, truth[None], coarse=True)[1][0])
    assert top > floor + 100
    (found,) = screen(hypothesis, white, begin, onsets=False, floor=floor)
    assert found.value > top - 2


def test_whole_and_late_are_scored_by_the_same_likelihood(fresh_seed: int) -> None:
    """The value of a screening is the joint density of its rollout, spliced where it has an onset."""
    rng = np.random.default_rng(fresh_seed)
    record = _drive("constant_resistance", {"resistance_mps2": 0.25}, 36.0, int(rng.integers(2**31)))
    white = WhiteningFilter(record, NOISE)
    hypothesis, begin, floor = _begin(record, white, "constant_resistance")
    for look in screen(hypothesis, white, begin, floor=floor):
        errors = hypothesis.errors(look.z[None], look.onset, coarse=True)
        exact = float(white.log_likelihood(errors)[0]) - 0.5 * float(look.z @ look.z)
        assert look.value == pytest.approx(exact, abs=1e-6)
