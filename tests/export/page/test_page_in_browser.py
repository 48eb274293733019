"""The page in a real browser, opened as a file: its pictures beside the rasterizer's, and what is measured in it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import headless_browser
from page_scenes import BACK, VIEWMAT, page_layers, page_scene
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.page.written_page import page_of
from thermosplat.export.splat_rendering import render_splats
from thermosplat.thermal.radiometry import FLIR_IRON

pytestmark = headless_browser.MARKS
WIDTH, HEIGHT, FOCAL, MIDDLE = 160, 120, (150.0, 140.0), (84.0, 57.0)
PHONE = {"viewport": {"width": 390, "height": 700}, "has_touch": True, "is_mobile": True}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with headless_browser.browser() as running:
        yield running


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "a #scene ü.html"
    path.write_text(page_of(page_scene(), page_layers(), FLIR_IRON), "utf-8")
    return path


class Tab:
    """The page, what it asked for and what it complained about."""

    def __init__(self, browser: Any, file: Path, **how: Any) -> None:
        self.page = browser.new_context(**(how or {"viewport": {"width": 900, "height": 600}})).new_page()
        self.asked: list[str] = []
        self.complaints: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("dialog", lambda dialog: self.complaints.append("a dialog"))
        self.page.goto(file.as_uri())
        self.page.wait_for_selector("html[data-ready='1']", timeout=120_000)

    def look(self) -> None:
        self.page.evaluate("(a) => thermosplat.look(...a)", [VIEWMAT, list(FOCAL), list(MIDDLE), [WIDTH, HEIGHT]])

    def blended(self, layer: str) -> np.ndarray:
        self.look()
        return np.array(self.page.evaluate("(name) => thermosplat.blended(name)", layer)).reshape(HEIGHT, WIDTH, 4)

    def marks(self) -> list[dict[str, Any]]:
        return self.page.evaluate("() => thermosplat.marks.all")


def rasterized(layer: int) -> np.ndarray:
    (fx, fy), (cx, cy) = FOCAL, MIDDLE
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    view = ViewTensors(viewmat=torch.tensor(VIEWMAT), K=K, width=WIDTH, height=HEIGHT)
    one = page_layers()[layer]
    return render_splats(one.splats, view, background=torch.tensor(one.background)).numpy()


def test_colours_are_the_rasterizers(browser: Any, file: Path) -> None:
    """From any pose and off-centre lens; what differs is what few bytes leave out: a level in the mean."""
    picture = Tab(browser, file).blended("rgb")
    shown = picture[..., :3] + (1 - picture[..., 3:]) * np.array(BACK)
    apart = 255 * np.abs(shown - rasterized(0))
    assert rasterized(0).std() > 0.1
    assert apart.mean() < 1.0
    assert np.percentile(apart, 99) < 6


def test_the_cursor_reads_temperatures(browser: Any, file: Path) -> None:
    """The value of a pixel is that of the rasterizer's picture within 0.3 °C for 95% of the pixels."""
    tab = Tab(browser, file)
    tab.look()
    read = np.array(tab.page.evaluate("() => thermosplat.values()"), float).reshape(HEIGHT, WIDTH)
    apart = np.abs(read - (10 + 40 * rasterized(1)[..., 0]))[np.isfinite(read)]
    assert np.isfinite(read).mean() > 0.4
    assert (apart < 0.3).mean() > 0.95
    own = tab.page.evaluate("() => thermosplat.here(80.5, 60.5)")
    assert own == pytest.approx(read[60, 80], abs=1e-3)


def test_it_is_alone_and_takes_names_for_text(browser: Any, file: Path) -> None:
    """No request beside the file itself, no complaint, no script of a stranger's name; the legend has degrees."""
    tab = Tab(browser, file)
    tab.page.mouse.move(600, 300)
    tab.page.wait_for_selector("#value:not([hidden])")
    assert "°C" in tab.page.locator("#value").inner_text()
    assert tab.page.locator("#most").inner_text() == "50.00 °C"
    assert tab.page.evaluate("() => fetch('https://example.org').then(() => 'loaded', () => 'refused')") == "refused"
    assert [url for url in tab.asked if not url.startswith(("file:", "blob:"))] in ([], ["https://example.org/"])
    assert all("example.org" in text or "Refused" in text for text in tab.complaints), tab.complaints
    assert "<img" in tab.page.locator("#list").inner_text()
    assert tab.page.locator("img").count() == 0


def test_measuring(browser: Any, file: Path, tmp_path: Path) -> None:
    """Spots, lines, areas and notes lie on the scene, have lengths in metres, and stay in a page that is saved."""
    tab = Tab(browser, file)
    page = tab.page
    for tool, places in (("spot", [(600, 300)]), ("line", [(560, 300), (640, 300)])):
        page.locator(f"[data-tool={tool}]").click()
        for place in places:
            page.mouse.click(*place)
    page.locator("[data-tool=area]").click()
    for place in ((560, 260), (640, 260), (640, 340), (560, 340)):
        page.mouse.click(*place)
    page.locator("#finish").click()
    page.locator("[data-tool=note]").click()
    page.locator("#note").fill("=cmd <b>look</b>")
    page.mouse.click(600, 320)
    finding, spot, line, area, note = tab.marks()
    assert (finding["name"], spot["name"], line["name"], area["name"], note["name"]) == ("1", "S1", "L1", "A1", "N1")
    assert 10 <= spot["mean"] <= 50
    assert line["minimum"] <= line["mean"] <= line["maximum"]
    apart = np.linalg.norm(np.subtract(*line["points"]))
    assert line["length"] == pytest.approx(apart)
    assert f"{2 * apart:.3g} m," in line["text"]
    assert area["surface"] > 0
    with page.expect_download() as table:
        page.locator("#csv").click()
    table.value.save_as(tmp_path / "table.csv")
    assert '"\'=cmd <b>look</b>"' in (tmp_path / "table.csv").read_text()
    with page.expect_download() as saved:
        page.locator("#save").click()
    saved.value.save_as(tmp_path / "saved.html")
    again = Tab(browser, tmp_path / "saved.html")
    assert again.marks() == tab.marks()
    assert again.complaints == []


def test_wipe_blend_range_and_isotherm(browser: Any, file: Path) -> None:
    """Each changes the picture: the photograph right of the wipe, another palette's range, a band in green."""
    tab = Tab(browser, file)

    def seen() -> np.ndarray:
        tab.page.evaluate("() => thermosplat.draw()")
        return np.frombuffer(tab.page.locator("#picture").screenshot(), np.uint8)

    pictures = [seen()]
    tab.page.locator("#mode").select_option("wipe")
    pictures.append(seen())
    tab.page.locator("#mode").select_option("blend")
    pictures.append(seen())
    tab.page.locator("#mode").select_option("alone")
    tab.page.locator("#low").fill("25")
    tab.page.locator("#low").press("Tab")
    pictures.append(seen())
    tab.page.locator("#isotherm").check()
    tab.page.locator("#from").fill("30")
    pictures.append(seen())
    assert len({picture.tobytes() for picture in pictures}) == 5


def test_fingers_and_keys_move(browser: Any, file: Path) -> None:
    """A tap reads, a drag turns about what is looked at, a key flies; the panel folds on a phone."""
    tab = Tab(browser, file, **PHONE)
    assert not tab.page.locator("#controls").is_visible()
    tab.page.touchscreen.tap(195, 300)
    tab.page.wait_for_selector("#value:not([hidden])")
    eye = "() => thermosplat.camera.eye"
    before = tab.page.evaluate(eye)
    tab.page.mouse.move(195, 300)
    tab.page.mouse.down()
    tab.page.mouse.move(260, 330)
    tab.page.mouse.up()
    turned = tab.page.evaluate(eye)
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(before), rel=0.2)
    assert np.linalg.norm(np.subtract(turned, before)) > 0.2
    tab.page.keyboard.down("w")
    tab.page.wait_for_function("(eye) => thermosplat.camera.eye[2] !== eye[2]", arg=turned)
    tab.page.keyboard.up("w")
