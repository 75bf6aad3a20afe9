"""When the compiled walk is chosen, what is left to the reference, and that code once compiled is kept."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from avtorch.errors import InputError
from avtorch.inference import SGLD, JerkPoints, SamplerSettings, find_mode, sample
from avtorch.inference.compiled import compiled_form, load_kernels
from avtorch.inference.sampler import walk
from avtorch.inference.sgld import polynomial
from tests.inference.compiled_cases import Gaussian, densities, generator

F64 = torch.float64


def test_it_is_chosen_where_density_and_settings_allow_it(make_windows):
    for density in densities(make_windows).values():
        assert compiled_form(density, SamplerSettings()) is not None
    density = densities(make_windows)["first"]
    automatic, eager = (
        sample(density, SamplerSettings(chains=64, walk=way), generator=generator(1)).draws for way in ("auto", "eager")
    )
    assert not torch.equal(automatic, eager)


@pytest.mark.parametrize(
    ("setting", "value"),
    [("batch", 50), ("schedule", polynomial), ("optimizer", lambda params, step, g: SGLD(params, step, generator=g))],
)
def test_settings_that_only_the_reference_has_are_left_to_it(setting, value, make_windows):
    windows = make_windows(0, [1.0])
    density = JerkPoints(windows.a, windows.u, windows.jerk)
    mode, given = find_mode(density), {"chains": 32, setting: value}
    both = [walk(density, mode, SamplerSettings(**given, walk=w), generator=generator(1)) for w in ("auto", "eager")]
    assert torch.equal(*both)


def test_a_bad_setting_is_named():
    with pytest.raises(InputError, match="walk: 'fast' is neither 'auto' nor 'eager'"):
        SamplerSettings(walk="fast")  # pyright: ignore[reportArgumentType]


def test_where_numba_does_not_compile_the_reference_walks(make_windows, monkeypatch):
    density = densities(make_windows)["first"]
    eager = sample(density, SamplerSettings(chains=64, walk="eager"), generator=generator(1)).draws
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    load_kernels.cache_clear()
    try:
        assert torch.equal(sample(density, SamplerSettings(chains=64), generator=generator(1)).draws, eager)
    finally:
        load_kernels.cache_clear()


def test_a_density_elsewhere_is_left_to_torch():
    density = Gaussian(torch.eye(3, dtype=F64)[None].to("meta"))
    assert compiled_form(density, SamplerSettings()) is None


def fresh_process(code: str, **environment: str) -> str:
    """What a new interpreter prints."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


SAMPLE = """
import torch
from avtorch.inference import SamplerSettings, sample
from avtorch.validation import synthetic_windows
density = synthetic_windows(2, seed=1).density
draws = sample(density, SamplerSettings(), generator=torch.Generator().manual_seed(0)).draws
from avtorch.inference import kernels
hits, misses = (sum(getattr(kernels.walk.stats, s).values()) for s in ("cache_hits", "cache_misses"))
print(hits, misses, draws.sum().item().hex())
"""


@pytest.mark.slow
def test_a_second_process_compiles_nothing_and_draws_the_same(tmp_path):
    first = fresh_process(SAMPLE, NUMBA_CACHE_DIR=str(tmp_path))
    second = fresh_process(SAMPLE, NUMBA_CACHE_DIR=str(tmp_path))
    assert first.startswith("0 1")
    assert second.startswith("1 0")
    assert first.split()[-1] == second.split()[-1]


LATENT = """
import torch
from avtorch.inference.latent import LatentDensity, LatentWindow
time = 0.01 * torch.arange(200, dtype=torch.float64)
u = torch.sin(3 * time)
a, v = 0.9 * torch.sin(3 * time - 0.5), 10 - torch.cos(3 * time) / 3
density = LatentDensity(LatentWindow.single(time, u, accel=a, speed=v))
print(density.log_prob(density.initial()).item())
"""


@pytest.mark.slow
def test_the_latent_form_is_compiled_once_and_has_the_same_value_without(tmp_path):
    told = (
        LATENT + "from avtorch.inference import latent_kernels as k\nprint(sum(k.filtered.stats.cache_hits.values()))"
    )
    first, second = (fresh_process(told, NUMBA_CACHE_DIR=str(tmp_path)).split() for _ in range(2))
    assert (first[1], second[1]) == ("0", "1")
    assert first[0] == second[0]
    without = fresh_process(LATENT, NUMBA_DISABLE_JIT="1")
    # the diffuse start cancels about seven digits
    assert float(without) == pytest.approx(float(first[0]), rel=1e-9, abs=1e-8)


@pytest.mark.slow
def test_where_compiled_code_cannot_be_kept_the_reference_walks():
    """No folder to write to: every process would compile for seconds."""
    answer = fresh_process(
        "import numba.core.caching as c\n"
        "c.CacheImpl._locator_classes = []\n"
        "from avtorch.inference.compiled import load_kernels\n"
        "print(load_kernels('kernels'), load_kernels('latent_kernels'))"
    )
    assert answer.split() == ["None", "None"]
