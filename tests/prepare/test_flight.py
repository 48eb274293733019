"""A part of the rendered flight of the shared data, whose truth is known: poses, metres and north, drift."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import yaml

from thermosplat.cli import prepare
from thermosplat.datasets.geo_file import read_geo

DATA = Path(os.environ.get("THERMOSPLAT_TEST_DATA", "")) / "flight_a"
PHOTOGRAPHS = 44
"""More than are all matched with all where GPS is known."""


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not DATA.is_dir(), reason="flight_a is not below $THERMOSPLAT_TEST_DATA")
def test_a_folder_becomes_a_capture_in_metres(tmp_path: Path) -> None:
    """The photographs nearest to the middle under shuffled names, and nothing but the folder."""
    truth = json.loads((DATA / "truth.json").read_text())
    poses = {Path(name).stem[:-2]: np.array(pose) for name, pose in truth["camera_to_world"].items()}
    middle = np.median([pose[:2, 3] for pose in poses.values()], axis=0)
    stems = sorted(poses, key=lambda stem: float(np.linalg.norm(poses[stem][:2, 3] - middle)))[:PHOTOGRAPHS]
    numbers = np.random.default_rng(0).permutation(PHOTOGRAPHS)
    renamed = {f"P{number:03}": stem for number, stem in zip(numbers, stems)}
    positions = (DATA / "thermal" / "gps.csv").read_text()
    for folder in ("visible", "thermal"):
        (tmp_path / "in" / folder).mkdir(parents=True)
    for name, stem in renamed.items():
        shutil.copy(DATA / "visible" / f"{stem}_V.JPG", tmp_path / "in" / "visible" / f"{name}_V.JPG")
        shutil.copy(DATA / "thermal" / f"{stem}_T.tiff", tmp_path / "in" / "thermal" / f"{name}_T.tiff")
        positions = positions.replace(f"{stem}_T", f"{name}_T")
    (tmp_path / "in" / "thermal" / "gps.csv").write_text(positions)
    assert prepare.main([str(tmp_path / "in"), "--out", str(tmp_path / "out")]) == 0
    model, geo = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0"), read_geo(tmp_path / "out")
    assert model.num_reg_images() == 2 * PHOTOGRAPHS
    assert geo is not None
    assert geo.residual < 1.0
    assert geo.epsg == 32632
    found, true = [], []
    for image in model.images.values():
        if image.name.endswith("_V.jpg"):
            found.append(image.projection_center())
            true.append(poses[renamed[Path(image.name).stem[:-2]]][:3, 3])
    similarity = pycolmap.estimate_sim3d(np.array(found), np.array(true))
    assert similarity is not None
    matrix = similarity.matrix()
    scale = np.cbrt(np.linalg.det(matrix[:, :3]))
    assert abs(scale - 1) < 0.02  # half a metre of noise over forty metres and forty photographs
    turn = np.degrees(np.arccos((np.trace(matrix[:, :3] / scale) - 1) / 2))
    assert turn < 1.5
    error = np.linalg.norm(np.array(found) @ matrix[:, :3].T + matrix[:, 3] - true, axis=1)
    assert np.median(error) < 0.02
    settings = yaml.safe_load((tmp_path / "out" / "train.yaml").read_text())
    assert settings["spectra"]["thermal"]["exposure"] == "level"
