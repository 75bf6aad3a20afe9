"""What ArviZ receives: dimensions, names, units, the draws themselves; and that its own figures are ours."""

from __future__ import annotations

import pytest
import torch

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, Posterior, SamplerSettings, sample
from avtorch.inference.arviz_export import UNITS
from avtorch.inference.latent import NOISE_PRIOR

pytest.importorskip("arviz")


@pytest.fixture(scope="module")
def posterior(make_windows) -> Posterior:
    density = JerkDensity(make_windows(1, [0.5, 2.0]).statistics)
    return sample(density, SamplerSettings(chains=4, draws=100), generator=torch.Generator().manual_seed(1))


def test_all_windows(posterior: Posterior) -> None:
    group = posterior.to_arviz().posterior
    assert list(group.data_vars) == ["T_L", "K_L", "sigma"]
    for name in posterior.names:
        assert group[name].dims == ("chain", "draw", "window")
        assert torch.equal(torch.from_numpy(group[name].values), posterior[name])
    assert [group[name].attrs["units"] for name in posterior.names] == ["s", "1", "m/s^3"]
    assert group.attrs["converged"] == posterior.converged.int().tolist()
    assert group["window"].values.tolist() == [0, 1]


def test_one_window(posterior: Posterior) -> None:
    group = posterior.to_arviz(window=1).posterior
    assert group["K_L"].dims == ("chain", "draw")
    assert torch.equal(torch.from_numpy(group["K_L"].values), posterior["K_L"][..., 1])
    assert group.attrs["converged"] == [1]


def test_arviz_summary_reads_the_same(posterior: Posterior) -> None:
    import arviz

    summary = arviz.summary(posterior.to_arviz(), round_to="none")
    assert summary.loc["T_L[1]", "mean"] == pytest.approx(float(posterior.mean[1, 0]), rel=1e-12)
    # ArviZ pools over all draws as we do, up to n or n - 1
    assert summary.loc["K_L[0]", "sd"] == pytest.approx(float(posterior.sd[0, 1]), rel=2 / 400)
    assert (summary["r_hat"] < 1.1).all()


def test_it_survives_a_file(posterior: Posterior, tmp_path) -> None:
    """Attributes and dimensions are plain enough for NetCDF."""
    pytest.importorskip("h5netcdf")
    import arviz

    path = str(tmp_path / "posterior.nc")
    posterior.to_arviz().to_netcdf(path)
    again = arviz.from_netcdf(path).posterior
    assert again["sigma"].attrs["units"] == "m/s^3"
    assert torch.equal(torch.from_numpy(again["sigma"].values), posterior["sigma"])


def test_every_parameter_has_a_unit_and_strangers_none() -> None:
    assert set(UNITS) == {"T_L", "K_L", "sigma", *NOISE_PRIOR}
    strange = Posterior(("tau",), torch.ones(1, 4, 1, 1, dtype=torch.float64), torch.tensor([False]))
    group = strange.to_arviz().posterior
    assert "units" not in group["tau"].attrs
    assert group.attrs["converged"] == [0]


@pytest.mark.parametrize("window", [-1, 2])
def test_window_out_of_range(posterior: Posterior, window: int) -> None:
    with pytest.raises(InputError, match=f"window: {window}"):
        posterior.to_arviz(window=window)
