"""The torch density of a hypothesis: its value is the compiled one, its gradient that of differences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from avtorch import Log
from avtorch.gap import DeadTime, Effect, Parameter, plant
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, adopt
from avtorch.gap.engine.density import HypothesisDensity
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis, neutral_of
from avtorch.gap.engine.torch_plant import TorchPlant, not_in_torch
from avtorch.inference.density import Density, ScoredDensity
from tests.gap.engine.test_compiled_plant import VALUES

LATE = [e for e in VALUES if EFFECTS[e].onset == "may"]


def a_log(
    *,
    jitter: float = 0.0,
    pause: bool = False,
    held: int = 1,
    lost: float = 0.0,
    channels: tuple[str, ...] = ("accel", "speed"),
) -> Log:
    """Thirty seconds that reach every effect, with noise."""
    random = np.random.default_rng(1)
    n = np.arange(1500 if not pause else 2500)
    time = 0.02 * (n + jitter * random.uniform(-0.4, 0.4, len(n)))
    command = 1.5 * np.sin(2 * np.pi * time / 9) + np.repeat(random.normal(0, 0.4, len(n) // 25), 25)
    speed = 6.0 + 5.0 * np.sin(2 * np.pi * time / 20) + 0.2 * np.sin(2 * np.pi * time / 3)
    accel = np.gradient(speed, time) + 0.1 * random.standard_normal(len(n))
    if pause:
        speed[1200:1300] = 0.0
    speed = speed[n // held * held] + 0.01 * random.standard_normal(len(n)) * (held == 1)
    signals = {"accel": accel, "speed": speed}
    kept = random.random(len(n)) >= lost
    kept[0] = True
    return Log.from_arrays(time=time[kept], accel_cmd=command[kept], **{name: signals[name][kept] for name in channels})


def a_hypothesis(effects: tuple[str, ...] = (), data: DriveData | None = None, onset: str = "") -> Hypothesis:
    """At values of no crease, with a recorder; the effect `onset` sets in during the drive."""
    h = Hypothesis(DriveData.of(a_log()) if data is None else data, shift_speeds=np.array([3.0, 5.5, 8.0]))
    h["T_L"], h["K_L"] = 0.37, 0.93
    for channel, delay in (("accel", 0.0137), ("speed", 0.0261)):
        h[f"{channel}_delay"], h[f"{channel}_filter"] = delay, 0.021
    for e in effects:
        late = e == onset or EFFECTS[e].onset == "must"
        h = h.with_effect(e, VALUES.get(e, (0.05, -0.4)), float(h.data.time[611]) + 0.004 if late else None)
    return h


def apart(h: Hypothesis, tmp_values: np.ndarray | None = None) -> float:
    """Relative difference between the density in torch and the compiled one."""
    density = HypothesisDensity(h)
    x = h.values[[INDEX[n] for n in h.free]][None] if tmp_values is None else tmp_values
    torch_, compiled = density.log_density(torch.as_tensor(x)).numpy(), density.compiled(x)
    return float(np.abs(torch_ / compiled - 1).max())


# the value ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("effects", [(), *[(e,) for e in VALUES], ("second_order_actuator@late",)], ids="+".join)
def test_the_value_is_the_compiled_one(effects):
    assert apart(a_hypothesis(effects)) < 1e-8


@pytest.mark.parametrize("effect", LATE)
def test_also_of_an_effect_that_sets_in_later(effect):
    assert apart(a_hypothesis((effect,), onset=effect)) < 1e-8
    others = ("second_order_actuator", "constant_resistance", "gain_change", "sensor_scale")
    if effect not in ("rate_limit", *others):
        assert apart(a_hypothesis((*others, effect), onset=effect)) < 1e-8


def test_unnamed_dynamics_and_lost_messages():
    h = Hypothesis(DriveData.of(a_log())).with_effect("~linear", (-0.4, 1.6)).with_effect("command_hold", ())
    h.lost = ((300, 330), (900, 925))
    assert apart(h) < 1e-8


@pytest.mark.parametrize(
    "log",
    [
        a_log(jitter=1.0),
        a_log(pause=True),
        a_log(held=5),
        a_log(held=5, lost=0.03),
        a_log(channels=("accel",)),
        a_log(channels=("speed",)),
    ],
    ids=["jitter", "two stretches", "held speed", "held speed, lost rows", "accel", "speed"],
)
def test_drives_of_all_kinds(log):
    data = DriveData.of(log)
    h = a_hypothesis(("dead_time", "dead_band", "rate_limit", "constant_resistance"), data, onset="dead_band")
    assert apart(h) < 1e-8
    h.data = data.below(3.0).only(np.arange(data.frame_count) % 3 > 0)
    assert apart(h) < 1e-8
    if data.channel_count == 2:
        h.data = data.with_align(0.03)
        assert apart(h) < 1e-8


def test_a_baseline_stays():
    baseline = plant([DeadTime(0.2)], T_L=0.4)
    h = a_hypothesis(("sensor_bias",))
    h.neutral = neutral_of(baseline)
    h["dead_time"] = h.neutral[INDEX["dead_time"]]
    assert "dead_time" not in h.free
    assert apart(h) < 1e-8
    with_plant = replace(h, baseline=baseline)
    assert apart(with_plant) < 1e-8


@dataclass(frozen=True)
class Trailer(Effect):
    mass_ratio: float = 0.4
    name: ClassVar[str] = "engine_test_trailer"
    place: ClassVar = "actuator"
    meaning: ClassVar[str] = "an unknown trailer"
    equation: ClassVar[str] = "K_L / (1 + m)"
    parameters: ClassVar = (Parameter("mass_ratio", "-", neutral=0.0, low=0.1, high=0.8),)

    def apply(self, x, row):
        return 1 / (1 + self.mass_ratio), 1.0


def test_a_users_own_effect():
    before = dict(EFFECTS)
    try:
        adopt(Trailer)
        h = Hypothesis(DriveData.of(a_log()))
        h["T_L"] = 0.37
        h = h.with_effect(Trailer.name, (0.3,)).with_effect("sensor_bias", (0.1,))
        assert apart(h) < 1e-8
        late = a_hypothesis(("dead_band",), onset="dead_band").with_effect(Trailer.name, (0.3,))
        late.values = np.append(late.values, np.zeros(len(INDEX) - len(late.values)))
        assert "dead_band" in not_in_torch(late)
    finally:
        for name in set(EFFECTS) - set(before):
            del EFFECTS[name]


def test_columns_are_independent():
    h = a_hypothesis(("dead_time", "backlash"))
    x = h.values[[INDEX[n] for n in h.free]]
    columns = x * (1 + 0.05 * np.random.default_rng(0).standard_normal((5, len(x))))
    assert apart(h, columns) < 1e-8


def test_an_actuator_that_changes_twice_is_not_in_torch():
    assert "rate_limit" in not_in_torch(a_hypothesis(("second_order_actuator", "rate_limit"), onset="rate_limit"))


# the gradient ---------------------------------------------------------------------------------------------------------
GRADED = [(), *[(e,) for e in VALUES if e != "gear_shift"], ("gear_shift",), ("second_order_actuator@late",)]


@pytest.mark.parametrize("effects", GRADED, ids="+".join)
def test_the_gradient_is_that_of_differences(effects):
    density = HypothesisDensity(a_hypothesis(effects), temper=1.0)
    x = torch.as_tensor(density.hypothesis.values[[INDEX[n] for n in density.names]])[None].requires_grad_()
    assert torch.autograd.gradcheck(density.log_density, x, eps=1e-7, atol=1e-2, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("effect", ["dead_time", "rate_limit", "backlash", "sensor_lag"])
def test_also_from_an_onset_on(effect):
    density = HypothesisDensity(a_hypothesis((effect,), onset=effect), temper=1.0)
    x = torch.as_tensor(density.hypothesis.values[[INDEX[n] for n in density.names]])[None].requires_grad_()
    assert torch.autograd.gradcheck(density.log_density, x, eps=1e-7, atol=1e-2, rtol=1e-4, fast_mode=True)


def test_an_effect_that_never_acts_has_no_gradient():
    h = a_hypothesis(("dead_band",))
    h.onsets["dead_band"] = float(h.data.time[-1]) + 1.0
    values = {n: torch.tensor([h[n]], dtype=torch.float64, requires_grad=True) for n in h.free}
    accel, _ = TorchPlant.of(h).on_grid(values)
    assert torch.autograd.grad(accel.sum(), values["dead_band"], allow_unused=True)[0] is None


# without limits -------------------------------------------------------------------------------------------------------
def test_coordinates_without_limits_and_back():
    h = a_hypothesis(("dead_time", "sensor_bias"))
    density = HypothesisDensity(h)
    z = density.initial()
    x = torch.as_tensor(h.values[[INDEX[n] for n in h.free]])
    torch.testing.assert_close(density.constrain(z)[0], x, rtol=1e-12, atol=1e-12)
    far = z + 30 * torch.randn(50, len(x), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for name, at in zip(density.names, density.constrain(far).T, strict=True):
        if not name.endswith("_delay"):
            low, high = h.limits(name)
            assert low <= float(at.min()) <= float(at.max()) <= high * (1 + 1e-12)
    slope = torch.autograd.functional.jacobian(density.constrain, z[0])
    assert isinstance(slope, torch.Tensor)
    torch.testing.assert_close(torch.linalg.slogdet(slope)[1], density.log_slope(z).sum())
    names = density.names
    i, j = names.index("accel_filter"), names.index("accel_delay")
    assert slope[j, i] == -slope[i, i]  # a longer filter at the same lateness leaves a shorter delay


def test_the_density_that_samplers_see():
    h = a_hypothesis(("dead_time",))
    density = HypothesisDensity(h)
    assert isinstance(density, Density)
    assert isinstance(density, ScoredDensity)
    z = (density.initial() + 0.01 * torch.randn(3, 1, len(h.free), dtype=torch.float64)).requires_grad_()
    value = density.log_prob(z)
    (gradient,) = torch.autograd.grad(value.sum(), z)
    torch.testing.assert_close(gradient, density.score(z))
    torch.testing.assert_close(value.detach(), density.log_prob(z.detach()), rtol=1e-8, atol=0)
    lost = z.detach().clone()
    lost[1, 0, 0] = torch.nan
    value, score = density.expand(lost)
    assert value.isnan().squeeze(-1).tolist() == [False, True, False]
    assert score.isnan().all(-1).squeeze(-1).tolist() == [False, True, False]


def test_held_coordinates_keep_their_values():
    h = a_hypothesis(("dead_time",))
    some = HypothesisDensity(h, chosen=("T_L", "dead_time"))
    x = torch.tensor([[0.4, 0.25]], dtype=torch.float64)
    whole = torch.as_tensor(h.values[[INDEX[n] for n in h.free]])[None].clone()
    whole[0, h.free.index("T_L")], whole[0, h.free.index("dead_time")] = 0.4, 0.25
    torch.testing.assert_close(some.log_density(x), HypothesisDensity(h).log_density(whole))
