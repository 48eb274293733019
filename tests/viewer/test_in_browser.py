"""The viewer in a real browser: a headless chromium shows, reads, wipes, and is forgotten when it is closed."""

import dataclasses
import gc
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import headless_browser
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.viewer.front_end import Viewer
from thermosplat.viewer.view_panel import ViewPanel
from thermosplat.viewer.visitor import Visitor
from viewed_toy import viewed_toy

pytestmark = headless_browser.MARKS
SIZE = {"width": 900, "height": 600}
CLEAR = slice(170, 430), slice(20, 540)
"""Rows and columns of the window that no control lies over."""
PATIENCE = 240.0  # s, on a busy machine


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with headless_browser.browser() as running:
        yield running


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    made = Viewer(viewed_toy(), tmp_path / "measurements", port=0)
    yield made
    made.stop()


class Tab:
    """A page, and the visitor that the viewer sees in it."""

    def __init__(self, browser: Any, viewer: Viewer, url: str | None = None) -> None:
        known = set(viewer.visitors)
        self.page = browser.new_page(viewport=SIZE)
        self.page.goto(url or viewer.url)
        wait_for(lambda: set(viewer.visitors) - known, self.page)
        self.visitor: Visitor = viewer.visitors[next(iter(set(viewer.visitors) - known))]
        self.rest()

    def state(self, name: str) -> str:
        return self.page.locator("#thermosplat-state").get_attribute(f"data-{name}", timeout=1000 * PATIENCE)

    def rest(self) -> None:
        """Wait for the picture at rest, of what is wished now, and until it is drawn."""
        session = self.visitor.session

        def rests() -> bool:
            shown = session.shown
            size = (SIZE["height"], SIZE["width"], 3)
            return shown is not None and shown.full and shown.picture.shape == size and shown.wish is session.wish

        wait_for(rests, self.page)
        wait_for(
            lambda: self.state("full") == "1" and int(self.state("version")) == self.visitor.pictures - 1, self.page
        )
        last = np.zeros(0)

        def is_drawn() -> bool:
            nonlocal last
            self.page.wait_for_timeout(400)  # the page decodes the picture and draws it
            before, last = last, self.screenshot()[CLEAR]
            return last.std() > 0 and np.array_equal(before, last)

        wait_for(is_drawn, self.page)

    def screenshot(self) -> np.ndarray:
        self.page.bring_to_front()
        png = self.page.screenshot()
        return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(np.float32)

    def rendered(self, spectrum: str) -> torch.Tensor:
        """The rasterizer's image from where the tab's camera is, of the size of its window."""
        scene, view = self.visitor.scene, self.visitor.view()
        model: SceneModel = scene.model
        tensors = scene.view(view.viewmat, view.fov_y, SIZE["width"], SIZE["height"])
        with torch.no_grad():
            return model.render({spectrum: tensors}, sh_degree=scene.sh_degree).images[spectrum].clamp(0, 1)

    def choose(self, present: str, value: str) -> None:
        """Choose in the drop-down list that shows a value."""
        self.page.locator(f'input[value="{present}"]:visible').first.click()
        self.page.get_by_role("option", name=value, exact=True).locator("visible=true").first.click()


def wait_for(condition: Callable[[], Any], page: Any) -> None:
    until = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < until, "waited too long"
        page.wait_for_timeout(50)


def jpeg(image: np.ndarray) -> np.ndarray:
    """What JPEG leaves of 8-bit RGB."""
    coded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    return cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1].astype(np.float32)


def test_the_page_shows_the_rasterizers_image(browser: Any, viewer: Viewer) -> None:
    """What is on the screen is SceneModel.render's image after one JPEG, within a level in the mean."""
    tab = Tab(browser, viewer)
    tab.choose("thermal", "RGB")  # it begins with temperatures
    wait_for(lambda: tab.visitor.session.wish.first.spectrum == "rgb", tab.page)
    tab.rest()
    expected = jpeg(np.rint(255 * tab.rendered("rgb").numpy()).astype(np.uint8))[CLEAR]
    seen = tab.screenshot()[CLEAR]
    assert expected.std() > 5
    assert np.abs(seen - expected).mean() < 1.0
    assert np.abs(seen - expected).max() < 12
    assert tab.page.title() == "thermosplat"
    assert tab.page.locator("#ts-legend").inner_text().strip() == "RGB"


def test_the_cursor_reads_the_temperature_of_the_metrics(browser: Any, viewer: Viewer) -> None:
    """The text beside the cursor is scale.value(pixel_intensity(render)), as in metrics.json's MAE, at that pixel."""
    tab = Tab(browser, viewer)
    wait_for(lambda: tab.visitor.session.wish.first.spectrum == "thermal", tab.page)
    tab.rest()
    scale = tab.visitor.scene.scales["thermal"]
    degrees = scale.value(pixel_intensity(tab.rendered("thermal"), scale)).numpy()
    read = set()
    for x, y in ((300, 300), (420, 250), (200, 400)):
        tab.page.mouse.move(x, y)
        wait_for(lambda x=x, y=y: value_text(tab) == f"{degrees[y, x]:.2f} °C", tab.page)
        read.add(value_text(tab))
    assert len(read) > 1
    assert "°C" in tab.page.locator("#ts-legend").inner_text()
    tab.page.mouse.move(800, 60)  # over the controls there is no value
    wait_for(lambda: not tab.page.locator("#ts-value").is_visible(), tab.page)


def value_text(tab: Tab) -> str:
    box = tab.page.locator("#ts-value")
    return box.inner_text() if box.is_visible() else ""


def test_the_wipe_moves(browser: Any, viewer: Viewer) -> None:
    """Dragging its handle moves the edge between the two images, on the page as in the session."""
    tab = Tab(browser, viewer)
    tab.choose("thermal", "RGB")
    wait_for(lambda: tab.visitor.session.wish.first.spectrum == "rgb", tab.page)
    tab.page.get_by_role("button", name="wipe", exact=True).or_(tab.page.get_by_text("wipe", exact=True)).first.click()
    wait_for(lambda: tab.visitor.session.wish.comparison == "wipe", tab.page)
    tab.rest()
    first, second = (np.rint(255 * tab.rendered(name).numpy())[CLEAR] for name in ("rgb", "thermal"))

    def edge() -> int:
        """The column, in the window, at which the picture becomes the second one."""
        seen = tab.screenshot()[CLEAR]
        is_second = np.abs(seen - second).mean(axis=(0, 2)) < np.abs(seen - first).mean(axis=(0, 2))
        return CLEAR[1].start + int(np.argmax(is_second))

    assert edge() == pytest.approx(450, abs=4)
    tab.page.mouse.move(450, 300)
    tab.page.mouse.down()
    for x in (400, 300, 225):
        tab.page.mouse.move(x, 310)
    tab.page.mouse.up()
    wait_for(lambda: abs(tab.visitor.session.wish.share - 0.25) < 0.01, tab.page)
    tab.rest()
    assert edge() == pytest.approx(225, abs=4)
    assert float(tab.state("wipe")) == pytest.approx(0.25, abs=0.01)


def test_moving_makes_smaller_pictures_and_then_a_full_one(browser: Any, viewer: Viewer) -> None:
    """Dragging the mouse moves the camera; the picture that follows is the rasterizer's from the new place."""
    tab = Tab(browser, viewer)
    tab.choose("thermal", "RGB")
    wait_for(lambda: tab.visitor.session.wish.first.spectrum == "rgb", tab.page)
    tab.rest()
    before = tab.visitor.view().viewmat
    tab.visitor.pace.pixels = 200 * 133
    sizes = set()
    tab.page.mouse.move(250, 300)
    tab.page.mouse.down()
    for x in range(255, 330, 5):
        tab.page.mouse.move(x, 300)
        tab.page.wait_for_timeout(30)
        sizes.add(tab.state("size"))
    tab.page.mouse.up()
    wait_for(lambda: not np.allclose(tab.visitor.view().viewmat, before, atol=1e-3), tab.page)
    tab.page.wait_for_timeout(1000)  # the camera glides on
    tab.rest()
    assert any(int(size.split("x")[0]) < SIZE["width"] for size in sizes)
    expected = jpeg(np.rint(255 * tab.rendered("rgb").numpy()).astype(np.uint8))[CLEAR]
    assert np.abs(tab.screenshot()[CLEAR] - expected).mean() < 1.0


def test_the_panel_stays_on_a_phone(browser: Any, viewer: Viewer) -> None:
    """At a width of 390 px, with the list of layers open: all controls in sight, and a tap chooses."""
    context = browser.new_context(viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    page = context.new_page()
    page.goto(viewer.url)
    layer = page.locator('input[value="thermal"]:visible').first
    layer.tap(timeout=1000 * PATIENCE)
    page.get_by_role("option", name="RGB", exact=True).locator("visible=true").first.tap(timeout=1000 * PATIENCE)
    (visitor,) = viewer.visitors.values()
    wait_for(lambda: visitor.session.wish.first.spectrum == "rgb", page)
    page.locator('input[value="RGB"]:visible').first.tap()
    page.wait_for_timeout(1000)
    sizes = page.evaluate("[innerWidth, innerHeight, document.documentElement.scrollWidth]")
    assert sizes == [390, 844, 390]
    for shown in (page.get_by_role("tab", name="View"), page.get_by_role("option", name="thermal", exact=True)):
        box = shown.locator("visible=true").first.bounding_box()
        assert box["x"] >= 0
        assert box["y"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["y"] + box["height"] <= 844
    context.close()


def test_two_tabs_do_not_disturb_each_other(browser: Any, viewer: Viewer) -> None:
    """Layer, palette and camera of one tab leave the other as it was."""
    one, other = Tab(browser, viewer), Tab(browser, viewer)
    before, view = other.screenshot(), other.visitor.view().viewmat
    wish, pictures = other.visitor.session.wish, other.visitor.pictures
    wait_for(lambda: one.visitor.session.wish.first.spectrum == "thermal", one.page)
    one.rest()
    one.choose("capture", "viridis")
    wait_for(lambda: one.visitor.session.display(one.visitor.session.wish.first).palette == "viridis", one.page)
    one.visitor.fly_to(dataclasses.replace(one.visitor.view(), viewmat=moved_up(one.visitor.view().viewmat)))
    one.rest()
    assert other.visitor.session.wish is wish
    assert other.visitor.session.displays == {}
    assert other.visitor.pictures == pictures
    np.testing.assert_allclose(other.visitor.view().viewmat, view, atol=1e-9)
    np.testing.assert_array_equal(other.screenshot()[CLEAR], before[CLEAR])
    assert not np.allclose(one.visitor.view().viewmat, view, atol=1e-2)
    assert one.visitor.key != other.visitor.key


def moved_up(viewmat: np.ndarray) -> np.ndarray:
    other = viewmat.copy()
    other[1, 3] += 0.3
    return other


def test_a_closed_tab_frees_its_memory(browser: Any, viewer: Viewer) -> None:
    """Session, pictures and controls of a tab are gone when it is; so is its thread."""
    tab = Tab(browser, viewer)
    visitor = tab.visitor
    assert visitor.session.shown is not None
    (thread,) = (one for one in threading.enumerate() if one.name == f"viewer {visitor.client.client_id}")
    kept = [weakref.ref(thing) for thing in (visitor, visitor.session, visitor.session.shown, *visitor.panels)]
    pixels = weakref.ref(visitor.session.shown.picture)
    page = tab.page
    del visitor, tab
    page.close()
    anybody = browser.new_page()
    wait_for(lambda: not viewer.visitors, anybody)

    def all_gone() -> bool:
        gc.collect()
        return not thread.is_alive() and pixels() is None and all(thing() is None for thing in kept)

    wait_for(all_gone, anybody)
    anybody.close()


def test_spots_lines_and_files(browser: Any, viewer: Viewer) -> None:
    """The mouse measures a spot, a line and an area; they are listed, saved as CSV and PNG, and deleted."""
    tab = Tab(browser, viewer)
    wait_for(lambda: tab.visitor.session.wish.first.spectrum == "thermal", tab.page)
    tab.rest()
    tab.page.get_by_role("tab", name="Measure").click()
    session = tab.visitor.session

    def use(tool: str) -> None:
        tab.page.get_by_text(tool, exact=True).locator("visible=true").first.click()
        wait_for(lambda: tab.visitor.client.scene._scene_pointer_cb, tab.page)
        tab.page.wait_for_timeout(1000)  # until the page knows

    def click(x: int, y: int) -> None:
        tab.page.mouse.move(x, y)
        tab.page.wait_for_timeout(200)
        tab.page.mouse.click(x, y, delay=150)

    use("Spot")
    click(300, 300)
    wait_for(lambda: len(session.measurements) == 1, tab.page)
    use("Line")
    click(250, 350)
    tab.page.wait_for_timeout(1000)
    click(400, 250)
    wait_for(lambda: len(session.measurements) == 2, tab.page)
    use("Rectangle")
    tab.page.mouse.move(260, 260)
    tab.page.mouse.down()
    tab.page.mouse.move(350, 330, steps=5)
    tab.page.mouse.up()
    wait_for(lambda: len(session.measurements) == 3, tab.page)
    assert [made.name for made in session.measurements] == ["S1", "L1", "R1"]
    scale = tab.visitor.scene.scales["thermal"]
    degrees = scale.value(pixel_intensity(tab.rendered("thermal"), scale)).numpy()
    spot, _, area = session.measurements
    assert spot.numbers.mean == degrees[300, 300]
    assert area.numbers.maximum <= degrees[255:336, 255:356].max() + 1e-4
    assert area.numbers.count == pytest.approx(91 * 71, rel=0.05)
    tab.page.get_by_role("button", name="Save as CSV and PNG").click()
    folder = viewer.shared.folder
    wait_for(lambda: folder.is_dir() and len(list(folder.glob("measurements_*.png"))) == 1, tab.page)
    (table,) = folder.glob("measurements_*.csv")
    assert table.read_text(encoding="utf-8").count("\n") == 4
    tab.page.get_by_role("button", name="Delete the last").click()
    wait_for(lambda: len(session.measurements) == 2, tab.page)
    tab.page.get_by_role("button", name="Undo").click()
    wait_for(lambda: len(session.measurements) == 3, tab.page)
    names = ["S1", "L1", "R1"]
    again = Viewer(viewed_toy(), folder, port=0)  # a restart
    try:
        assert list(again.shared.book.pages.by_name) == names
    finally:
        again.stop()


def test_the_photograph_lies_over_the_render_while_p_is_held(browser: Any, viewer: Viewer) -> None:
    """Down: it is there; up: it is gone."""
    tab = Tab(browser, viewer)
    tab.page.mouse.move(300, 300)
    tab.page.keyboard.down("p")
    wait_for(lambda: tab.visitor.session.wish.over, tab.page)
    tab.page.keyboard.up("p")
    wait_for(lambda: not tab.visitor.session.wish.over, tab.page)


def test_from_elsewhere_the_token_opens_the_page(browser: Any, tmp_path: Path) -> None:
    """The printed address works, websocket and questions included; without the token there is no page."""
    viewer = Viewer(viewed_toy(), tmp_path, host="0.0.0.0", port=0)
    try:
        tab = Tab(browser, viewer)
        tab.page.keyboard.down("p")
        wait_for(lambda: tab.visitor.session.wish.over, tab.page)
        page = browser.new_page()
        reply = page.goto(f"http://127.0.0.1:{viewer.server.get_port()}/")
        assert reply.status == 403
        assert len(viewer.visitors) == 1
    finally:
        viewer.stop()


def test_a_click_on_a_frame_flies_there(browser: Any, viewer: Viewer) -> None:
    """A frustum is clicked where the projection has its frame; the camera ends at that frame's pose."""
    tab = Tab(browser, viewer)
    visitor = tab.visitor
    start = visitor.view()
    back = dataclasses.replace(start, viewmat=start.viewmat.copy())
    back.viewmat[2, 3] += 4.0  # all frames are before the camera then
    visitor.fly_to(back)
    tab.page.get_by_role("tab", name="Cameras").click()
    tab.page.locator("input[type=checkbox]:visible").first.check(force=True)
    tab.rest()
    clicked = visitor.scene.frames[1]
    view = clicked.views["rgb"]
    x, y, z = visitor.view().viewmat[:3] @ np.linalg.inv(view.viewmat)[:, 3]
    focal = SIZE["height"] / 2 / np.tan(np.radians(visitor.view().fov_y) / 2)
    place = SIZE["width"] / 2 + focal * x / z, SIZE["height"] / 2 + focal * y / z
    tab.page.mouse.move(*place)
    tab.page.wait_for_timeout(500)
    tab.page.mouse.click(*place, delay=150)
    wait_for(lambda: np.allclose(visitor.view().viewmat, view.viewmat, atol=1e-3), tab.page)


def test_the_ends_of_the_range_are_those_of_the_picture(browser: Any, viewer: Viewer) -> None:
    """Of depth, whose range nothing but the picture says, "Lowest" and "Highest" show what the colour bar has."""
    tab = Tab(browser, viewer)
    tab.choose("thermal", "depth, RGB")
    wait_for(lambda: tab.visitor.session.wish.first.kind == "depth", tab.page)
    tab.rest()
    shown = tab.visitor.session.shown
    assert shown is not None
    depths = shown.layers[shown.wish.first].field
    low, high = np.nanpercentile(depths, (1, 99))
    panel = next(panel for panel in tab.visitor.panels if isinstance(panel, ViewPanel))
    assert panel.low.value == pytest.approx(low, abs=0.02)
    assert panel.high.value == pytest.approx(high, abs=0.02)
    written = tab.page.locator("input:visible").evaluate_all("inputs => inputs.map(input => input.value)")
    numbers = [float(text) for text in written if text.replace(".", "").isdigit()]
    assert sum(abs(number - high) < 0.02 for number in numbers) == 2  # and the threshold's
