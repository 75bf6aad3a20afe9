"""Units and signs in the stream: what contradicts itself is refused and not believed; weak and slow cars are not."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import BeliefStream, SamplerSettings
from avtorch.inference.latent import LatentForm
from avtorch.inference.stream_units import StreamUnits
from avtorch.io import Log
from avtorch.vehicle.glvd import glvd_jerk, glvd_rollout

F64 = torch.float64
SMALL = SamplerSettings(chains=8, draws=16, burn_in=4)
GRAVITY = 9.80665
Columns = dict[str, Tensor]


def drive(
    seed: int,
    *,
    vehicles: int = 1,
    seconds: float = 40.0,
    lag: tuple[float, float] = (0.3, 1.0),
    gain: tuple[float, float] = (0.6, 1.0),
    size: tuple[float, float] = (1.0, 1.0),
    noise: float = 0.1,
    dead: float = 0.0,
) -> tuple[Tensor, Columns]:
    """Time ``(time,)`` and columns ``(vehicle, time)`` at 100 Hz, behind three sines of 0.05 to 1 Hz.

    The largest sine takes 8 s or more: from 2.5 s, a third of a period, an inverted car may be one that is so late.
    """
    g = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> Tensor:
        return low * (high / low) ** torch.rand(vehicles, 1, generator=g, dtype=F64)

    time = 0.01 * torch.arange(round(100 * seconds), dtype=F64)
    T, K, amplitude = between(*lag), between(*gain), between(*size)
    u = torch.zeros(vehicles, len(time), dtype=F64)
    for share, band in ((1.0, (0.05, 0.12)), (0.6, (0.12, 0.4)), (0.3, (0.4, 1.0))):
        u += share * amplitude * torch.sin(2 * math.pi * (between(*band) * time + between(0.1, 1.0)))
    acts = torch.cat([torch.zeros(vehicles, round(100 * dead), dtype=F64), u], -1)[:, : len(time)]
    later = glvd_rollout(torch.zeros(vehicles, dtype=F64), acts, T[:, 0], K[:, 0], 0.01)
    a = torch.cat([torch.zeros(vehicles, 1, dtype=F64), later[:, :-1]], -1)

    def noisy(x: Tensor, sd: float) -> Tensor:
        return x + sd * torch.randn(x.shape, generator=g, dtype=F64)

    speed = 15 + 0.01 * a.cumsum(-1)
    jerk = noisy(glvd_jerk(a, acts, T, K), noise)
    return time, {"accel_cmd": u, "accel": noisy(a, 0.02), "jerk": jerk, "speed": noisy(speed, 0.02)}


def changed(columns: Columns, **factors: float) -> Columns:
    return {name: factors.get(name, 1.0) * x for name, x in columns.items()}


def watch(columns: tuple[str, ...], time: Tensor, given: Columns, usable: Tensor | None = None) -> None:
    """Windows of 2 s, without any sampling."""
    units = StreamUnits(columns, len(given["accel_cmd"]))
    mask = torch.ones_like(given["accel_cmd"], dtype=torch.bool) if usable is None else usable
    for k in range(0, len(time), 200):
        part = slice(k, k + 200)
        rows = {"time": time[part], "usable": mask[:, part], **{name: given[name][:, part] for name in columns}}
        units.take(rows, {})


JERK = ("accel_cmd", "accel", "jerk")
BOTH, ACCEL, SPEED = ("accel_cmd", "accel", "speed"), ("accel_cmd", "accel"), ("accel_cmd", "speed")
HARMS = [
    (JERK, {"accel_cmd": -1.0}, "'accel' and 'accel_cmd'.*wrong sign"),
    (BOTH, {"accel_cmd": -1.0}, "'speed' and 'accel_cmd'.*wrong sign"),
    (ACCEL, {"accel_cmd": -1.0}, "'accel' and 'accel_cmd'.*wrong sign"),
    (SPEED, {"accel_cmd": -1.0}, "'speed' and 'accel_cmd'.*wrong sign"),
    (JERK, {"accel": -1.0}, "'accel' and 'jerk'.*wrong sign"),
    (JERK, {"accel": -1.0, "jerk": -1.0}, "'accel' and 'accel_cmd'.*wrong sign"),
    (BOTH, {"accel": -1.0}, "'speed' and 'accel'.*wrong sign"),
    (JERK, {"accel": 1 / GRAVITY}, "'accel' and 'jerk'.*accel is in g"),
    (BOTH, {"accel": 1 / GRAVITY}, "'speed' and 'accel'.*accel is in g"),
    (BOTH, {"speed": 3.6}, "'speed' and 'accel'.*speed is in km/h"),
    (JERK, {"accel_cmd": 1 / GRAVITY}, "'accel' and 'accel_cmd'.*accel_cmd is in g"),
]


@pytest.mark.parametrize(("columns", "factors", "message"), HARMS)
def test_a_wrong_unit_or_sign_is_named(columns, factors, message, fresh_seed):
    time, given = drive(fresh_seed)
    watch(columns, time, given)
    with pytest.raises(InputError, match=rf"^stream: columns {message}") as caught:
        watch(columns, time, changed(given, **factors))
    assert "\n" not in str(caught.value)


def test_swapped_command_and_acceleration_are_named_where_jerk_is_measured(fresh_seed):
    time, given = drive(fresh_seed)
    with pytest.raises(InputError, match=r"'accel' and 'accel_cmd'.* swapped"):
        watch(JERK, time, {**given, "accel": given["accel_cmd"], "accel_cmd": given["accel"]})


@pytest.mark.parametrize("dead", [0.0, 0.3])
@pytest.mark.parametrize("columns", [JERK, BOTH, ACCEL, SPEED])
def test_weak_slow_and_hardly_moving_cars_are_not_refused(columns, dead, fresh_seed):
    """A hundred cars: lags of 0.1 to 2 s, gains of 0.4 to 1.1, commands of 0.03 to 3 m/s^2, 60 s each."""
    wide = {"lag": (0.1, 2.0), "gain": (0.4, 1.1), "size": (0.03, 3.0)}
    watch(columns, *drive(fresh_seed, vehicles=100, seconds=60.0, noise=0.3, dead=dead, **wide))


def test_the_vehicle_is_named_and_what_is_masked_is_not_looked_at(fresh_seed):
    # the stretch with the turn may be inconclusive; the one after it is not
    time, given = drive(fresh_seed, vehicles=3, seconds=80.0)
    flipped = given["accel_cmd"].clone()
    flipped[1, 1000:] *= -1
    bad = {**given, "accel_cmd": flipped}
    with pytest.raises(InputError, match=r"of vehicle 1, [1-9][0-9.]+ to "):
        watch(JERK, time, bad)
    usable = torch.ones_like(flipped, dtype=torch.bool)
    usable[1, 1000:] = False
    bad = {name: torch.where(usable, x, torch.nan) for name, x in bad.items()}
    watch(JERK, time, bad, usable)


def weaving(dead: float, seed: int, *, seconds: float = 40.0) -> tuple[Tensor, Columns]:
    """A sine of 4 s as the command, which a car with a lag of 0.3 s follows after `dead` [s]; columns as `drive`'s."""
    time = 0.01 * torch.arange(round(100 * seconds), dtype=F64)
    u = torch.sin(2 * math.pi * time / 4.0)[None]
    acts = torch.cat([torch.zeros(1, round(100 * dead), dtype=F64), u], -1)[:, : len(time)]
    a = glvd_rollout(torch.zeros(1, dtype=F64), acts, torch.tensor([0.3]), torch.tensor([0.9]), 0.01)
    noise = 0.02 * torch.randn(2, *a.shape, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return time, {"accel_cmd": u, "accel": a + noise[0], "speed": 15 + 0.01 * a.cumsum(-1) + noise[1]}


@pytest.mark.parametrize("columns", [BOTH, ACCEL, SPEED])
def test_a_late_car_is_not_taken_for_one_of_the_wrong_sign(columns, fresh_seed):
    """1.7 s of dead time and the lag are half a period: what it does now is the opposite of what it is asked now."""
    watch(columns, *weaving(1.7, fresh_seed))
    # 10 s are too few to know how a car 2.5 s late would compare
    watch(columns, *weaving(1.7, fresh_seed, seconds=12.0))


def test_a_jump_of_the_clock_costs_nothing(fresh_seed):
    """To Unix time and on: a stretch ends at a break, and no table of a billion seconds is made."""
    time, given = drive(fresh_seed, seconds=30.0)
    time = torch.where(time < 5.0, time, time + 1.7e9)
    watch(BOTH, time, given)
    with pytest.raises(InputError, match=r"wrong sign"):
        watch(BOTH, time, changed(given, accel_cmd=-1.0))


def stream(**options) -> BeliefStream:
    return BeliefStream(**{"settings": SMALL, "kept": 50, "seed": 4, **options})


@pytest.mark.slow
def test_a_sign_flip_is_not_believed(fresh_seed):
    """Before it was: T_L 2.94 s and K_L 0.06. The stream is left as it was, and goes on with the right sign.

    A command of the wrong sign is refused after 19 s: before, it may be a car 2.5 s late.
    """
    time, given = drive(fresh_seed, seconds=24.0)
    found, fresh = stream(), stream()
    with pytest.raises(InputError, match=r"wrong sign.* no estimate from this time is kept"):
        found.feed(time, changed(given, accel_cmd=-1.0))
    assert found.inference.belief.mean.equal(fresh.inference.belief.mean)
    windows, expected = found.feed(time, given), fresh.feed(time, given)
    assert len(windows) == len(expected) == 11
    assert all(a.belief.draws.equal(b.belief.draws) for a, b in zip(windows, expected, strict=True))
    # check_units=False overrides the check
    assert len(stream(check_units=False).feed(time, changed(given, accel_cmd=-1.0))) == 11


@pytest.mark.slow
def test_cuts_and_saving_change_nothing(fresh_seed):
    """The same refusal, word for word, and the prior's belief after it, however the rows come."""
    time, given = drive(fresh_seed, seconds=24.0)
    given = changed(given, accel_cmd=-1.0)
    prior = stream().inference.belief.draws

    def refusal(size: int, save: bool) -> str:
        found = stream()
        for k in range(0, 2400, size):
            try:
                found.feed(time[k : k + size], {name: x[:, k : k + size] for name, x in given.items()})
            except InputError as refused:
                assert found.inference.belief.draws.equal(prior)
                return str(refused)
            if save:
                state = found.state_dict()
                found = stream(seed=99)
                found.load_state_dict(state)
        return "none"

    said = {refusal(size, save) for size, save in ((2400, False), (37, False), (400, True))}
    assert len(said) == 1
    assert said.pop().startswith("stream: columns 'accel' and 'accel_cmd'")


def test_what_was_found_right_is_kept(fresh_seed):
    """The sign turns in mid drive, as after work on the car: what was learnt before its stretch stays."""
    time, given = drive(fresh_seed, seconds=80.0)
    flipped = given["accel_cmd"].clone()
    flipped[:, 2000:] *= -1
    found = stream()
    given = {**given, "accel_cmd": flipped}
    windows, refused = [], ""
    for k in range(0, 8000, 100):
        try:
            windows += found.feed(time[k : k + 100], {name: x[:, k : k + 100] for name, x in given.items()})
        except InputError as caught:
            refused = str(caught)
            break
    assert "wrong sign" in refused
    kept = [w for w in windows if found.inference.belief.draws.equal(w.belief.draws)]
    begun = float(refused.split(" s: ")[0].split(", ")[-1].split(" to ")[0])
    assert begun > 9.0
    assert any(w.end_s == pytest.approx(begun) for w in kept)
    # a later window without excitation teaches nothing, so its draws are the same
    assert not any(bool(w.belief.excited.any()) for w in kept if w.end_s > begun + 1e-6)


def test_the_memory_of_a_stretch_is_bounded():
    found = StreamUnits(JERK, 1)
    time = 0.01 * torch.arange(200, dtype=F64)
    zero = torch.zeros(1, 200, dtype=F64)
    kept = []
    for k in range(120):
        usable = torch.ones(1, 200, dtype=torch.bool)
        found.take({"time": time + 2.0 * k, "usable": usable, **dict.fromkeys(JERK, zero)}, {})
        kept.append(found.rows["time"].shape[-1] if found.rows else 0)
    assert max(kept) < 40 / 0.01 + 250


@pytest.mark.parametrize("lap", [1, 2, 3])
def test_the_genesis_is_believed_and_its_command_turned_round_is_not(lap, data_dir):
    log = Log.read(data_dir / "genesis" / f"lap{lap}.csv")
    assert log.accel_cmd is not None
    assert log.speed is not None
    part = max(log.segments(), key=lambda rows: rows.stop - rows.start)
    time = torch.from_numpy(log.time[part])
    usable = torch.from_numpy(log.usable[part])[None]
    given = {name: torch.from_numpy(np.asarray(getattr(log, name))[part])[None] for name in SPEED}
    watch(SPEED, time, given, usable)
    with pytest.raises(InputError, match=r"wrong sign"):
        watch(SPEED, time, changed(given, accel_cmd=-1.0), usable)
    assert LatentForm(accel=False, speed=True).columns == SPEED
