"""Masks of images: found by name in every layout, joined with transparency, carried to the view."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_folders import (
    HEIGHT,
    WIDTH,
    centikelvin,
    rgb_image,
    spectra_with,
    synthetic_model,
    temperatures,
    write_colmap_folder,
    write_image,
    write_model,
    write_rgbt_scenes,
    write_rig,
    write_transforms,
)
from thermosplat.datasets import Capture, load_capture
from thermosplat.datasets.images.masks import filled, masks_by_spectrum, read_mask
from thermosplat.errors import UserError

MASK = np.full((HEIGHT, WIDTH), 255, np.uint8)
MASK[:8, 4:] = 0


def masks_of(capture: Capture, spectrum: str) -> dict[str, np.ndarray | None]:
    frames = sorted((*capture.train, *capture.test), key=lambda frame: frame.name)
    return {frame.name: frame.views[spectrum].pixels().mask for frame in frames}


@pytest.mark.parametrize("name", ["{stem}.png", "{stem}.png.png", "rgb/{stem}.png", "train/{stem}.png"])
def test_masks_by_their_names(tmp_path: Path, name: str) -> None:
    """By the image's stem, or with its ending (COLMAP), perhaps in the spectrum's folder; of photographs alone."""
    root = write_rgbt_scenes(tmp_path)
    for stem in ("0001", "0002"):
        write_image(root / "masks" / name.format(stem=stem), MASK)
    capture = load_capture(root)
    masks = masks_of(capture, "rgb")
    np.testing.assert_array_equal(masks["0001"], MASK > 0)
    assert [stem for stem, mask in masks.items() if mask is not None] == ["0001", "0002"]
    assert set(masks_of(capture, "thermal").values()) == {None}
    assert "2 of 8 RGB images have pixels that do not count (masks, transparency), 7.3% of all." in capture.notes


def test_masks_of_each_spectrum(tmp_path: Path) -> None:
    """Of thermal images those in thermal/; a mask of no image is told of."""
    root = write_rgbt_scenes(tmp_path, folders=False)
    write_image(root / "masks" / "0001.png", MASK)
    write_image(root / "masks" / "IR" / "0002.png.png", MASK)
    write_image(root / "masks" / "0099.png", MASK)
    assert {name: len(masks) for name, masks in masks_by_spectrum(root, spectra_with()).items()} == {
        "rgb": 2,
        "thermal": 1,
    }
    capture = load_capture(root)
    assert [name for name, mask in masks_of(capture, "rgb").items() if mask is not None] == ["0001"]
    assert [name for name, mask in masks_of(capture, "thermal").items() if mask is not None] == ["0002"]
    assert "1 masks are of no image (first: masks/0099.png)." in capture.notes


def test_masks_of_a_rig(tmp_path: Path) -> None:
    """The folders of the model's names are those below masks/."""
    write_rig(tmp_path)
    write_image(tmp_path / "masks" / "rgb" / "0001.png.png", MASK)
    write_image(tmp_path / "masks" / "thermal" / "0002.png", MASK[:16, :20])
    capture = load_capture(tmp_path)
    assert [name for name, mask in masks_of(capture, "rgb").items() if mask is not None] == ["0001"]
    np.testing.assert_array_equal(masks_of(capture, "thermal")["0002"], MASK[:16, :20] > 0)


def test_masks_that_a_transforms_file_names(tmp_path: Path) -> None:
    """nerfstudio's mask_path, thermal_mask_path for the thermal image, else those in masks/; missing ones are told."""
    content = write_transforms(tmp_path)
    frames = content["frames"]
    write_image(tmp_path / "m" / "a.png", MASK)
    write_image(tmp_path / "masks" / Path(frames[3]["file_path"]).name, MASK)
    frames[1]["mask_path"] = "m\\a.png"
    frames[2]["thermal_mask_path"] = str(tmp_path / "m" / "a.png")
    frames[5]["mask_path"] = "m/none.png"
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert [name[-1] for name, mask in masks_of(capture, "rgb").items() if mask is not None] == ["1", "3"]
    assert [name[-1] for name, mask in masks_of(capture, "thermal").items() if mask is not None] == ["2"]
    assert any("1 masks that transforms_thermal.json names do not exist" in note for note in capture.notes)
    frames[5]["mask_path"] = 5
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"mask_path of frame 5 .* must be a file name, found 5"):
        load_capture(tmp_path)


def test_transparency_and_mask_together(tmp_path: Path) -> None:
    """A pixel counts that counts in both."""
    root = write_colmap_folder(tmp_path)
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:, 20:] = 0
    cv2.imwrite(str(root / "images" / "0001.png"), np.dstack([rgb_image(1), alpha]))
    write_image(root / "masks" / "0001.png", MASK)
    capture = load_capture(root)
    np.testing.assert_array_equal(masks_of(capture, "rgb")["0001"], (MASK > 0) & (alpha > 0))


def test_values_under_a_mask_set_no_range(tmp_path: Path) -> None:
    """An engine, a lamp, pixels without a value: neither range nor unit nor metrics see them."""
    root = write_colmap_folder(tmp_path)
    for number in range(8):
        values = centikelvin(temperatures(number))
        values[MASK == 0] = 0 if number % 2 else 60_000
        write_image(root / "thermal" / f"{number:04d}.png", values)
        write_image(root / "masks" / "thermal" / f"{number:04d}.png", MASK)
    capture = load_capture(root)
    low, high = capture.scales["thermal"].range or (0, 0)
    counting = np.stack([temperatures(number)[MASK > 0] for number in range(8)])
    assert low == pytest.approx(counting.min(), abs=0.01)
    assert high == pytest.approx(counting.max(), abs=0.01)
    view = capture.train[0].views["thermal"]
    assert view.values is not None
    np.testing.assert_array_equal(np.isnan(view.values), MASK == 0)


@pytest.mark.parametrize("data_factor", [1, 2])
def test_what_is_mixed_with_masked_pixels_is_masked(tmp_path: Path, data_factor: int) -> None:
    """Undistorted and shrunk views: pixels count that are made of counting ones alone."""
    params = (40.0, 40.0, 16.0, 12.0, -0.2, 0.05, 0.0, 0.0)
    write_model(synthetic_model(8, camera_model="OPENCV", params=params), tmp_path / "sparse" / "0")
    for number in range(8):
        image = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
        image[MASK == 0] = 0
        write_image(tmp_path / "images" / f"{number:04d}.png", image)
        write_image(tmp_path / "masks" / f"{number:04d}.png", MASK)
    view = load_capture(tmp_path, data_factor=data_factor).train[0].views["rgb"]
    assert view.mask is not None
    assert view.mask.shape == view.image.shape[:2]
    assert (view.image[view.mask] == 200).all()
    assert 0.3 < view.mask.mean() < 0.9


def test_a_mask_of_another_size(tmp_path: Path) -> None:
    """It is fitted to its image, of another aspect it is refused."""
    small = np.array([[255, 255], [0, 255]], np.uint8)
    write_image(tmp_path / "a.png", small)
    larger = read_mask(tmp_path / "a.png", 8, 8)
    assert not larger[np.kron(small == 0, np.ones((4, 4), np.bool_))].any()
    assert larger[0].all()
    write_image(tmp_path / "b.png", np.kron(small, np.full((2, 2), 1, np.uint8)))
    np.testing.assert_array_equal(read_mask(tmp_path / "b.png", 2, 2), small > 0)
    with pytest.raises(UserError, match=r"The mask .*a\.png is 2x2, and its image 32x24: another aspect"):
        read_mask(tmp_path / "a.png", 32, 24)


def test_black_is_what_does_not_count(tmp_path: Path) -> None:
    """Any level above, in grey or colour: masks of 0 and 1 are as good as those of 0 and 255."""
    color = np.zeros((2, 2, 3), np.uint8)
    color[0, 1], color[1, 0] = (0, 0, 9), (1, 1, 1)
    write_image(tmp_path / "a.png", color)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png", 2, 2), [[False, True], [True, False]])


def test_masks_that_are_black_everywhere(tmp_path: Path) -> None:
    """Of all images of a spectrum: black and white are the wrong way round. Of one: it is said."""
    root = write_rgbt_scenes(tmp_path)
    write_image(root / "masks" / "0000.png", 0 * MASK)
    assert any("of 1 images none counts" in note for note in load_capture(root).notes)
    for number in range(8):
        write_image(root / "masks" / f"{number:04d}.png", 0 * MASK)
    with pytest.raises(UserError, match="No pixel of the RGB images counts: their masks are black everywhere"):
        load_capture(root)


@pytest.mark.parametrize("masked", [True, False])
def test_images_that_stay_on_the_disk(tmp_path: Path, masked: bool) -> None:
    """They have the masks that they would have in memory; images that might have one have one that is white."""
    root = write_rgbt_scenes(tmp_path, folders=False)
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    cv2.imwrite(str(root / "rgb" / "0002.png"), np.dstack([rgb_image(2), alpha]))
    if masked:
        write_image(root / "masks" / "0001.png", MASK)
    in_memory, on_disk = load_capture(root), load_capture(root, image_memory=1e-9)
    assert set(masks_of(in_memory, "thermal").values()) == set(masks_of(on_disk, "thermal").values()) == {None}
    for name, mask in masks_of(on_disk, "rgb").items():
        expected = masks_of(in_memory, "rgb")[name]
        if name == "0002":
            expected = np.ones((HEIGHT, WIDTH), np.bool_)
        assert (mask is None) == (expected is None)
        if mask is not None:
            np.testing.assert_array_equal(mask, expected)
    assert f"{1 + masked} of 8 RGB images may have pixels that do not count (masks)." in on_disk.notes


def test_filled_values_keep_their_type() -> None:
    """Whole numbers stay whole; where nothing counts there is no median."""
    values = np.array([[1, 2, 900]], np.uint16)
    got = filled(values, np.array([[True, True, False]]))
    np.testing.assert_array_equal(got, np.array([[1, 2, 1]], np.uint16), strict=True)
    np.testing.assert_array_equal(filled(values, np.zeros((1, 3), np.bool_)), 0 * values)
    assert filled(values, None) is values
