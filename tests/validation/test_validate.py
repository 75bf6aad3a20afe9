"""The verdict: agree where draws are exact, disagree where an SD is off by a tenth; and all of `validate`."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace

import pytest
import torch

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, Posterior, Quadrature, SamplerSettings, integrate
from avtorch.io import write_json
from avtorch.results import validation_answer
from benchmarks.peers.conjugate import sample_conjugate

pytest.importorskip("arviz")

from avtorch.validation import agreement, synthetic_windows, validate
from avtorch.validation.agreement import agreement_verdict, chi2_of_means
from avtorch.validation.reference import NODES, NutsSettings, exact_draws, join, reference, select
from avtorch.validation.validate import Validation, check_installed
from avtorch.validation.windows import Windows
from tests.bars import BAR, LEVEL

WINDOWS = 12


@pytest.fixture(scope="module")
def windows() -> Windows:
    """Informative windows, so that few exact draws suffice."""
    found = synthetic_windows(100, seed=8)
    return found.select((found.excited & (found.truth[:, 0] < 0.6)).nonzero().squeeze(-1)[:WINDOWS])  # type: ignore[index]


@pytest.fixture(scope="module")
def exact(windows: Windows) -> Quadrature:
    return reference(windows)


@pytest.fixture(scope="module")
def draws(windows: Windows) -> Posterior:
    """Of a seed, for what does not depend on chance."""
    return drawn(windows, 0)


def drawn(windows: Windows, seed: int, count: int = 8000) -> Posterior:
    g = torch.Generator().manual_seed(seed)
    return exact_draws(windows.density, chains=8, draws=count // 8, generator=g)


def inflated(posterior: Posterior, factor: float) -> Posterior:
    center = posterior.mean
    return Posterior(posterior.names, center + factor * (posterior.draws - center), posterior.converged)


@pytest.mark.statistical
def test_exact_draws_agree(windows: Windows, exact: Quadrature, rotating_seed: int) -> None:
    assert bool(exact.converged.all())
    found = agreement(drawn(windows, rotating_seed), exact)
    verdict = agreement_verdict(found, exact.converged)
    assert verdict.agree
    assert verdict.share == 1.0
    assert verdict.share_if_exact > 0.99
    assert verdict.low == pytest.approx(0.025 ** (1 / WINDOWS))
    assert f"{WINDOWS} of {WINDOWS} windows (100 %" in verdict.why
    assert "more windows could still change the verdict" in verdict.why
    # independent draws: z-scores within 5 sigma of a chi^2, three correlated parameters counted as two
    bar = BAR * math.sqrt(2 / (2 * WINDOWS)) + 0.1
    assert float(found.z_mean.square().mean()) < 1 + bar
    assert float(found.z_sd.square().mean()) < 1 + bar


def test_ten_percent_inflation_disagrees(draws: Posterior, exact: Quadrature) -> None:
    found = agreement(inflated(draws, 1.1), exact)
    verdict = agreement_verdict(found, exact.converged)
    assert not verdict.agree
    assert verdict.share < 0.2
    assert "95 % are needed" in verdict.why
    assert "furthest: window" in verdict.why


def test_windows_that_did_not_settle_do_not_pass(draws: Posterior, exact: Quadrature) -> None:
    converged = exact.converged.clone()
    converged[0] = False
    verdict = agreement_verdict(agreement(draws, exact), converged)
    assert not verdict.agree
    assert verdict.share <= 1 - 1 / WINDOWS
    assert "the chains or the reference of 1 did not converge" in verdict.why


def test_too_few_draws_are_named_as_the_reason(windows: Windows, exact: Quadrature) -> None:
    verdict = agreement_verdict(agreement(drawn(windows, 0, count=400), exact), exact.converged)
    assert not verdict.agree
    assert "take more draws" in verdict.why


def test_references_that_contradict_each_other_settle_nothing(draws: Posterior, exact: Quadrature) -> None:
    good = agreement(draws, exact)
    moved = replace(draws, draws=draws.draws[:, :250] + 0.3 * exact.sd)
    against = agreement(moved, exact)
    assert chi2_of_means(against) < 1e-6
    verdict = agreement_verdict(good, exact.converged, nuts=against)
    assert not verdict.agree
    assert "NUTS contradicts quadrature" in verdict.why


@pytest.mark.statistical
def test_p_value_of_exact_means(windows: Windows, exact: Quadrature, rotating_seed: int) -> None:
    assert chi2_of_means(agreement(drawn(windows, rotating_seed, count=2000), exact)) > LEVEL


@pytest.mark.statistical
def test_draws_of_a_quadrature_have_its_moments(windows: Windows, exact: Quadrature, rotating_seed: int) -> None:
    draws = drawn(windows, rotating_seed, count=20_000)
    g = torch.Generator().manual_seed(rotating_seed)
    assert isinstance(windows.density, JerkDensity)
    other = sample_conjugate(windows.density, draws=20_000, proposals=60_000, generator=g).posterior

    def correlation(posterior: Posterior) -> torch.Tensor:
        x = (posterior.flat - posterior.mean) / posterior.sd
        return torch.einsum("nwi,nwj->wij", x, x) / len(x)

    # a correlation of n draws has an SD of at most 1/sqrt(n); the conjugate draws are worth half their number
    assert float((correlation(draws) - correlation(other)).abs().max()) < BAR * math.sqrt(3.5 / 20_000) * 1.2


@pytest.mark.slow
def test_reference_of_weak_windows_takes_the_finer_grid() -> None:
    found = synthetic_windows(8, seed=0)
    usual = integrate(found.density, nodes=NODES[0])
    exact = reference(found)
    assert exact.nodes.shape == (8, 3, NODES[-1])
    assert torch.allclose(exact.mass.sum(-1), torch.ones(8, 3, dtype=torch.float64))
    good = usual.converged
    assert bool(good.any())
    part = select(exact, good.nonzero().squeeze(-1))
    assert part.mean == pytest.approx(usual.mean[good].numpy(), rel=1e-3)
    # the interpolated marginals give the same probabilities
    at = exact.mean + exact.sd * torch.tensor([-1.0, 0.0, 2.0], dtype=torch.float64)[:, None, None].clamp(min=-0.5)
    assert float((exact.cdf(at)[:, good] - usual.cdf(at)[:, good]).abs().max()) < 2e-3
    both = join([select(exact, torch.tensor([0])), select(exact, torch.tensor([1]))])
    assert torch.equal(both.mean, exact.mean[:2])


@pytest.mark.slow
def test_answer_of_synthetic_windows(windows: Windows, quick_nuts: None) -> None:
    part = windows.select(torch.arange(4))
    seen: list[tuple[float, float]] = []
    found = validate(part, nuts_windows=2, seed=3, progress=lambda done, of: seen.append((done, of)))
    assert isinstance(found, Validation)
    assert seen == sorted(seen)
    assert seen[-1][0] == pytest.approx(seen[-1][1])
    assert found.nuts_index.tolist() == [0, 3]
    assert found.nuts.draws.shape[2] == 2
    assert found.compared.tolist() == [0, 1, 2, 3]
    answer = validation_answer(found)
    assert answer["schema"] == "avtorch.validation/1"
    assert [(w["window"], w["method"]) for w in answer["windows"]] == [
        *((i, "sgld") for i in range(4)),
        *((i, "quadrature") for i in range(4)),
        (0, "nuts"),
        (3, "nuts"),
    ]
    assert all(set(w["sigma"]) == {"mean", "sd", "q05", "q95"} for w in answer["windows"])
    summary = answer["summary"]
    for key in ("mean_difference_sd_p95", "sd_ratio_p025", "sd_ratio_p975", "coverage_90", "coverage_90_quadrature"):
        assert set(summary[key]) == {"T_L", "K_L", "sigma"}
    assert summary["coverage_is"] == "truth"
    assert all(seconds > 0 for seconds in summary["seconds_per_window"].values())
    assert answer["verdict"] == ("agree" if found.verdict.agree else "disagree")
    assert len(answer["agreement"]) == 4
    for entry in answer["agreement"]:
        assert set(entry["truth"]) == {"T_L", "K_L", "sigma"}
        assert entry["ksd"] > 0
    again = validate(part, nuts_windows=2, seed=3)
    assert torch.equal(again.sgld.draws, found.sgld.draws)
    groups = found.to_arviz()
    assert set(groups) == {"sgld", "nuts", "quadrature"}
    assert groups["nuts"].posterior["window"].values.tolist() == [0, 3]
    assert dict(groups["quadrature"].posterior.sizes) == {"chain": 4, "draw": 500, "window": 4}


class ManyNoises:
    """A jerk density with a fourth parameter: more than a grid can integrate."""

    names = ("T_L", "K_L", "process_noise", "coloured_sd")

    def __init__(self, of: JerkDensity) -> None:
        self.of, self.prior, self.windows = of, of.prior, of.windows

    def log_prob(self, z: torch.Tensor) -> torch.Tensor:
        return self.of.log_prob(z[..., :3]) - 0.5 * ((z[..., 3] + 1) / 0.3).square()

    def score(self, z: torch.Tensor) -> torch.Tensor:
        return torch.cat([self.of.score(z[..., :3]), -(z[..., 3:] + 1) / 0.09], -1)

    def select(self, index: torch.Tensor) -> ManyNoises:
        return ManyNoises(self.of.select(index))

    def initial(self) -> torch.Tensor:
        return torch.cat([self.of.initial(), torch.full((self.windows, 1), -1.0, dtype=torch.float64)], -1)


def test_nuts_is_the_reference_where_quadrature_cannot_be(windows: Windows, quick_nuts: None, tmp_path) -> None:
    assert isinstance(windows.density, JerkDensity)
    density = ManyNoises(windows.density)
    source = replace(windows, name="drive.csv", form="latent", density=density, truth=None)
    found = validate(source, nuts_windows=3)
    assert found.reference == "nuts"
    assert found.quadrature is None
    assert found.compared.tolist() == found.nuts_index.tolist()
    assert found.nuts_agreement is None
    assert "of nuts" in found.verdict.why
    assert "widened by 2 standard errors" in found.verdict.why
    answer = validation_answer(found)
    assert answer["reference"] == "nuts"
    assert answer["summary"]["sigma_is"] in ("process_noise", "coloured_sd")
    assert answer["summary"]["not_run"] == ["quadrature"]
    assert answer["summary"]["seconds_per_window"]["quadrature"] == 0.0
    assert set(answer["windows"][0]["noise"]) == {"process_noise", "coloured_sd"}
    assert 0.7 < answer["summary"]["coverage_90"]["T_L"] < 1.0
    assert answer["summary"]["coverage_is"] == "mass of nuts"
    assert set(found.to_arviz()) == {"sgld", "nuts"}
    write_json(tmp_path / "validation.json", answer)
    assert json.loads((tmp_path / "validation.json").read_text(encoding="utf-8"))["verdict"] == answer["verdict"]


def test_coverage_without_truth_is_the_mass_of_the_reference(windows: Windows, quick_nuts: None) -> None:
    source = replace(windows.select(torch.arange(3)), truth=None)
    covered = validate(source, nuts_windows=1).coverage()
    assert set(covered) == {"sgld"}
    assert covered["sgld"] == pytest.approx(torch.full((3,), 0.9).numpy(), abs=0.03)


@pytest.mark.slow
def test_nuts_itself(windows: Windows) -> None:
    pytest.importorskip("pyro")
    found = validate(windows.select(torch.arange(1)), nuts_windows=1, nuts=NutsSettings(1, 150, 100))
    assert found.nuts.draws.shape == (1, 150, 1, 3)
    assert found.nuts_agreement is not None
    assert float(found.nuts_agreement.z_mean.abs().max()) < 6


def test_what_is_refused_before_any_work(windows: Windows, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="nuts_windows: found 0"):
        validate(windows, nuts_windows=0)
    with pytest.raises(InputError, match="draws: found 4 of a single chain"):
        validate(windows, settings=SamplerSettings(chains=1, draws=4))
    with pytest.raises(InputError, match="warmup: found 0"):
        NutsSettings(warmup=0)
    module = sys.modules["avtorch.validation.validate"]  # the package's attribute of this name is the function
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"arviz, pyro-ppl: are not installed; needs pip install 'avtorch\[validate\]'"
    ):
        validate(windows)
    monkeypatch.setattr(module, "find_spec", lambda name: None if name == "pyro" else sys)
    with pytest.raises(InputError, match=r"^pyro-ppl: is not installed"):
        check_installed()
