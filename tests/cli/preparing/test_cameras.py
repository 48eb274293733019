"""thermosplat-prepare on whole folders: cameras are found, or a sentence says why not and the exit code is 2."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from camera_folders import scene
from sample_runs import Run
from seen_room import seen_room, write_files
from thermosplat.cli import prepare
from thermosplat.datasets import load_capture
from thermosplat.prepare.capture_folder import CaptureFolder

Change = Callable[[Path], None]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What two cameras wrote of a room."""
    return write_files(seen_room(), tmp_path_factory.mktemp("cameras") / "room")


def each_photograph(change: Callable[[int, np.ndarray], np.ndarray]) -> Change:
    """Replace each photograph by what a function makes of its number and its pixels."""
    return lambda folder: _replace(folder / "visible", change)


def each_thermal(change: Callable[[int, np.ndarray], np.ndarray]) -> Change:
    """The same of thermal images."""
    return lambda folder: _replace(folder / "thermal", change)


def _replace(folder: Path, change: Callable[[int, np.ndarray], np.ndarray]) -> None:
    for number, path in enumerate(sorted(folder.iterdir())):
        cv2.imwrite(str(path), change(number, cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def words(printed: str) -> str:
    """What was printed, without the panel and its line breaks."""
    return " ".join(printed.replace("│", " ").split())


@pytest.mark.slow
def test_photographs_alone(files: Path, run: Run, tmp_path: Path) -> None:
    """Each step says what is left out; the capture of photographs is one that training reads."""
    out = tmp_path / "out"
    code, printed = run(prepare.main, "import", "--rgb", files / "visible", "--out", out)
    assert (code, "12 RGB images of 400x300 px." in printed) == (0, True)
    code, printed = run(prepare.main, "sfm", out)
    assert code == 0
    assert "12 of 12 photographs have a pose" in printed
    assert f"Next: thermosplat-prepare check {out}" in printed
    code, printed = run(prepare.main, "register", out)
    assert code == 2
    assert "has no thermal images" in words(printed)
    code, printed = run(prepare.main, "--rgb", files / "visible", "--out", out)
    assert code == 0
    assert "pair: done." in printed
    assert "nothing to pair" in printed
    assert "sfm: complete already." in printed
    assert "register: left out, because there are no thermal images." in printed
    assert f"Next: thermosplat-train {out} --without thermal" in printed
    assert all(set(frame.views) == {"rgb"} for frame in load_capture(out).train)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (each_photograph(lambda _, image: np.full_like(image, 90)), "fewer than 100 features"),
        (each_photograph(lambda number, _: scene(number, 400, 300)), "has a pose"),
        (each_photograph(lambda number, _: prints(number)), "they match no other photograph (no overlap)"),
        (each_thermal(lambda _, image: image[:, ::-1]), "when they are mirrored"),
    ],
    ids=["blank photographs", "blurred photographs", "photographs without overlap", "mirrored"],
)
def test_what_cannot_be_prepared_ends_with_2(
    files: Path, run: Run, tmp_path: Path, change: Change, message: str
) -> None:
    """The step that fails leaves no mark, and its part of the model is not written."""
    folder, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(files, folder)
    change(folder)
    code, printed = run(prepare.main, folder, "--out", out)
    assert code == 2
    assert message in words(printed)
    capture = CaptureFolder(out)
    assert not capture.marker("register").exists()
    if capture.marker("sfm").exists():
        names = [image.name for image in pycolmap.Reconstruction(capture.sparse).images.values()]
        assert not any(name.startswith("thermal/") for name in names)
    else:
        assert not capture.sparse.exists()
    again, printed = run(prepare.main, folder, "--out", out)
    assert (again, message in words(printed)) == (2, True)


def prints(number: int) -> np.ndarray:
    """A photograph of sharp things that no other photograph shows."""
    generator = np.random.default_rng(number)
    tiles = generator.integers(0, 255, (60, 80, 3)).astype(np.uint8)
    return cv2.resize(tiles, (400, 300), interpolation=cv2.INTER_NEAREST)
