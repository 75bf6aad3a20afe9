"""A channel behind the other one: by a delay, by a filter, on a car's own recording; and none where none is late."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import avtorch
from avtorch import Log
from avtorch.logcheck.late_channel import BLOCK_S, LateChannel, late_channel, on_time
from tests.bars import student

RATE_HZ, FINE = 50, 4


def behind(values: np.ndarray, by: str, seconds: float) -> np.ndarray:
    if by == "delay":
        rows = round(seconds * RATE_HZ * FINE)
        return np.concatenate([np.full(rows, values[0]), values[: len(values) - rows]])
    keep = np.exp(-1 / (seconds * RATE_HZ * FINE))
    return values[0] + lfilter([1 - keep], [1, -keep], values - values[0])


def driven(seed: int, late: str = "", by: str = "delay", size: float = 0.0, seconds: float = 120.0) -> Log:
    """A car with a lag of 0.3 s, a wind, and two noisy channels."""
    rng = np.random.default_rng(seed)
    rows, dt = round(seconds * RATE_HZ * FINE), 1 / (RATE_HZ * FINE)
    u = np.repeat(rng.normal(size=round(seconds / 1.5) + 1), round(1.5 / dt))[:rows]
    wind = behind(0.1 * np.sqrt(2 / dt) * rng.normal(size=rows), "filter", 1.0)
    accel = behind(u, "filter", 0.3) + wind
    speed = 30.0 + np.concatenate([[0.0], np.cumsum(0.5 * dt * (accel[1:] + accel[:-1]))])
    channels = {"accel": accel, "speed": speed - min(speed.min() - 3.0, 0.0)}
    if late:
        channels[late] = behind(channels[late], by, size)
    read = {name: values[::FINE] for name, values in channels.items()}
    count = len(read["speed"])
    read["accel"] = read["accel"] + rng.normal(0, 0.1, count)
    read["speed"] = read["speed"] + rng.normal(0, 0.02, count)
    return Log.from_arrays(time=np.arange(count) / RATE_HZ, accel_cmd=u[::FINE], **read)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "by", "size"),
    [("accel", "delay", 0.2), ("speed", "delay", 0.1), ("accel", "filter", 0.6), ("accel", "filter", 2.5)],
)
def test_what_is_late_is_found_with_its_size(name: str, by: str, size: float, rotating_seed: int) -> None:
    found = late_channel(driven(rotating_seed, name, by, size))
    assert found is not None
    assert (found.name, found.by) == (name, by)
    blocks = 120.0 // BLOCK_S - 2  # what begins and ends the drive has none
    # a tenth besides: what is passed on is averaged over half a second, and a row is 20 ms
    assert abs(found.seconds - size) < student(blocks - 1) * found.sd + 0.1 * size
    assert found.explained > 0.8


@pytest.mark.statistical
def test_noise_and_wind_make_no_channel_late(rotating_seed: int) -> None:
    """A row of 20 ms is the most that is claimed by chance: three standard errors are no more than that."""
    for k in range(5):
        found = late_channel(driven(rotating_seed + k))
        assert found is None or (found.by == "delay" and found.seconds < 0.03), found


def test_a_delayed_channel_is_moved_by_whole_rows() -> None:
    log = driven(1, "accel", "delay", 0.2)
    moved, have = on_time(log, LateChannel("accel", "delay", 0.2, 0.01, 1.0))
    assert log.accel is not None
    assert moved.accel is not None
    assert np.array_equal(moved.accel[:-10], log.accel[10:])
    assert have[:-10].all()
    assert not have[-10:].any()
    assert moved.speed is log.speed


def test_nothing_moves_from_one_segment_into_another() -> None:
    log = driven(2, seconds=20.0)
    log = replace(log, segment=np.repeat([0, 1], 500))
    moved, have = on_time(log, LateChannel("speed", "delay", 0.1, 0.01, 1.0))
    assert log.speed is not None
    assert moved.speed is not None
    assert np.array_equal(moved.speed[:495], log.speed[5:500])
    assert (~have).nonzero()[0].tolist() == [*range(495, 500), *range(995, 1000)]


def test_a_channel_behind_a_long_filter_is_left_out() -> None:
    log = driven(3, seconds=20.0)
    assert on_time(log, LateChannel("accel", "filter", 2.5, 0.1, 1.0))[0].accel is None
    assert on_time(log, LateChannel("accel", "filter", 0.1, 0.1, 1.0))[0].accel is not None


def test_one_channel_or_no_command_tells_nothing() -> None:
    log = driven(4, "accel", "delay", 0.3, 60.0)
    assert late_channel(log) is not None
    assert [late_channel(replace(log, **{name: None})) for name in ("accel", "speed", "accel_cmd")] == [None] * 3
    assert late_channel(log[:400]) is None
    still = replace(log, accel_cmd=np.zeros(log.rows))
    assert late_channel(still) is None


def test_the_accelerometer_of_the_av21_is_behind_a_filter(data_dir: Path) -> None:
    """By other means it is dv/dt through a first-order filter of 2.5 s."""
    log = Log.read(data_dir / "indy_av21" / "Putnam_park2023_run4_2.csv")
    found = late_channel(log)
    assert found is not None
    assert (found.name, found.by) == ("accel", "filter")
    assert abs(found.seconds - 2.5) < 3 * found.sd
    assert any("slope of speed through a filter" in note for note in avtorch.check(log).recorder)


@pytest.mark.parametrize("name", ["Normal_1weight", "single_mass", "tire_set_1"])
def test_the_channels_of_the_small_cars_are_on_time(data_dir: Path, name: str) -> None:
    assert late_channel(Log.read(data_dir / "roboracer" / f"{name}.csv")) is None
