"""When the compiled walk is chosen, what is left to the reference, and that code once compiled is kept."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from avtorch.errors import InputError
from avtorch.inference import SGLD, JerkDensity, JerkPoints, SamplerSettings, find_mode, sample
from avtorch.inference.compiled import Compiled, Unavailable, compiled, load_kernels
from avtorch.inference.exponential_form import ExponentialForm
from avtorch.inference.priors import HalfNormalPrior, Joint, default_actuation_prior
from avtorch.inference.sampler import walk
from avtorch.inference.sgld import polynomial
from tests.inference.compiled_cases import Gaussian, densities, generator

F64 = torch.float64


def test_it_is_chosen_where_density_and_settings_allow_it(make_windows):
    for density in densities(make_windows).values():
        assert isinstance(compiled(density), Compiled)
    density = densities(make_windows)["first"]
    automatic, asked, eager = (
        sample(density, SamplerSettings(chains=64, walk=way), generator=generator(1)).draws
        for way in ("auto", "compiled", "eager")
    )
    assert torch.equal(automatic, asked)
    assert not torch.equal(automatic, eager)


class Steeper(JerkDensity):
    """Overrides the density, and not the form that its parent gives of it."""

    def log_prob(self, z):
        return 2 * super().log_prob(z)

    def score(self, z):
        return 2 * super().score(z)


class Wider(HalfNormalPrior):
    def score(self, z):
        return 0.5 * super().score(z)


def test_it_is_not_chosen_for_what_it_does_not_know(make_windows):
    statistics = make_windows(0, [1.0]).statistics
    wider = Joint(default_actuation_prior(), Wider(torch.ones(1, dtype=F64)))
    for density, why in (
        (Steeper(statistics), "Steeper has no closed form"),
        (JerkDensity(statistics, wider), "the prior of JerkDensity has no closed form"),
    ):
        found = compiled(density)
        assert isinstance(found, Unavailable)
        assert why in found.why
        with pytest.raises(InputError, match=f"walk: 'compiled' cannot be had: {why}"):
            sample(density, SamplerSettings(walk="compiled"))
        # the eager walk's very draws
        mode = find_mode(density)
        both = [walk(density, mode, SamplerSettings(walk=w), generator=generator(1)) for w in ("auto", "eager")]
        assert torch.equal(*both)


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
    with pytest.raises(InputError, match=f"walk: 'compiled' cannot be had: it has no {setting}"):
        walk(density, mode, SamplerSettings(**given, walk="compiled"), generator=generator(1))


def test_a_bad_setting_is_named():
    with pytest.raises(InputError, match="walk: 'fast' is none of 'auto', 'compiled', 'eager'"):
        SamplerSettings(walk="fast")  # pyright: ignore[reportArgumentType]


def test_where_numba_does_not_compile_the_reference_walks(make_windows, monkeypatch):
    density = densities(make_windows)["first"]
    eager = sample(density, SamplerSettings(chains=64, walk="eager"), generator=generator(1)).draws
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    load_kernels.cache_clear()
    try:
        assert torch.equal(sample(density, SamplerSettings(chains=64), generator=generator(1)).draws, eager)
        with pytest.raises(InputError, match="numba does not compile here: NUMBA_DISABLE_JIT is set"):
            sample(density, SamplerSettings(walk="compiled"))
    finally:
        load_kernels.cache_clear()


def test_a_density_elsewhere_is_left_to_torch():
    density = Gaussian(torch.eye(3, dtype=F64)[None])
    form = density.exponential_form()
    away = ExponentialForm(form.terms, form.exponents, form.offsets, form.coupling.to("meta"))
    density.exponential_form = lambda: away
    found = compiled(density)
    assert isinstance(found, Unavailable)
    assert "is on meta" in found.why


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
draws = sample(density, SamplerSettings(walk="compiled"), generator=torch.Generator().manual_seed(0)).draws
from avtorch.inference import kernels
hits, misses = ([sum(getattr(k.stats, s).values()) for k in (kernels.walk, kernels.weigh)] for s in
                ("cache_hits", "cache_misses"))
print(hits, misses, draws.sum().item().hex())
"""


@pytest.mark.slow
def test_a_second_process_compiles_nothing_and_draws_the_same(tmp_path):
    first = fresh_process(SAMPLE, NUMBA_CACHE_DIR=str(tmp_path))
    second = fresh_process(SAMPLE, NUMBA_CACHE_DIR=str(tmp_path))
    assert first.startswith("[0, 0] [1, 1]")
    assert second.startswith("[1, 1] [0, 0]")
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
        "from avtorch.inference.compiled import compiled\n"
        "from avtorch.validation import synthetic_windows\n"
        "print(compiled(synthetic_windows(1, seed=1).density).why)"
    )
    assert "compiled code cannot be kept" in answer
    assert "NUMBA_CACHE_DIR" in answer
