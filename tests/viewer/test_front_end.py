"""A viewer that serves, and pages that say what they like: what holds is the server's, and ends with the page."""

import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.novel_views.bookmarks import read_bookmarks
from thermosplat.viewer import visitor as visitor_module
from thermosplat.viewer.front_end import Shared, Viewer
from thermosplat.viewer.orbit import orbit
from thermosplat.viewer.picture_sizes import LARGEST_SIDE, MOST_IMAGES
from viewed_toy import viewed_toy

if find_spec("viser") is None:
    pytest.skip("viser is not installed (the extra viewer)", allow_module_level=True)

from page_client import CAMERA, PageClient, wait_for


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Viewer]:
    monkeypatch.setattr(visitor_module, "START_SECONDS", 0.0)
    made = Viewer(viewed_toy(), tmp_path / "measurements", port=0)
    yield made
    made.stop()


def at_start(viewer: Viewer) -> dict[str, object]:
    """The camera that this viewer begins with, as a page says it."""
    scene = viewer.shared.scene
    position, look_at = orbit(scene.start(), scene)
    return {"position": position, "look_at": look_at, "up_direction": tuple(scene.up.tolist())}


def long_work() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.endswith(", long")]


def test_what_a_page_says_is_held_within_limits(viewer: Viewer, capfd: pytest.CaptureFixture[str]) -> None:
    """Sizes, numbers of images, choices, cameras, uploads: clamped or refused, without a traceback; all goes on."""
    page = PageClient(viewer)
    for label, value in (("Width", 20_000), ("Height", -1), ("Images of the path", 10**8), ("Layer", "nothing")):
        page.set(label, value)
    for label, value in (("Palette", "x"), ("Range", None), ("Lowest", float("nan")), ("At rest", "twice")):
        page.set(label, value)
    page.say({**CAMERA, "fov": 0.0})
    page.say({**CAMERA, "position": [1e300, 0.0, 0.0]})
    page.say({"type": "FileTransferStartUpload", "source_component_uuid": page.control("Name")._impl.uuid,
              "transfer_uuid": "t", "filename": "x", "mime_type": "", "part_count": 9, "size_bytes": 9})  # fmt: skip
    page.say({"type": "GuiUpdateMessage", "uuid": page.control("Width")._impl.uuid, "updates": {"removed": True}})
    page.click((0.5, 0.5))
    page.is_heard()
    assert page.control("Width").value == LARGEST_SIDE
    assert page.control("Height").value == 16
    assert page.control("Images of the path").value == MOST_IMAGES
    assert page.control("Layer").value == "thermal"  # where there are degrees it begins with them
    assert page.control("Palette").value == "capture"
    assert page.visitor.view().fov_y == pytest.approx(np.degrees(0.8))
    assert not page.visitor.client.gui._current_file_upload_states
    page.set("Layer", "RGB")
    wait_for(lambda: (shown := page.visitor.session.shown) and shown.wish.first.spectrum == "rgb")
    assert page.control("Beside it").value == "thermal"  # two layers are compared, never one with itself
    said = capfd.readouterr().err
    assert "Traceback" not in said
    assert said.count("\n") < 12


def test_a_video_ends_with_its_tab(viewer: Viewer) -> None:
    """And leaves nothing: the tab is closed, no image of the rest is rendered, and no file is there."""
    page = PageClient(viewer)
    begin_video(page)
    page.set("Video through the bookmarks", True)  # one at a time
    page.is_heard()
    assert len(long_work()) == 1
    page.close()
    wait_for(lambda: not long_work())
    assert not viewer.visitors
    assert [path.name for path in viewer.shared.folder.iterdir()] == ["bookmarks.json"]


def test_a_video_ends_with_the_viewer(viewer: Viewer) -> None:
    """As when Ctrl-C ends the program."""
    begin_video(PageClient(viewer))
    viewer.stop()
    wait_for(lambda: not long_work())
    assert [path.name for path in viewer.shared.folder.iterdir()] == ["bookmarks.json"]


def begin_video(page: PageClient) -> None:
    """One that takes minutes."""
    for x in (0.0, 0.5):
        page.say({**CAMERA, "position": [x, 0.0, 0.0]})
        page.is_heard()
        page.set("Add this view", True)
    for label, value in (("Width", 64), ("Height", 48), ("Images of the path", MOST_IMAGES)):
        page.set(label, value)
    page.set("Video through the bookmarks", True)
    wait_for(long_work)


def test_saved_pictures_are_of_this_view_in_full_size(viewer: Viewer) -> None:
    """Whatever is on the screen: a small picture of a moving camera, a half one, one of another place."""
    page = PageClient(viewer, image_width=96, image_height=72, **at_start(viewer))
    page.set("Layer", "thermal")
    page.set("At rest", "half")
    page.set("Tool", "Spot")
    page.is_heard()
    wait_for(lambda: (shown := page.visitor.session.shown) and shown.full and shown.wish is page.visitor.session.wish)
    page.click((0.5, 0.5))
    page.click((0.4, 0.5))
    page.is_heard()
    assert [made.name for made in page.visitor.session.measurements] == ["S1", "S2"]
    for button in ("Save as CSV and PNG", "Save a picture"):
        for label, value in (("Width", 96), ("Height", 72)):
            page.set(label, value)
        page.set(button, True)
        page.is_heard()
        wait_for(lambda: not long_work())
    (table,) = viewer.shared.folder.glob("*.csv")
    pictures = sorted(viewer.shared.folder.glob("*.png"))
    assert table.read_text(encoding="utf-8").count("\n") == 3
    session = page.visitor.session.aside()
    expected = session.marked(session.render(page.visitor.view(), 96, 72))
    for path in pictures:
        np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], expected)
    assert len(pictures) == 2


def test_the_first_picture_is_of_where_the_viewer_begins(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that loads says where viser's own camera is, and only then where this one begins."""
    monkeypatch.setattr(visitor_module, "START_SECONDS", 1000.0)
    page = PageClient(viewer, position=[3.0, 3.0, 3.0])
    page.is_heard()
    assert page.visitor.pictures == 0
    page.say({**CAMERA, **at_start(viewer)})
    wait_for(lambda: page.visitor.pictures)
    shown = page.visitor.session.shown
    assert shown is not None
    np.testing.assert_allclose(np.linalg.inv(shown.view.viewmat)[:3, 3], at_start(viewer)["position"], atol=1e-6)


def test_bookmarks_are_there_the_next_time(tmp_path: Path, viewer: Viewer) -> None:
    """Names are cleaned, unique and short; another viewer reads the file, and without bookmarks there is none."""
    page = PageClient(viewer)
    for name in ("door", "door", "x" * 500, "\x1b[31m"):
        page.set("Name", name)
        page.is_heard()
        page.set("Add this view", True)
        page.is_heard()
    names = [bookmark.name for bookmark in read_bookmarks(viewer.shared.bookmarks_file)]
    assert names == ["door", "view 2", "x" * 80, "[31m"]
    again = Viewer(viewer.shared.scene, viewer.shared.folder, port=0)
    again.stop()
    assert [bookmark.name for bookmark in again.shared.bookmarks] == names
    for name in names:
        page.set("Fly to", name)
        page.is_heard()
        page.set("Delete it", True)
        page.is_heard()
    assert not viewer.shared.bookmarks_file.exists()
    viewer.shared.bookmarks_file.write_text("{}")
    with pytest.raises(UserError, match="is not a bookmarks file"):
        Viewer(viewer.shared.scene, viewer.shared.folder, port=0)


def test_saved_files_have_names_of_their_own(viewer: Viewer) -> None:
    """Also two of one second; what a program that was ended left half-written is deleted."""
    assert len({viewer.shared.new_file("view") for _ in range(50)}) == 50
    left = viewer.shared.folder / ".path_20260102_030405_001.0123456789abcdef.tmp.mp4"
    left.parent.mkdir()
    left.touch()
    Shared(viewer.shared.renderer, viewer.shared.folder, viewer.shared.turns)
    assert not left.exists()
