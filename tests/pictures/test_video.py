"""Videos and numbered PNGs, read back by OpenCV."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from thermosplat.pictures import video
from thermosplat.pictures.video import write_images
from thermosplat.runs.atomic_writes import NotWrittenError

COLORS = [(200, 30, 30), (30, 200, 30), (30, 30, 200), (200, 200, 30)]


def plain_images(height: int = 48, width: int = 64) -> list[np.ndarray]:
    return [np.full((height, width, 3), color, np.uint8) for color in COLORS]


def frames_of(path: Path) -> list[np.ndarray]:
    reader = cv2.VideoCapture(str(path))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1][..., ::-1])
    return frames


@pytest.mark.parametrize("in_browsers", [True, False])
def test_video_has_every_image_in_order(in_browsers: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each encoder writes all images, in RGB order, and drops a last odd row and column."""
    if in_browsers:
        pytest.importorskip("imageio_ffmpeg", reason='imageio-ffmpeg is not installed (pip install ".[video]")')
    monkeypatch.setattr(video, "browsers_play_videos", lambda: in_browsers)
    path = write_images(iter(plain_images(49, 65)), tmp_path / "videos" / "path", format="mp4", fps=5)
    assert path == tmp_path / "videos" / "path.mp4"
    frames = frames_of(path)
    assert len(frames) == len(COLORS)
    for frame, color in zip(frames, COLORS):
        assert frame.shape == (48, 64, 3)
        np.testing.assert_allclose(frame.mean(axis=(0, 1)), color, atol=12)
    assert [file.name for file in path.parent.iterdir()] == ["path.mp4"]


def test_images_of_other_sizes_are_fitted(tmp_path: Path) -> None:
    """A capture's views may differ in size: the first one decides the video's."""
    images = [*plain_images()[:1], *plain_images(24, 32)[1:]]
    frames = frames_of(write_images(images, tmp_path / "path", format="mp4", fps=5))
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 4
    np.testing.assert_allclose(frames[3].mean(axis=(0, 1)), COLORS[3], atol=12)


def test_pngs_are_numbered(tmp_path: Path) -> None:
    """PNGs are exact and sort in the order of the path."""
    folder = write_images(plain_images(), tmp_path / "path", format="png", fps=5)
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == ["00000.png", "00001.png", "00002.png", "00003.png"]
    np.testing.assert_array_equal(cv2.imread(str(files[2]))[0, 0, ::-1], COLORS[2])


def test_a_shorter_path_leaves_no_images_of_a_longer_one(tmp_path: Path) -> None:
    """Rendered again into the same folder, the sequence ends where the path does; other files stay."""
    write_images(plain_images(), tmp_path / "path", format="png", fps=5)
    (tmp_path / "path" / "mine.png").write_bytes(b"x")
    folder = write_images(plain_images()[:2], tmp_path / "path", format="png", fps=5)
    assert sorted(file.name for file in folder.iterdir()) == ["00000.png", "00001.png", "mine.png"]


def test_pngs_of_frames_have_their_names(tmp_path: Path) -> None:
    """Names in place of numbers; numbered images of an earlier time go."""
    write_images(plain_images(), tmp_path / "path", format="png", fps=5)
    folder = write_images(plain_images()[:2], tmp_path / "path", format="png", fps=5, names=["desk_08", "desk_16"])
    assert sorted(file.name for file in folder.iterdir()) == ["desk_08.png", "desk_16.png"]


def test_no_encoder_means_pngs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no video can be encoded, all images still come out, as PNGs."""

    class Closed:
        fourcc = staticmethod(cv2.VideoWriter.fourcc)

        def __init__(self, *_: object) -> None: ...

        def isOpened(self) -> bool:
            return False

    monkeypatch.setattr(video, "browsers_play_videos", lambda: False)
    monkeypatch.setattr(cv2, "VideoWriter", Closed)
    folder = write_images(iter(plain_images()), tmp_path / "path", format="mp4", fps=5)
    assert len(list(folder.iterdir())) == 4


def test_opencv_is_given_no_name_that_is_not_utf8(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would crash; PNGs are written then."""
    monkeypatch.setattr(video, "browsers_play_videos", lambda: False)
    folder = write_images(iter(plain_images()), tmp_path / "caf\udce9" / "path", format="mp4", fps=5)
    assert len(list(folder.iterdir())) == 4


def test_failing_render_leaves_no_half_video(tmp_path: Path) -> None:
    """If rendering fails half-way, an earlier video stays and nothing half-done is left."""

    def failing():
        yield from plain_images()[:2]
        raise RuntimeError("render failed")

    (tmp_path / "path.mp4").write_bytes(b"earlier")
    with pytest.raises(RuntimeError, match="render failed"):
        write_images(failing(), tmp_path / "path", format="mp4", fps=5)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("path.mp4", b"earlier")]


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_video_without_room_replaces_nothing(share: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An encoder leaves the rest out where the disk is full and does not say so: the earlier video stays."""

    genuine = cv2.VideoWriter

    class Silent:
        fourcc = staticmethod(genuine.fourcc)

        def __init__(self, path: str, *how: object) -> None:
            self.path, self.writer = Path(path), genuine(path, *how)
            self.isOpened, self.write = self.writer.isOpened, self.writer.write

        def release(self) -> None:
            self.writer.release()
            os.truncate(self.path, int(share * self.path.stat().st_size))

    monkeypatch.setattr(video, "browsers_play_videos", lambda: False)
    monkeypatch.setattr(cv2, "VideoWriter", Silent)
    (tmp_path / "path.mp4").write_bytes(b"earlier")
    with pytest.raises(NotWrittenError, match=r"Could not write .*path\.mp4"):
        write_images(plain_images(), tmp_path / "path", format="mp4", fps=5)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("path.mp4", b"earlier")]


def test_what_is_in_the_way_is_said(tmp_path: Path) -> None:
    """A file where the folder shall be, or a folder where the video shall be, is the user's to move."""
    (tmp_path / "path").write_text("mine")
    (tmp_path / "path.mp4").mkdir()
    with pytest.raises(NotWrittenError, match=r"Could not write .*00000\.png"):
        write_images(plain_images(), tmp_path / "path", format="png", fps=5)
    with pytest.raises(NotWrittenError, match=r"Could not write .*path\.mp4"):
        write_images(plain_images(), tmp_path / "path", format="mp4", fps=5)
    with pytest.raises(NotWrittenError, match=r"Could not write .*below\.mp4"):
        write_images(plain_images(), tmp_path / "path" / "below", format="mp4", fps=5)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["path", "path.mp4"]
