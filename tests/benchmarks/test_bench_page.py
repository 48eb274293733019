"""The benchmark of the page runs in a real browser."""

from pathlib import Path

import headless_browser
from benchmark_scripts import run_script
from page_scenes import page_layers, page_scene
from thermosplat.export.page.written_page import page_of
from thermosplat.thermal.radiometry import FLIR_IRON

pytestmark = headless_browser.MARKS


def test_page_benchmark_runs(tmp_path: Path) -> None:
    """Each layer of each page has pictures a second, seconds of processor and milliseconds of four parts."""
    pages = [tmp_path / name for name in ("one.html", "two.html")]
    for page in pages:
        page.write_text(page_of(page_scene(), page_layers(30), FLIR_IRON), "utf-8")
    done = run_script("bench_page.py", *map(str, pages), "--size", "64x36", "--rounds", "1", "--pictures", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines()]
    assert rows[0][:4] == ["page", "layer", "pictures a second", "processor seconds"]
    assert [row[:2] for row in rows[2:]] == [[page.name, layer] for page in pages for layer in ("rgb", "thermal")]
    assert all(len(row) == 8 and float(row[2]) > 0 and sum(map(float, row[4:])) > 0 for row in rows[2:])
