"""Depths and labels beside a rendered capture."""

import dataclasses
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from capture_folders import write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.ground_truth import read_ground_truth
from thermosplat.errors import UserError
from toy_scene import HEIGHT, WIDTH, toy_capture


def with_truth(root: Path, height: int = HEIGHT, width: int = WIDTH, **arrays: np.ndarray) -> Capture:
    """The toy capture with ground truth of its frame, numbered pixel by pixel."""
    numbered = np.arange(height * width, dtype=np.float32).reshape(height, width)
    values = {"depth_rgb": numbered, "depth_thermal": 2 * numbered, "label": numbered.astype(np.uint8) % 6}
    (root / "ground_truth").mkdir(exist_ok=True)
    np.savez(root / "ground_truth" / "a.npz", **{**values, **arrays})
    return dataclasses.replace(toy_capture(), root=root)


def test_arrays_of_the_images_size(tmp_path: Path) -> None:
    """What the file holds, unchanged, each depth under its spectrum."""
    capture = with_truth(tmp_path)
    truth = read_ground_truth(capture, capture.train[0])
    expected = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    assert np.array_equal(truth.depths["rgb"], expected)
    assert np.array_equal(truth.depths["thermal"], 2 * expected)
    assert np.array_equal(truth.label, expected % 256 % 6)


def test_shrunk_images_take_the_nearest_pixel(tmp_path: Path) -> None:
    """Images a third of the size: the middle pixel of each block of three by three, nothing mixed."""
    capture = with_truth(tmp_path, 3 * HEIGHT, 3 * WIDTH)
    truth = read_ground_truth(capture, capture.train[0])
    numbered = np.arange(9 * HEIGHT * WIDTH).reshape(3 * HEIGHT, 3 * WIDTH)
    assert np.array_equal(truth.depths["rgb"], numbered[1::3, 1::3])
    assert np.array_equal(truth.label, (numbered % 256 % 6)[1::3, 1::3])


def test_depths_of_the_captures_spectra(tmp_path: Path) -> None:
    """One will do; those of a further spectrum are read, others are not."""
    root = with_truth(tmp_path, depth_nir=np.full((HEIGHT, WIDTH), 7.0), depth_uv=np.zeros((2, 2))).root
    capture = dataclasses.replace(toy_capture(others=("nir",)), root=root)
    truth = read_ground_truth(capture, capture.train[0])
    assert list(truth.depths) == ["rgb", "thermal", "nir"]
    assert (truth.depths["nir"] == 7).all()
    np.savez(root / "ground_truth" / "a.npz", depth_thermal=np.ones((HEIGHT, WIDTH)), label=np.zeros((HEIGHT, WIDTH)))
    assert list(read_ground_truth(capture, capture.train[0]).depths) == ["thermal"]


def test_frames_without_ground_truth(tmp_path: Path) -> None:
    """No file, or views of two cameras: nothing. One spectrum alone: what the file holds."""
    assert read_ground_truth(toy_capture(), toy_capture().train[0]) is None
    capture = with_truth(tmp_path)
    assert read_ground_truth(capture, toy_capture(aligned=False).train[0]) is None
    for alone in (toy_capture(rgb=False), toy_capture(thermal=False)):
        assert read_ground_truth(capture, alone.train[0]) is not None


def test_files_that_cannot_be_used(tmp_path: Path) -> None:
    """Another aspect and an unknown label are named."""
    wide = with_truth(tmp_path, HEIGHT, 2 * WIDTH)
    with pytest.raises(UserError, match=r"depth_rgb has shape .*another aspect"):
        read_ground_truth(wide, wide.train[0])
    strange = with_truth(tmp_path, label=np.full((HEIGHT, WIDTH), 9))
    with pytest.raises(UserError, match=r"label has \[9\]"):
        read_ground_truth(strange, strange.train[0])


@pytest.mark.parametrize("content", [b"x", b"", b"no archive" * 100, "a .npy file", "pickled"])
def test_damaged_files(tmp_path: Path, content: bytes | str) -> None:
    """The file, its size and what is expected; nothing of numpy's pickles."""
    capture = with_truth(tmp_path)
    path = tmp_path / "ground_truth" / "a.npz"
    if content == "a .npy file":
        with path.open("wb") as file:
            np.save(file, np.zeros((HEIGHT, WIDTH)))
    elif content == "pickled":
        np.savez(path, depth_rgb=np.array([{}], dtype=object))
    else:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"a\.npz is damaged or of another kind \([\d,]+ bytes\)") as caught:
        read_ground_truth(capture, capture.train[0])
    assert "allow_pickle" not in str(caught.value)
    assert "move ground_truth/ away" in caught.value.hint


def test_missing_and_misshapen_arrays(tmp_path: Path) -> None:
    """What is not there, and what is there in place of numbers or of an image."""
    capture = with_truth(tmp_path)
    path = tmp_path / "ground_truth" / "a.npz"
    np.savez(path, label=np.zeros((HEIGHT, WIDTH)))
    with pytest.raises(UserError, match=r"holds label alone\. Expected .* label and depth_rgb or depth_thermal\."):
        read_ground_truth(capture, capture.train[0])
    np.savez(path, depth_rgb=np.zeros((HEIGHT, WIDTH)))
    with pytest.raises(UserError, match=r"holds depth_rgb alone\."):
        read_ground_truth(capture, capture.train[0])
    np.savez(path, depth_nir=np.zeros((HEIGHT, WIDTH)))
    with pytest.raises(UserError, match=r"holds none of its arrays\. Expected"):
        read_ground_truth(capture, capture.train[0])
    for array, says in ((np.full((HEIGHT, WIDTH), "far"), "holds <U3"), (np.zeros((0, 0)), r"of shape \[0, 0\]")):
        wrong = with_truth(tmp_path, depth_rgb=array)
        with pytest.raises(UserError, match=says):
            read_ground_truth(wrong, wrong.train[0])


def test_damage_is_told_when_the_capture_is_loaded(tmp_path: Path) -> None:
    """Not after the training; files of other frames than the held-out ones are not looked at."""
    root = write_rgbt_scenes(tmp_path, 4)
    (root / "ground_truth").mkdir()
    (root / "ground_truth" / "0001.npz").write_text("x")
    load_capture(root)
    (root / "ground_truth" / "0000.npz").write_text("x")
    with pytest.raises(UserError, match=r"ground_truth/0000\.npz is damaged"):
        load_capture(root)


def test_arrays_that_claim_too_much(tmp_path: Path) -> None:
    """Neither the archive's size nor the array's own is taken on trust."""
    capture = with_truth(tmp_path)
    path = tmp_path / "ground_truth" / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("label.npy", "w") as file:
        for _ in range(300):
            file.write(bytes(1 << 20))
    with pytest.raises(UserError, match="label would unpack to 314,572,800 bytes; 268,435,456 are possible"):
        read_ground_truth(capture, capture.train[0])
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (70_000, 70_000)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("label.npy", header.getvalue() + bytes(64))
    with pytest.raises(UserError, match="is damaged or of another kind"):
        read_ground_truth(capture, capture.train[0])
