"""Notebooks run from top to bottom, with recordings and without, show their pictures, and make true statements.

What a notebook's text says of its figures is kept true here: the claims are checked against the values that the cells
computed.
"""

from __future__ import annotations

import re
import runpy
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from avtorch.gap import EFFECTS

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))
REAL_CARS = FOLDER / "5_real_cars.py"
Names = dict[str, Any]


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[[Path], tuple[Names, list[Path]]]]:
    """Runs a notebook as a script in an empty folder; returns what it left defined, and its pictures."""
    monkeypatch.chdir(tmp_path)
    before = dict(EFFECTS)

    def one(path: Path) -> tuple[Names, list[Path]]:
        wall, cpu = time.perf_counter(), time.process_time()
        names = runpy.run_path(str(path), run_name="notebook")
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        pictures = re.findall(r"^picture: (.+)$", capsys.readouterr().out, re.M)
        with capsys.disabled():
            print(f"\n{path.name}: {wall:.0f} s, {cpu:.0f} s of processor time, {len(pictures)} pictures")
        return names, [tmp_path / p for p in pictures]

    with mpl.rc_context():
        yield one
    EFFECTS.clear()
    EFFECTS.update(before)


def vehicle_and_stability(names: Names) -> None:
    assert names["verdicts"] == {
        "healthy, as built": (True, True),
        "worn, as built": (False, False),
        "worn, time gap 2 s": (False, False),
        "worn, time gap 2.5 s": (False, True),
        "worn, gains 3, 3, -1.8": (False, False),
    }
    assert all(a > b for a, b in pairwise(names["dips"]["healthy"]))
    assert all(a < b for a, b in pairwise(names["dips"]["worn"]))
    assert names["wrongly"] == 0
    assert names["passed"] < names["plane"].string_share
    shares = names["shares"]
    assert shares[0.5, 1.0] < shares[0.5, 0.1] < shares[2.0, 0.1]
    assert shares[0.5, 1.0] < shares[2.0, 1.0] < shares[2.0, 0.1]
    assert names["peak_04"] > 1.7
    assert names["lumped_04"] == pytest.approx(1.0, abs=1e-9)
    assert names["hoped"] < names["enough"]
    assert 0.35 < float(names["p"][names["gaps"] == names["hoped"]][0]) < 0.65


def sgld_nuts_quadrature(names: Names) -> None:
    # Monte Carlo errors of n effective draws: 1 / sqrt(n) SDs in the mean, 1 / sqrt(2 n) in the SD; four each of NUTS,
    # whose fewest are some 270 (sigma), and well above those of SGLD, which has thousands
    effective = dict(zip(names["density"].names, names["reference"].summary()["ess_bulk"], strict=True))
    for name, of_each in names["off"].items():
        for sampler, (mean, ratio) in of_each.items():
            nuts = sampler == "NUTS"
            assert abs(mean) < (4 / np.sqrt(effective[name]) if nuts else 0.1), (name, sampler)
            assert abs(ratio - 1) < (4 / np.sqrt(2 * effective[name]) if nuts else 0.07), (name, sampler)
    for (noise, h), ratios in names["ratio"].items():
        told = 1 / np.sqrt(1 - h / 4) if noise == "independent" else 1.0
        np.testing.assert_allclose(ratios, told, rtol=0.05)
    for n, ratios in names["wide"].items():
        np.testing.assert_allclose(ratios, np.sqrt((1 + 0.3 * 200 / n / 4) / (1 - 0.3 / 4)), rtol=0.1)
    assert names["widths"]["1 / k"] < 0.5
    assert names["widths"]["(1 + k/100)^(-1/3)"] == pytest.approx(1.0, abs=0.15)


def a_drive_watched_and_saved(names: Names) -> None:
    saved, performance = names["saved"], names["performance"]
    assert min(a.time_s for a in saved.alerts[0]) == pytest.approx(28.0)
    first, *_, last = saved.actions[0]
    assert not first.sufficient
    assert first.peak_gain_true > 1.0
    assert last.peak_gain_true == pytest.approx(1.0, abs=1e-9)
    for key in ("accel_rms_ratio", "speed_rms_ratio"):
        assert performance["with_action"][key] < 1 < performance["without_action"][key]
    assert performance["with_action"]["throughput_vph"] < performance["without_action"]["throughput_vph"]
    peaks, drove = names["peaks"], names["drove"]
    for choice in ("time gap", "gains"):
        assert peaks[f"as printed, {choice}"] == pytest.approx(1.0, abs=1e-9)
        assert peaks[f"{choice} alone"] > 1.05
        assert drove["strategist"]["accel_rms_ratio"] < drove[f"{choice} alone"]["accel_rms_ratio"]
    accel = {name: m["accel_rms_ratio"] for name, m in drove.items()}
    assert accel["as printed, time gap"] == pytest.approx(accel["strategist"], abs=0.02)
    assert float(names["advice"]["as printed, time gap"].time_gap[0]) < float(last.setting.time_gap[0])
    assert accel["as printed, gains"] > 1.05 * accel["as printed, time gap"]
    assert min(drove, key=lambda name: drove[name]["clipped_share"]) == "strategist"
    assert float(last.setting.T_d[0]) > 1.0
    grown, calm = names["dips"].values()
    assert calm < 1 < grown


def diagnosing_a_gap(names: Names) -> None:
    found, both, (true,) = names["found"], names["both"], names["case"].names
    assert found.verdict.names == (true,)
    assert found.winner.probability < 0.9
    assert len(found.verdict.alias_set) > 1
    assert names["ahead"] is not None
    assert both.verdict.names == (true,)
    shrinkage = both.shrinkage
    assert shrinkage is not None
    assert shrinkage.top.after < shrinkage.top.before
    assert both.plant is not None


def your_own(names: Names) -> None:
    assert names["error"] == 0.0
    assert names["found"].verdict.name == "pedal_map"
    assert names["quiet"].verdict.name == "unknown"
    assert names["without"].verdict.name == "unknown"
    peaks = [
        names["avtorch"].stability.peak_gain(T, K, names["time_gap"], names["gains"]) for T, K in ((0.3, 1), (1.5, 0.5))
    ]
    assert float(peaks[0].max()) == pytest.approx(1.0, abs=1e-9)
    assert float(peaks[1][0]) > 1.0
    assert float(peaks[1][-1]) == pytest.approx(1.0, abs=1e-9)
    assert bool(names["alone"].rows.collided)
    assert not bool(names["saved"].rows.collided)


def your_simulator(names: Names) -> None:
    assert names["check"].values["dead_time.delay_s"] == pytest.approx(0.1, abs=0.01)
    assert names["check"].values["second_order_actuator.natural_frequency_radps"] == pytest.approx(6.0, rel=0.03)
    assert names["found"].verdict.alias_set == ("dead_band", "constant_resistance")
    assert names["found"].tested.missing == ("dead_band",)
    assert names["errors"]["wrapped"] < 0.1 * names["errors"]["as it was"]


def log_to_repaired_simulator(names: Names) -> None:
    found, advice, compared = names["found"], names["advice"], names["compared"]
    proposal = names["found_in_log"].proposal
    assert proposal.map == {"time": "t_ms", "accel_cmd": "AccReq_mps2", "accel": "IMU_Ax_g", "speed": "VehSpd_kph"}
    assert names["drift"] > 10
    assert found.baseline["T_L"].mean == pytest.approx(0.9, abs=0.05)  # lag and gain alone, refitted
    assert found.baseline["K_L"].mean == pytest.approx(1.1, abs=0.05)
    shares = {part.name: part.share.mean for part in found.budget.parts}
    assert set(shares) == set(names["LACKS"])
    assert shares["constant_resistance"] > 0.9
    for part in found.budget.parts:
        for parameter, true in names["LACKS"][part.name].items():
            assert part.parameters[parameter].mean == pytest.approx(true, rel=0.05)
    assert names["bench"] == pytest.approx(1.0, abs=1e-9)
    assert advice.p_now < 0.05
    assert advice.peak_now > 1.2
    assert advice.sufficient
    assert compared.nearer == "second"
    assert {d.name for d in compared.differences if d.brings_nearer} == set(shares)
    before, after = names["errors"].values()
    assert after < 0.1 * before


CLAIMS: dict[str, Callable[[Names], None]] = {
    "1_vehicle_and_stability": vehicle_and_stability,
    "2_sgld_nuts_quadrature": sgld_nuts_quadrature,
    "3_a_drive_watched_and_saved": a_drive_watched_and_saved,
    "4_diagnosing_a_gap": diagnosing_a_gap,
    "6_your_own": your_own,
    "7_your_simulator": your_simulator,
    "8_log_to_repaired_simulator": log_to_repaired_simulator,
}


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_runs_without_recordings(path: Path, run: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AVTORCH_DATA", raising=False)
    names, pictures = run(path)
    assert all(p.stat().st_size > 5000 for p in pictures)
    assert len(pictures) >= (0 if path == REAL_CARS else 3)
    CLAIMS.get(path.stem, lambda names: None)(names)


@pytest.mark.slow
def test_real_cars_with_recordings(data_dir: Path, run: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVTORCH_DATA", str(data_dir))
    names, pictures = run(REAL_CARS)
    assert len(pictures) == 2
    assert len(names["cars"]) == 4
    for car in names["cars"]:
        own = car.loops[car.law.name]
        assert own.speed < 0.2 * car.keeps_speed
        assert own.amplified > 1
        assert own.amplified_simulated == pytest.approx(own.amplified, rel=0.05)
        assert car.usual.peak_gain.q05 > 1
        assert 1.0 < car.parameters["headway_s"].mean < 1.3
    assert names["as_it_is"].verdict.name == names["named"].verdict.name == "none"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_has_title_cells_and_exercises(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# %% [markdown]\n# # ")
    cells = re.split(r"^# %%.*\n", text, flags=re.M)[1:]
    kinds = re.findall(r"^# %%(.*)$", text, re.M)
    words = [cell for cell, kind in zip(cells, kinds, strict=True) if kind]
    assert "# ## Try this\n" in words[-1]
    assert kinds[-1]
    assert len(words) >= 5
    for cell, kind in zip(cells, kinds, strict=True):
        lines = cell.strip().splitlines()
        assert len(lines) <= 45
        if kind:
            assert all(line.startswith("#") for line in lines)
    for page in re.findall(r"\]\(([^)#]+)\)", "".join(words)):
        assert (FOLDER / page).exists(), page


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_is_listed(path: Path) -> None:
    assert f"]({path.name})" in (FOLDER / "README.md").read_text(encoding="utf-8")
