"""Lower level: pass-through, inversion, clipping, and the effective parameters it claims."""

from __future__ import annotations

import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import LowerLevel, glvd_jerk

F64 = torch.float64


def test_default_passes_the_demand_through_to_the_bit():
    u = torch.linspace(-5.9, 3.9, 50, dtype=F64)
    assert torch.equal(LowerLevel().command(torch.full_like(u, 1.7), u), u)
    assert torch.equal(LowerLevel(1.3, 0.7, 1.3, 0.7).raw_command(u, u), u)


def test_clipping_to_floats_and_tensors():
    u = torch.tensor([-9.0, 0.5, 9.0], dtype=F64)
    assert LowerLevel().command(u, u).tolist() == [-6.0, 0.5, 4.0]
    low, high = torch.tensor([-1.0, -2.0, -3.0], dtype=F64), torch.tensor([1.0, 0.25, 3.0], dtype=F64)
    assert LowerLevel(accel_min=low, accel_max=high).command(u, u).tolist() == [-1.0, 0.25, 3.0]


@pytest.mark.parametrize("plant", [(1.5, 0.5), (0.2, 0.9), (0.7, 1.2)])
@pytest.mark.parametrize("model", [(1.5, 0.5), (1.33, 0.64), (0.3, 1.0)])
def test_effective_parameters_describe_the_jerk(plant, model):
    """Plant driven by the raw command = GLVD with (T_e, K_e), as an identity in a and u."""
    a = torch.tensor([0.3, -1.0, 2.0, 0.0], dtype=F64)
    u = torch.tensor([1.0, 0.5, -2.0, 3.0], dtype=F64)
    lower = LowerLevel(*model)
    T_e, K_e = lower.effective(*plant)
    torch.testing.assert_close(
        glvd_jerk(a, lower.raw_command(a, u), *plant), glvd_jerk(a, u, T_e, K_e), rtol=1e-12, atol=1e-12
    )
    if model == plant:
        assert T_e.item() == pytest.approx(0.3)
        assert K_e.item() == pytest.approx(1.0)


def test_amplification_is_the_high_frequency_gain():
    lower = LowerLevel(1.5, 0.5)
    assert lower.amplification().item() == pytest.approx(1.5 * 1.0 / (0.5 * 0.3))
    a = torch.tensor(0.2, dtype=F64)
    rise = lower.raw_command(a, a + 1) - lower.raw_command(a, a)
    assert rise.item() == pytest.approx(lower.amplification().item())


def test_effective_of_an_unstable_inner_loop_is_negative():
    T_e, _ = LowerLevel(0.1, 0.2).effective(0.3, 1.0)
    assert T_e < 0


def test_scenarios_have_their_own_models():
    lower = LowerLevel(torch.tensor([0.3, 1.5], dtype=F64), torch.tensor([1.0, 0.5], dtype=F64))
    a, u = torch.tensor([0.1, 0.1], dtype=F64), torch.tensor([0.2, 0.2], dtype=F64)
    assert lower.command(a, u)[0] == u[0]
    assert lower.command(a, u)[1] == LowerLevel(1.5, 0.5).command(a, u)[1]


@pytest.mark.parametrize("name", ["T_hat", "K_hat", "T_d", "K_d"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_bad_models_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        LowerLevel(**{name: value})


def test_crossed_limits_are_refused():
    with pytest.raises(InputError, match="accel_min"):
        LowerLevel(accel_min=2.0, accel_max=1.0)
