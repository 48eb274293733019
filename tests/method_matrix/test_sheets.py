"""Comparison sheets from the pictures that cells keep."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch

from thermosplat.method_matrix.panels import read_panels, write_panels
from thermosplat.method_matrix.sheets import PANEL_WIDTH, write_sheets
from thermosplat.pictures.image_display import Image8, read_png
from thermosplat.scene.model import SceneModel
from toy_scene import toy_capture, toy_config, toy_model


def toy_panels(folder: Path, root: Path = Path("toy"), others: tuple[str, ...] = (), **config: Any) -> SceneModel:
    capture = dataclasses.replace(toy_capture(others=others), root=root)
    model = toy_model(toy_config(**config), capture)
    held_out = type(capture)(**{**capture.__dict__, "test": capture.train})
    write_panels(folder, model, held_out, sh_degree=1)
    return model


def columns_that_show_something(image: Image8) -> np.ndarray:
    return image.reshape(image.shape[0], -1, 3).any(axis=(0, 2))


def test_panels_come_back(tmp_path: Path) -> None:
    """Truth, render, error and score of each spectrum of the kept frame."""
    toy_panels(tmp_path)
    panels = read_panels(tmp_path)
    assert set(panels) == {("a", "rgb"), ("a", "thermal")}
    assert np.array_equal(panels["a", "rgb"].truth, toy_capture().train[0].views["rgb"].image)
    assert panels["a", "rgb"].render.shape == panels["a", "rgb"].error.shape == (18, 24, 3)
    assert panels["a", "thermal"].score.endswith(" dB")
    assert read_panels(tmp_path / "nowhere") == {}


def test_three_spectra_have_panels_in_their_order(tmp_path: Path) -> None:
    """Values are shown by their palette; a method without the third spectrum is black there."""
    toy_panels(tmp_path / "three", others=("nir",), spectra={"nir": {"opacity": "own"}})
    toy_panels(tmp_path / "two")
    panels = read_panels(tmp_path / "three")
    assert list(panels) == [("a", "rgb"), ("a", "thermal"), ("a", "nir")]
    nir = panels["a", "nir"]
    assert nir.truth.shape == nir.render.shape == (18, 24, 3)
    assert (nir.truth == nir.truth[..., :1]).all()  # grey
    assert nir.palette_end == "0.1 reflectance"
    (written,) = write_sheets(tmp_path, "lab", {"two": tmp_path / "two", "three": tmp_path / "three"})
    sheet = read_png(written)
    assert sheet is not None
    panel_height = 20 + round(18 * PANEL_WIDTH / 24)
    assert sheet.shape == (20 + 3 * (panel_height + 4), 6 * PANEL_WIDTH + 5 * 4, 3)
    first_row, of_two, of_three = (sheet[24 + k * (panel_height + 4) :][:panel_height] for k in range(3))
    third = 4 * PANEL_WIDTH + 4 * 4
    assert columns_that_show_something(first_row)[third : third + PANEL_WIDTH].any()
    assert not columns_that_show_something(of_two)[third:].any()
    assert columns_that_show_something(of_three)[third:].any()


def test_sheet_has_a_row_a_method(tmp_path: Path) -> None:
    """Ground truth, then each method, both spectra beside each other; an absent spectrum stays black."""
    torch.manual_seed(0)
    toy_panels(tmp_path / "full")
    toy_panels(tmp_path / "rgb_only", without=("thermal",))
    written = write_sheets(tmp_path, "lab", {"full": tmp_path / "full", "rgb_only": tmp_path / "rgb_only"})
    assert [path.name for path in written] == ["lab_a.png"]
    sheet = read_png(written[0])
    assert sheet is not None
    panel_height = 20 + round(18 * PANEL_WIDTH / 24)
    assert sheet.shape == (20 + 3 * (panel_height + 4), 4 * PANEL_WIDTH + 3 * 4, 3)
    last_row = sheet[-panel_height:]
    shows = columns_that_show_something(last_row)
    assert shows[:PANEL_WIDTH].any()
    assert not shows[2 * PANEL_WIDTH + 8 :].any()


def test_depth_stands_beside_the_images_where_the_true_one_is_known(tmp_path: Path) -> None:
    """Three pictures per spectrum: true depths in the first row, the rendered ones in those of the methods."""
    depth = np.full((18, 24), 4.0, np.float32)
    depth[:, :4] = 0.0  # sky
    (tmp_path / "capture" / "ground_truth").mkdir(parents=True)
    nearer = np.where(depth > 0, 2.0, 0.0).astype(np.float32)
    truth = {"depth_rgb": depth, "depth_thermal": nearer, "label": np.zeros((18, 24), np.uint8)}
    np.savez(tmp_path / "capture" / "ground_truth" / "a.npz", **truth)
    toy_panels(tmp_path / "full", root=tmp_path / "capture")
    panels = read_panels(tmp_path / "full")
    rgb, thermal = panels["a", "rgb"], panels["a", "thermal"]
    assert rgb.depth_range == "2 to 4"
    assert rgb.true_depth is not None
    assert thermal.true_depth is not None
    assert not rgb.true_depth[:, :4].any()
    blue, red = rgb.true_depth[0, -1].astype(int), thermal.true_depth[0, -1].astype(int)
    assert blue[2] > blue[0]
    assert red[0] > red[2]
    assert rgb.depth is not None
    assert thermal.depth is not None
    assert not np.array_equal(rgb.depth, thermal.depth)
    (written,) = write_sheets(tmp_path, "lab", {"full": tmp_path / "full"})
    sheet = read_png(written)
    assert sheet is not None
    assert sheet.shape[1] == 6 * PANEL_WIDTH + 5 * 4
