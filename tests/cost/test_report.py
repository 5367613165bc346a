"""The report page in a real browser, wide and at phone width, and the files beside it."""

import csv
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.common.by import By

from sdfnet.cost.report import write_report
from sdfnet.cost.studies import Point, Study, Timing

PHONE, DESK = (390, 844), (1280, 900)
CHROMIUM_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--hide-scrollbars",
)  # fmt: skip


def studies() -> list[Study]:
    steps = [1e-6, 2e-6, 4e-6]
    leapfrog = [
        Point("leapfrog, lumped mass", f"step {step:.1e} s", 1e11 * step**2, Timing(1e-6 / step, 0.9e-6 / step, 1.2e-6 / step, 5),
              {"products": round(1e-2 / step)},
              is_default=step == 2e-6, overrides=(f"dataset.scene.solver.time_step={step}",))
        for step in steps
    ]  # fmt: skip
    others = [
        Point("exact <in> time & space", "all", 1e-15, Timing(9.0, 9.0, 9.0, 1), is_default=True, is_reference=True),
        Point("modal", "9 modes", failure="too few <modes> for this load"),
    ]
    empty = Study("distances", "Distances", "error (mm)", "seconds", (Point("a library", "float32", failure="not installed"),))
    return [Study("simulation_time", "Simulation in time", "displacement error (mm)", "seconds for 10 ms", (*leapfrog, *others)), empty]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(
        folder, "What accuracy costs: a long_name_of_a_dataset", "measured on two cores", studies(), ["A finding </script> of 0.1 mm."], {"torch": "2.13"}
    )
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[webdriver.Chrome]:
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        missing = pytest.fail if os.environ.get("CI") else pytest.skip
        missing("this test opens the page in Debian's chromium: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in CHROMIUM_FLAGS:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    yield browser
    browser.quit()


def opened(browser: webdriver.Chrome, folder: Path, size: tuple[int, int]) -> None:
    metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.get(f"file://{folder / 'report.html'}")


@pytest.mark.parametrize("size", [PHONE, DESK])
def test_page_shows_every_study_with_nothing_cut_off(browser: webdriver.Chrome, folder: Path, size: tuple[int, int]) -> None:
    opened(browser, folder, size)
    assert browser.execute_script("return window.innerWidth") == size[0]
    assert browser.execute_script("return document.documentElement.scrollWidth") <= size[0]
    plots = browser.find_elements(By.CSS_SELECTOR, ".js-plotly-plot")
    assert [plot.get_attribute("id") for plot in plots] == ["plot-simulation_time", "plot-distances"]
    for plot in plots:
        svg = plot.find_element(By.CSS_SELECTOR, ".main-svg").rect
        assert svg["width"] > 0.7 * size[0] - 60
        assert svg["x"] + svg["width"] <= size[0]
    axes = browser.find_element(By.CSS_SELECTOR, "#simulation_time .axes")
    assert axes.text == "Across: displacement error (mm). Up: seconds for 10 ms."
    assert 0 <= axes.rect["x"] < axes.rect["x"] + axes.rect["width"] <= size[0]
    legend = browser.find_element(By.CSS_SELECTOR, "#plot-simulation_time .legend .bg").rect
    drawn = browser.find_element(By.CSS_SELECTOR, "#plot-simulation_time .gridlayer").rect
    assert drawn["height"] > 200  # the legend leaves room
    assert drawn["y"] + drawn["height"] <= legend["y"]
    assert len(browser.find_elements(By.CSS_SELECTOR, "#plot-simulation_time .scatterlayer .js-line")) == 2  # leapfrog and the front
    # 3 of leapfrog and the star; nothing for the reference, whose error is zero, and for the point that failed
    assert len(browser.find_elements(By.CSS_SELECTOR, "#plot-simulation_time .scatterlayer .points path")) == 4


def test_page_needs_no_network_and_logs_no_error(browser: webdriver.Chrome, folder: Path) -> None:
    browser.get_log("browser")
    opened(browser, folder, DESK)
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
    asked = browser.execute_script("return performance.getEntriesByType('resource').map(entry => entry.name)")
    assert [name for name in asked if not name.startswith(("file:", "blob:", "data:"))] == []


def test_words_of_a_study_are_text_and_never_markup(browser: webdriver.Chrome, folder: Path) -> None:
    opened(browser, folder, DESK)
    assert "A finding </script> of 0.1 mm." in browser.find_element(By.ID, "summary").text
    browser.find_element(By.CSS_SELECTOR, "#simulation_time summary").click()
    rows = browser.find_element(By.CSS_SELECTOR, "#simulation_time table").text
    assert "exact <in> time & space" in rows
    assert "failed: too few <modes> for this load" in rows
    assert "step 2.0e-06 s ★" in rows
    assert "all ★ (reference)" in rows


def test_table_holds_every_point_and_its_reason(folder: Path) -> None:
    with (folder / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["failure"] for row in rows] == ["", "", "", "", "too few <modes> for this load", "not installed"]
    assert [row["is_reference"] for row in rows] == ["0", "0", "0", "1", "0", "0"]
    assert [row["is_default"] for row in rows] == ["0", "1", "0", "1", "0", "0"]
    assert float(rows[0]["seconds_p95"]) == pytest.approx(1.2)
    assert json.loads(rows[0]["counts"]) == {"products": 10_000}
    assert rows[1]["overrides"] == "dataset.scene.solver.time_step=2e-06"


def test_pictures_and_text_are_beside_the_page(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {"report.html", "points.csv", "findings.txt", "simulation_time.png", "distances.png"}
    assert "Nothing could be measured: not installed." in (folder / "findings.txt").read_text()
