"""Everything in `inference` runs on the device that it is given: an emulated one anywhere, a real one where it is.

The emulated device (`tests.other_device`) ends a test at the first tensor made without a device. Its numbers are the
processor's, so that the results have to be those of the processor. A graphics card: `tests/inference/test_on_a_gpu.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from avtorch import estimate
from avtorch.errors import InputError
from avtorch.inference import (
    BeliefStream,
    SamplerSettings,
    SequentialInference,
    find_mode,
    integrate,
    sample,
)
from avtorch.inference.device import checked_device
from avtorch.inference.estimators import ESTIMATORS
from avtorch.inference.importance import weighted_draws
from avtorch.inference.latent import LatentForm
from avtorch.inference.sgld import SGLD
from benchmarks.bias.control_variates import ControlVariates
from benchmarks.peers.conjugate import sample_conjugate
from tests.inference.device_cases import DENSITIES, F64, jerk_density, jerk_points, rows, same
from tests.other_device import ELSEWHERE, Elsewhere, OtherDevice, Strayed

EAGER = SamplerSettings(chains=16, draws=4, walk="eager", attempts=1)


@pytest.fixture
def elsewhere() -> Iterator[OtherDevice]:
    with OtherDevice() as device:
        yield device


def assert_alike(found: dict[str, Any], expected: dict[str, Any], rtol: float) -> None:
    """Two tables of plain numbers and words."""
    assert found.keys() == expected.keys()
    for key, column in expected.items():
        numbers = isinstance(column[0], float)
        assert found[key] == (pytest.approx(column, rel=rtol, nan_ok=True) if numbers else column), key


def test_the_emulated_device_finds_a_tensor_made_without_a_device(elsewhere: OtherDevice) -> None:
    """What the other tests rest on."""
    x = torch.ones(3, device=ELSEWHERE)
    assert isinstance(x, Elsewhere)
    for stray in (
        lambda: x + torch.zeros(3),
        lambda: torch.where(x > 0, x, torch.zeros(3)),
        lambda: torch.cat([x, torch.zeros(1)]),
        lambda: x[torch.arange(2)],
        lambda: x.index_put_((torch.arange(2),), torch.zeros(2, device=ELSEWHERE)),
        lambda: torch.randn(3, device=ELSEWHERE, generator=torch.Generator()),
        lambda: torch.randn(3, generator=torch.Generator(device=ELSEWHERE)),
    ):
        with pytest.raises(Strayed):
            stray()
    with pytest.raises(TypeError, match="numpy"):
        x.numpy()
    assert not elsewhere.fetched
    assert bool((x > 0).all())
    assert sum(elsewhere.fetched.values()) == 1
    assert (x + torch.tensor(1.0)).tolist() == [2.0] * 3


QUICK = ("jerk, switch", "points")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in DENSITIES]
)
def test_densities_and_modes(name: str, elsewhere: OtherDevice) -> None:
    here, there = DENSITIES[name]("cpu"), DENSITIES[name](ELSEWHERE)
    z = here.initial() + 0.1
    same(there.log_prob(z.to(ELSEWHERE)), here.log_prob(z), 1e-8)
    if hasattr(here, "score"):
        same(there.score(z.to(ELSEWHERE)), here.score(z))
    index = torch.tensor([0])
    if hasattr(here, "select"):
        same(there.select(index.to(ELSEWHERE)).initial(), here.select(index).initial())
    if hasattr(here, "log_prob_minibatch"):
        batch = torch.arange(10)
        same(there.log_prob_minibatch(z.to(ELSEWHERE), batch.to(ELSEWHERE)), here.log_prob_minibatch(z, batch))
    if name not in ("even rows", "uneven rows"):  # a minute, and nothing new
        # the search ends within 1.5e-4 SDs of the mode, by closed form here and by differences there
        same(find_mode(there).z, find_mode(here).z, 1e-4)


@pytest.mark.parametrize(
    ("name", "noise"),
    [
        ("jerk, switch", "averaged"),
        pytest.param("points", "independent", marks=pytest.mark.slow),
        pytest.param("own", "averaged", marks=pytest.mark.slow),
    ],
)
def test_sampled(name: str, noise: Any, elsewhere: OtherDevice) -> None:
    settings = SamplerSettings(chains=16, draws=4, walk="eager", attempts=1, noise=noise)
    here, there = DENSITIES[name]("cpu"), DENSITIES[name](ELSEWHERE)
    expected = sample(here, settings, generator=torch.Generator().manual_seed(3), mode=find_mode(here))
    g = torch.Generator(device=ELSEWHERE).manual_seed(3)
    mode = find_mode(here)
    moved = type(mode)(*(getattr(mode, x).to(ELSEWHERE) for x in ("z", "scale", "log_prob", "converged")))
    found = sample(there, settings, generator=g, mode=moved)
    same(found.draws, expected.draws, 1e-6)
    assert found.converged.tolist() == expected.converged.tolist()
    assert found.why == expected.why
    assert_alike(found.summary().columns, expected.summary().columns, 1e-6)


@pytest.mark.slow
def test_sampled_in_minibatches_with_spread_and_a_schedule(elsewhere: OtherDevice) -> None:
    settings = SamplerSettings(
        chains=16, draws=4, batch=50, spread=1.0, step=0.3, attempts=1,
        schedule=lambda o: torch.optim.lr_scheduler.ExponentialLR(o, 0.99),
    )  # fmt: skip
    found = sample(jerk_points(ELSEWHERE), settings, generator=torch.Generator(device=ELSEWHERE).manual_seed(0))
    assert found.draws.device == ELSEWHERE
    density = jerk_points(ELSEWHERE)
    control = ControlVariates(density, find_mode(density))
    assert control.log_prob_minibatch(density.initial(), torch.arange(5, device=ELSEWHERE)).device == ELSEWHERE


def test_the_walk_waits_for_no_number(elsewhere: OtherDevice) -> None:
    """Numbers are fetched around the walk, but none at its steps: twice the draws fetch as many."""
    fetched, calls = [], []
    for draws in (8, 16):
        density = jerk_density(ELSEWHERE)
        before, made = sum(elsewhere.fetched.values()), elsewhere.calls
        settings = SamplerSettings(chains=16, draws=draws, walk="eager", compare=False, attempts=1)
        sample(density, settings, generator=torch.Generator(device=ELSEWHERE).manual_seed(0))
        fetched.append(sum(elsewhere.fetched.values()) - before)
        calls.append(elsewhere.calls - made)
    assert calls[1] > calls[0] + 8
    assert fetched[1] == fetched[0]


def test_optimizers_resume_there(elsewhere: OtherDevice) -> None:
    def made() -> tuple[Tensor, Any]:
        theta = torch.ones(5, dtype=F64, device=ELSEWHERE).requires_grad_()
        return theta, SGLD([theta], lr=0.1, generator=torch.Generator(device=ELSEWHERE).manual_seed(1))

    def step(theta: Tensor, by: Any) -> None:
        by.step(lambda: 0.5 * theta.square().sum())

    theta, one = made()
    step(theta, one)
    state = one.state_dict()
    copy, two = made()
    two.generator = None
    two.load_state_dict(state)
    assert two.generator.device == ELSEWHERE
    copy.data.copy_(theta.data)
    step(theta, one)
    step(copy, two)
    assert theta.tolist() == copy.tolist()


@pytest.mark.parametrize(
    "options",
    [
        {"noise": "averaged", "foreach": True},
        {"preconditioner": "rmsprop", "chain_dims": 1, "noise_dtype": torch.float32},
    ],
)
def test_optimizers_walk_there_as_here(options: dict[str, Any], elsewhere: OtherDevice) -> None:
    walked = []
    for device in ("cpu", ELSEWHERE):
        theta = torch.linspace(-1, 1, 8, dtype=F64).to(device).requires_grad_()
        by = SGLD([theta], lr=0.1, generator=torch.Generator(device=device).manual_seed(4), **options)
        for _ in range(3):
            by.step(lambda theta=theta: theta**4 / 4)
        walked.append(theta.detach())
    same(walked[1], walked[0])


def test_importance_draws_are_those_of_the_processor(elsewhere: OtherDevice) -> None:
    here, there = jerk_density("cpu"), jerk_density(ELSEWHERE)
    g = torch.Generator().manual_seed(0), torch.Generator(device=ELSEWHERE).manual_seed(0)
    expected, found = weighted_draws(here, generator=g[0]), weighted_draws(there, generator=g[1])
    same(found.z, expected.z, 1e-4)
    same(found.weight, expected.weight, 1e-3)
    assert found.equal(10, g[1]).device == ELSEWHERE


@pytest.mark.slow
def test_integrated_and_conjugate(elsewhere: OtherDevice) -> None:
    here, there = jerk_density("cpu", "quadrant"), jerk_density(ELSEWHERE, "quadrant")
    expected, found = integrate(here, nodes=15), integrate(there, nodes=15)
    same(found.mean, expected.mean, 1e-4)
    same(found.quantile(0.9), expected.quantile(0.9), 1e-4)
    same(found.cdf(found.mean), expected.cdf(expected.mean), 1e-4)
    g = torch.Generator().manual_seed(0), torch.Generator(device=ELSEWHERE).manual_seed(0)
    same(sample_conjugate(there, draws=200, generator=g[1]).ess, sample_conjugate(here, draws=200, generator=g[0]).ess)


# the latent density's own parts are tested above: a stream of it by its graph takes a minute
@pytest.mark.parametrize(
    ("estimator", "form"),
    [
        pytest.param(name, form, marks=() if (name, form) == ("map", "jerk") else pytest.mark.slow)
        for name in ESTIMATORS
        for form in (("jerk", "latent") if name in ("ekf", "ukf") else ("jerk",))
    ],
)
def test_streams_go_on_from_states_of_another_device(estimator: str, form: str, elsewhere: OtherDevice) -> None:
    """Two windows there, of which the second begins from the state of a stream here; and back."""
    time, columns = rows(count=401)
    step = 4 if estimator in ("ekf", "ukf") else 1  # a filter works row by row
    time, columns = time[::step], {name: x[:, ::step] for name, x in columns.items()}
    options: dict[str, Any] = {"window": 2.0, "vehicles": 2, "estimator": estimator}
    if form == "latent":
        options["form"] = LatentForm(accel=True, speed=True)
    if estimator == "sgld":
        options["settings"] = EAGER
    here, there = BeliefStream(**options), BeliefStream(**options, device=ELSEWHERE)
    half = 200 // step + 1

    def part(stream: BeliefStream, which: slice, device: Any) -> Any:
        block = {name: x[:, which].to(device) for name, x in columns.items() if name in stream.form.columns}
        return stream.feed(time[which], block)[0].belief

    first = part(here, slice(0, half), "cpu"), part(there, slice(0, half), ELSEWHERE)
    same(first[1].mean, first[0].mean, 1e-4)
    assert first[1].excited.tolist() == [True, True]
    there.load_state_dict(here.state_dict())
    second = part(here, slice(half, None), "cpu"), part(there, slice(half, None), ELSEWHERE)
    same(second[1].mean, second[0].mean, 1e-4)
    same(second[1].draws, second[0].draws, 1e-3)
    here.load_state_dict(there.state_dict())
    assert all(x.device.type == "cpu" for x in here.inference.belief.state_dict().values() if isinstance(x, Tensor))
    assert_alike(second[1].summary().columns, second[0].summary().columns, 1e-3)


@pytest.mark.slow
def test_excitation_of_latent_windows(elsewhere: OtherDevice) -> None:
    time, columns = rows(count=200)
    form = LatentForm(accel=True, speed=True)
    block = {"time": time, **columns, "usable": torch.ones(2, 200, dtype=torch.bool)}
    expected = form.likelihood(block, 200)
    found = form.likelihood({name: x.to(ELSEWHERE) for name, x in block.items()}, 200)
    assert found.excited.device == ELSEWHERE
    assert found.excited.tolist() == expected.excited.tolist()


@pytest.mark.slow
def test_what_leaves_for_other_libraries_is_on_the_processor(elsewhere: OtherDevice) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("arviz")
    density = jerk_density(ELSEWHERE)
    posterior = sample(density, EAGER, generator=torch.Generator(device=ELSEWHERE).manual_seed(0))
    belief = SequentialInference(vehicles=2, device=ELSEWHERE).belief
    for answer in (posterior, belief):
        assert len(answer.to_dataframe()) > 0
        assert "T_L" in answer.to_arviz().posterior
        assert str(answer.overview())
    assert belief.to("cpu").draws.device.type == "cpu"


@pytest.mark.parametrize("name", ["cuda:77", "gpu", "", "cuda:-1", "meta"])
def test_a_device_that_is_not_here_is_one_error(name: str) -> None:
    for make in (
        lambda: BeliefStream(device=name),
        lambda: SequentialInference(device=name),
        lambda: BeliefStream(device=name, estimator="ekf"),
        lambda: checked_device(name),
    ):
        with pytest.raises(InputError, match=r"^device: found '.*', needs one of cpu"):
            make()


def test_a_generator_of_another_device_is_one_error(elsewhere: OtherDevice) -> None:
    with pytest.raises(InputError, match="generator: found one on cpu, needs one on meta"):
        sample(jerk_density(ELSEWHERE), EAGER, generator=torch.Generator())
    with pytest.raises(InputError, match="generator: found one on meta, needs one on cpu"):
        sample(jerk_density("cpu"), EAGER, generator=torch.Generator(device=ELSEWHERE))


@pytest.mark.slow
def test_estimate_takes_a_device(elsewhere: OtherDevice, tmp_path: Any) -> None:
    from avtorch import GLVDPlant, Leader, simulate

    run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
    here = estimate(run.log(), estimator="map", form="jerk")
    there = estimate(run.log(), estimator="map", form="jerk", device=ELSEWHERE)
    assert len(there.windows) == len(here.windows)
    for one, other in zip(there.windows, here.windows, strict=True):
        same(one.window.belief.mean, other.window.belief.mean, 1e-4)
