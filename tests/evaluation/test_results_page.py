"""The page of a result folder: what is on it, what is escaped, and that it opens in a browser from the disk."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from thermosplat.evaluation.results_page import results_page, write_results_page
from thermosplat.pictures.line_plot import MOST_POINTS, line_plot
from thermosplat.runs.run_directory import RunDirectory

EVIL = "<script>document.title='evil'</script>\"onerror=\"x"


def finished(folder: Path) -> RunDirectory:
    """A result folder whose names try to break out of the page."""
    numbers = {"psnr": 24.5, "ssim": 0.81, "lpips": None}
    metrics = {
        "spectra": ["rgb", "thermal", EVIL],
        "rgb": numbers,
        "thermal": {**numbers, "mae_celsius": 0.4, "bias_celsius": 0.12},
        EVIL: {"psnr": 1.0},
        "steps": 300,
        "num_gaussians": 12345,
        "train_seconds": 83.2,
        "device": EVIL,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    rows = [{"step": s, "loss": 1 / s, "psnr_rgb": 20 + s / 100, "num_gaussians": s} for s in range(10, 310, 10)]
    rows.append({"step": 300, "evaluation": {"rgb": {"psnr": 24.5}, "spectra": ["rgb"]}})
    lines = [json.dumps(row) for row in rows]
    (folder / "metrics.jsonl").write_text("\n".join([*lines, "damaged {", '"no object"']))
    (folder / "renders").mkdir(exist_ok=True)
    for name in ("a view", "<img src=x onerror=alert(1)>"):
        image = np.full((20, 60, 3), (0, 0, 255), np.uint8)
        (folder / "renders" / f"{name}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (folder / "videos").mkdir(exist_ok=True)
    (folder / "videos" / "ellipse_rgb_000300.mp4").write_bytes(b"\0" * 1500)
    return RunDirectory(folder)


def test_the_page_has_numbers_plots_strips_and_videos(tmp_path: Path) -> None:
    """Each section is there, with what the files say."""
    page = results_page(finished(tmp_path / "run"))
    assert "300 steps · 12,345 Gaussians · 1 min 23 s" in page
    assert re.search(
        r"<td>Thermal</td><td>0.400</td><td>\+0.120</td><td>24.50</td><td>0.8100</td>", page, re.IGNORECASE
    )
    assert "MAE [°C]" in page
    assert "bias [°C]" in page
    assert str((tmp_path / "run").resolve()) in page
    assert "LPIPS" not in page  # nobody measured it
    assert page.count("<svg") == 3
    assert page.count("<polyline") == 3
    assert 'src="renders/a%20view.png"' in page
    assert '<video controls preload="metadata" src="videos/ellipse_rgb_000300.mp4">' in page
    assert ">videos/ellipse_rgb_000300.mp4</a>, 1.5 kB<" in page


def test_scenes_that_became_one_are_told(tmp_path: Path) -> None:
    """Since the steps are those of one, and the time that of all."""
    run = finished(tmp_path / "run")
    metrics = json.loads(run.metrics_json.read_text())
    for scenes, start in ((2, "2 scenes that became one · 300 steps"), (1, "300 steps")):
        run.metrics_json.write_text(json.dumps(metrics | {"scenes": scenes}))
        assert f">{start} · 12,345 Gaussians" in results_page(run)


def test_names_of_a_capture_are_text_and_nothing_else(tmp_path: Path) -> None:
    """Markup in spectra, devices and frames is escaped; no script and no address outside is on the page."""
    page = results_page(finished(tmp_path / "run"))
    assert "<script" not in page
    assert "<img src=x" not in page
    assert "&lt;script&gt;" in page
    assert not re.search(r"https?://", page)
    assert "default-src 'none'" in page


def test_an_empty_folder_has_a_page(tmp_path: Path) -> None:
    """What is not there is left out."""
    page = results_page(RunDirectory(tmp_path))
    assert "not finished yet" in page
    assert "<h2>" not in page


def test_somebody_elses_page_stays(tmp_path: Path) -> None:
    """An index.html without our mark is not replaced, nor a link; ours is."""
    run = finished(tmp_path / "run")
    page = tmp_path / "run" / "index.html"
    page.write_text("mine")
    assert write_results_page(run) is None
    assert page.read_text() == "mine"
    page.unlink()
    page.symlink_to(tmp_path / "elsewhere.html")
    assert write_results_page(run) is None
    page.unlink()
    assert write_results_page(run) == page
    first = page.read_text()
    (tmp_path / "run" / "metrics.json").unlink()
    assert write_results_page(run) == page
    assert page.read_text() != first


def test_pictures_behind_links_are_not_shown(tmp_path: Path) -> None:
    """A folder that leads elsewhere adds nothing."""
    run = finished(tmp_path / "run")
    shutil.move(tmp_path / "run" / "renders", tmp_path / "renders")
    (tmp_path / "run" / "renders").symlink_to(tmp_path / "renders")
    assert "<img" not in results_page(run)


def test_plots_of_long_runs_are_thinned() -> None:
    """At most so many points per line, the last one among them; a constant line has a height."""
    svg = line_plot("Loss", {"loss": [(step, 1.0) for step in range(5000)], "empty": []})
    points = re.search(r'points="([^"]*)"', svg)[1].split()
    assert len(points) == MOST_POINTS
    assert points[-1].startswith("456.0,")
    assert "empty" not in svg
    assert line_plot("Loss", {"loss": []}) == ""


def test_a_browser_opens_it_from_the_disk(tmp_path: Path) -> None:
    """Chromium shows the strips, runs nothing, asks the network for nothing and reports no error."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("no chromium is installed")
    page_path = write_results_page(finished(tmp_path / "a run"))
    assert page_path is not None
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        problems: list[str] = []
        asked: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(page_path.as_uri())
        page.wait_for_load_state("load")
        widths = page.eval_on_selector_all("img", "all => all.map(one => { one.loading = 'eager'; return one.src; })")
        page.wait_for_function("[...document.images].every(one => one.complete && one.naturalWidth == 60)")
        assert len(widths) == 2
        assert page.title() == "a run"
        assert page.locator("svg polyline").count() == 3
        assert not problems
        assert all(url.startswith("file:") for url in asked)
        browser.close()
