"""The workbench in Chromium: from upload to report, switches, a broken file, a cancelled run, two tabs, two logs."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import avtorch
from avtorch.gap import DeadTime, SensorBias, plant
from tests.report.in_chromium import Scheme, marks

# found, not imported: that takes seconds of every worker that only collects
pytestmark = [*marks, pytest.mark.skipif(find_spec("panel") is None, reason="needs the extra app")]
LATEST_MS = 400_000  # a diagnosis takes half a minute of a core; CI's machine has two, and other tests


def drive(path: Path, late: float) -> Path:
    car = plant([DeadTime(late), SensorBias(0.15)], T_L=0.4, sigma=0.05)
    log = avtorch.simulate(avtorch.Leader.default(start=40.0, duration=60.0, dt=0.05), plant=car).log()
    rows = zip(log.time, log.accel_cmd, log.accel, log.speed * 3.6, strict=True)
    lines = ["t;AccReq;LongAcc;VehSpd_kph", *(";".join(f"{x:.5f}" for x in row) for row in rows)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("logs")
    drive(place / "before.csv", 0.1)
    drive(place / "after.csv", 0.5)
    rows = [line.split(";") for line in (place / "before.csv").read_text().splitlines()]
    (place / "speed_alone.csv").write_text("\n".join(f"{row[0]};{row[1]};{row[3]}" for row in rows))
    (place / "broken.csv").write_bytes(b"\x00\x01 no table")
    (place / "<b>odd & name.csv").write_text("time,speed\n0,1\n")
    return place


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    """The workbench as a user starts it; a run is short, as `AVTORCH_DATA` and the network are not needed."""
    words = [sys.executable, "-m", "avtorch.cli", "app", str(folder), "--no-open"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ | {"AVTORCH_DATA": ""}) as process:
        assert process.stdout is not None
        yield process.stdout.readline().split()[-1]
        process.terminate()


def opened(browser: Any, address: str, width: int = 1280, scheme: Scheme = "light") -> Any:
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page.set_default_timeout(60_000)
    page.outside = []
    page.on("request", lambda request: page.outside.append(request.url))
    page.goto(address)
    return page


def is_sound(page: Any, address: str, width: int) -> None:
    """Nothing of another host, nothing cut off, no violation that axe-core finds."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    host = address.rpartition("/")[0]
    assert [url for url in page.outside if not url.startswith((host, "blob:", "data:"))] == []
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    judged = axe.Axe().run(page).response
    assert [(fault["id"], [node["html"][:200] for node in fault["nodes"]]) for fault in judged["violations"]] == []


@pytest.fixture(scope="module")
def diagnosed(browser: Any, address: str, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """An upload, its columns, its run: the folder of the answer."""
    page = opened(browser, address)
    page.set_input_files("#file", str(drive(tmp_path_factory.mktemp("elsewhere") / "mine.csv", 0.3)))
    page.wait_for_url("**log=out*")
    page.get_by_label("accel_cmd", exact=True).wait_for()
    shown = {label: page.get_by_label(label, exact=True).input_value() for label in ("accel_cmd", "accel", "speed in")}
    assert shown == {"accel_cmd": "AccReq", "accel": "LongAcc", "speed in": "km/h"}
    page.get_by_role("button", name="Diagnose").click()
    page.locator("progress").wait_for()
    page.get_by_role("heading", name="Switch effects and see").wait_for(timeout=LATEST_MS)
    assert (folder / "out" / "logs" / "mine.toml").exists()  # the columns as they were confirmed
    assert {"report.html", "credibility.html", "plant.toml"} <= {p.name for p in (folder / "out" / "mine").iterdir()}
    page.close()
    return "out/mine"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_every_step_fits_and_is_accessible(
    browser: Any, address: str, diagnosed: str, width: int, scheme: Scheme
) -> None:
    page = opened(browser, address, width, scheme)
    is_sound(page, address, width)
    page.goto(f"{address}?log=out/logs/mine.csv&answer={diagnosed}")
    page.get_by_role("heading", name="The whole report").wait_for()
    is_sound(page, address, width)
    page.close()


def test_an_effect_switched_off_is_an_error(browser: Any, address: str, diagnosed: str) -> None:
    expect = pytest.importorskip("playwright.sync_api").expect
    page = opened(browser, f"{address}?log=out/logs/mine.csv&answer={diagnosed}")
    error = page.locator("strong", has_text="as set here")
    error.wait_for()
    before = error.text_content()
    box = page.get_by_role("checkbox", name="sensor_bias")
    box.click()
    expect(error).to_contain_text("acceleration 0.1")  # the bias of 0.15 m/s²
    box.click()
    expect(error).to_have_text(before)
    slider = page.get_by_role("slider", name="sensor_bias bias")
    slider.focus()
    for _ in range(5):
        page.keyboard.press("ArrowLeft")
    expect(error).not_to_have_text(before)
    moved = error.text_content()
    for name in ("aerodynamic_drag", "dead_band"):  # what was set and added before stays
        page.get_by_label("Add an effect").select_option(name)
        page.get_by_role("checkbox", name=name).click()
    page.get_by_role("checkbox", name="aerodynamic_drag").wait_for()
    expect(error).to_have_text(moved)
    page.close()


def test_what_is_shown_can_be_kept_and_repeated(browser: Any, address: str, diagnosed: str, folder: Path) -> None:
    page = opened(browser, f"{address}?log=out/logs/mine.csv&answer={diagnosed}")
    with page.expect_download() as saved:
        page.get_by_role("link", name="plant.toml").click()
    assert Path(saved.value.path()).read_bytes() == (folder / diagnosed / "plant.toml").read_bytes()
    line = page.locator("pre").first.text_content()
    assert line == f"cd {folder} && avtorch diagnose out/logs/mine.csv --credibility --out out/mine"
    page.close()


def test_a_log_of_command_and_speed_alone_can_be_diagnosed(browser: Any, address: str) -> None:
    expect = pytest.importorskip("playwright.sync_api").expect
    page = opened(browser, f"{address}?log=speed_alone.csv")
    page.get_by_label("speed in", exact=True).wait_for()
    page.locator("canvas").first.wait_for()
    page.wait_for_timeout(1_000)  # an answer to the drop-downs' own setting would be there
    expect(page.get_by_role("button", name="Diagnose")).to_be_enabled()
    assert page.get_by_role("alert").count() == 0
    assert page.get_by_label("accel in", exact=True).count() == 0
    page.close()


def test_a_broken_file_gets_one_sentence(browser: Any, address: str) -> None:
    page = opened(browser, f"{address}?log=broken.csv")
    alert = page.get_by_role("alert")
    alert.wait_for()
    assert "broken.csv" in alert.text_content()
    assert page.get_by_role("button", name="Diagnose").is_disabled()
    is_sound(page, address, 1280)
    page.close()


@pytest.mark.parametrize("name", ["../secret.csv", "/etc/passwd", "missing.csv"])
def test_what_is_outside_is_refused(browser: Any, address: str, name: str) -> None:
    page = opened(browser, f"{address}?log={name}")
    assert name in page.get_by_role("alert").text_content()
    page.close()


def test_names_are_text(browser: Any, address: str) -> None:
    page = opened(browser, address)
    assert page.get_by_label("<b>odd & name.csv").count() == 1
    page.close()


def test_a_cancelled_run_leaves_nothing_and_another_tab_goes_on(browser: Any, address: str, folder: Path) -> None:
    first, second = (opened(browser, f"{address}?log={name}.csv") for name in ("before", "after"))
    for page in (first, second):
        page.get_by_role("button", name="Diagnose").click()
        page.locator("progress").wait_for()
    first.get_by_role("button", name="Cancel").click()
    first.get_by_text("Cancelled; nothing was written.").wait_for()
    assert not (folder / "out" / "before").exists()
    assert second.locator("progress").count() == 1
    second.get_by_role("button", name="Cancel").click()
    second.get_by_text("Cancelled; nothing was written.").wait_for()
    assert first.get_by_role("button", name="Diagnose").is_enabled()
    for page in (first, second):
        page.close()


def test_two_logs_are_compared(browser: Any, address: str, folder: Path) -> None:
    page = opened(browser, address)
    for name in ("before.csv", "after.csv"):
        page.get_by_label(name, exact=True).check()
    page.get_by_role("button", name="Open").click()
    page.get_by_role("heading", name="Before: after.csv").wait_for()  # in the order of the list
    page.get_by_role("link", name="the other way round").click()
    page.get_by_role("heading", name="Before: before.csv").wait_for()
    page.get_by_role("button", name="Compare").click()
    page.get_by_role("heading", name="The whole report").wait_for(timeout=LATEST_MS)
    assert (folder / "out").joinpath("after").joinpath("comparison.html").exists()
    is_sound(page, address, 1280)
    page.close()
