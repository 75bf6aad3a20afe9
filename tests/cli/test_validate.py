"""`avtorch validate`: the files it writes, the answer's form, and one line for whatever it cannot use."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import ANY

import pytest

from avtorch.cli import main
from avtorch.cli.validate import export
from avtorch.errors import InputError
from avtorch.io import read_answer
from avtorch.report.validation import validation_notes, validation_table

pytest.importorskip("arviz")
pytest.importorskip("pyro")


@pytest.fixture
def short_nuts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command's NUTS with a tenth of its steps."""
    from avtorch.validation.validate import NutsSettings

    module = sys.modules["avtorch.validation.validate"]
    monkeypatch.setattr(module, "NutsSettings", lambda: NutsSettings(1, 150, 100))


def finite_numbers(table: dict) -> bool:
    return set(table) == {"T_L", "K_L", "sigma"} and all(isinstance(x, float) for x in table.values())


@pytest.mark.slow
def test_synthetic_windows(short_nuts: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep/er"
    arguments = ["validate", "--synthetic", "--windows", "3", "--nuts-windows", "1", "--seed", "2", "--out", str(out)]
    assert main(arguments) == 0
    told = capsys.readouterr().out
    assert "mean error" in told
    assert "sigma [m/s³]" in told
    assert "agree: " in told
    assert "For ArviZ: sgld.nc, nuts.nc, quadrature.nc" in told
    written = {p.name for p in out.iterdir()}
    pictures = {"marginals.png", "ecdf.png", "agreement.png"}
    assert {"validation.json", "sgld.nc", "nuts.nc", "quadrature.nc", *pictures} <= written
    answer = json.loads((out / "validation.json").read_text(encoding="utf-8"))
    assert answer["schema"] == "avtorch.validation/1"
    assert set(answer["files"]) == {name for name in written if not name.startswith(".")} - {"validation.json"}
    summary = answer["summary"]
    assert summary["windows"] == 3
    assert all(finite_numbers(summary[k]) for k in ("mean_difference_sd_p95", "sd_ratio_p025", "sd_ratio_p975"))
    assert finite_numbers(summary["coverage_90"])
    assert set(summary["seconds_per_window"]) == {"sgld", "nuts", "quadrature"}
    assert answer["verdict"] in ("agree", "disagree")
    assert answer["why"].endswith(".")


@pytest.mark.slow
def test_a_log(short_nuts: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from avtorch.vehicle import GLVDPlant, Leader, simulate

    log = tmp_path / "drive.csv"
    run = simulate(Leader.default(duration=15.0), plant=GLVDPlant(0.3, 1.0, sigma=0.1), duration=14.0, seeds=[1])
    run.log().write(log)
    out = tmp_path / "out"
    out.mkdir()
    (out / "nuts.nc").write_text("of an earlier run", encoding="utf-8")
    arguments = ["validate", str(log), "--windows", "2", "--nuts-windows", "1", "--spread", "3", "--chains", "64"]
    assert main([*arguments, "--draws", "16", "--json", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    answer = json.loads(said.out)
    assert answer | {"files": ANY} == read_answer(out / "validation.json")
    assert (answer["settings"]["chains"], answer["settings"]["draws"], answer["settings"]["spread"]) == (64, 16, 3.0)
    assert answer["summary"]["coverage_is"] == "mass of quadrature"
    assert all(entry["truth"] is None for entry in answer["agreement"])
    import arviz

    found = arviz.from_netcdf(str(out / "nuts.nc"))
    assert dict(found.posterior.sizes) == {"chain": 1, "draw": 150, "window": 1}


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "log: neither a log nor --synthetic was given"),
        (["drive.csv", "--synthetic"], "--synthetic: found together with drive.csv"),
        (["--synthetic", "--windows", "0"], "--windows: found 0, needs 1 or more"),
        (["--synthetic", "--windows", "1.5"], "needs a whole number"),
        (["--synthetic", "--nuts-windows", "0"], "--nuts-windows: found 0, needs 1 or more"),
        (["--synthetic", "--chains", "-4"], "--chains: found -4, needs 1 or more"),
        (["--synthetic", "--draws", "2"], "draws: 2 is less than 4"),
        (["--synthetic", "--spread", "-1"], "--spread: found -1"),
        (["--synthetic", "--spread", "nan"], "--spread: found nan"),
        (["--synthetic", "--window", "0"], "--window: found 0"),
        (["--synthetic", "--seed", "-1"], "--seed: found -1"),
        (["--synthetic", "--map", "accel=X"], "--map, --unit, --stamp: found with --synthetic"),
        (["missing.csv"], "missing.csv"),
    ],
)
def test_bad_arguments(arguments: list[str], fault: str, tmp_path: Path, refused: Callable[[list[str]], str]) -> None:
    assert fault in refused(["validate", *arguments, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_missing_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[[list[str]], str]) -> None:
    import avtorch.validation.validate  # noqa: F401

    monkeypatch.setattr(sys.modules["avtorch.validation.validate"], "find_spec", lambda name: None)
    assert "pip install 'avtorch[validate]'" in refused(["validate", "--synthetic", "--out", str(tmp_path)])


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    """NetCDF's libraries raise errors of their own."""

    def full(path: str) -> None:
        raise RuntimeError("NetCDF: HDF error")

    with pytest.raises(InputError, match=r"sgld\.nc: cannot be written \(NetCDF: HDF error\)"):
        export(tmp_path, {"sgld": SimpleNamespace(to_netcdf=full)})  # type: ignore[dict-item]


def test_table_of_a_latent_log_names_its_parameter() -> None:
    row = {"T_L": 0.5, "K_L": 0.25, "sigma": 0.125}
    keys = ("mean_difference_sd_p95", "sd_ratio_p025", "sd_ratio_p975", "w1_sd_p95", "coverage_90", "ess_bulk_median")
    summary = {key: row for key in keys} | {
        "sigma_is": "process_noise",
        "coverage_is": "mass of nuts",
        "not_run": ["quadrature"],
        "seconds_per_window": {"sgld": 1.0, "nuts": 2.0, "quadrature": 0.0},
        "windows": 5,
        "compared": 3,
        "excited": 4,
        "settled": 5,
    }
    answer = {"summary": summary, "reference": "nuts"}
    table = validation_table(answer)
    assert table.rows[2][0] == "process_noise [m/s²/√s]"
    notes = validation_notes(answer)
    assert notes[0].startswith("Over 3 windows against NUTS")
    assert "quadrature" not in notes[1]
