"""Cameras, poses and points that train to nothing without a word are told."""

import json
import os

import numpy as np
import pytest

from capture_folders import rgb_image, synthetic_model, write_colmap_folder, write_image, write_model, write_transforms
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError

FIRST = r"images/frame_eval_00000\.png"


def rewritten(root, content):
    (root / "transforms_thermal.json").write_text(json.dumps(content))
    return root


@pytest.mark.parametrize("far", [1e30, 1e300, -1e13])
def test_cameras_beyond_all_bounds(tmp_path, far):
    """Positions whose squares overflow in float32 are an error."""
    content = write_transforms(tmp_path)
    content["frames"][0]["transform_matrix"][0][3] = far
    with pytest.raises(UserError, match=rf"camera of {FIRST} lies .*e\+\d+ world units from the origin"):
        load_capture(rewritten(tmp_path, content))


@pytest.mark.parametrize("far", [1e6, 100.0])
def test_a_camera_far_from_the_others(tmp_path, far):
    """It may be meant so: a note."""
    content = write_transforms(tmp_path)
    assert not any("far from the others" in note for note in load_capture(tmp_path).notes)
    content["frames"][3]["transform_matrix"][0][3] *= far
    content["frames"][3]["transform_matrix"][1][3] *= far
    content["frames"][3]["transform_matrix"][2][3] *= far
    notes = load_capture(rewritten(tmp_path, content)).notes
    assert any("cameras of 1 of 8 frames lie far from the others (first: images/frame_train_00003" in n for n in notes)


@pytest.mark.parametrize(
    "change",
    [
        *({"fl_x": focal, "fl_y": focal} for focal in (1e30, 1e-30, 0)),
        *({"w": width} for width in (-5, 1e308, 10**300, 2**63)),
        {"cx": 1e30},
        {"k1": 1e30},
        {"w": 4 << 40, "h": 3 << 40, "k1": 0.1, "fl_x": 4e12, "fl_y": 4e12},
    ],
)
def test_impossible_cameras(tmp_path, change):
    """Focal lengths, principal points, lenses and sizes of no photograph."""
    with pytest.raises(UserError, match=f"camera of {FIRST} is impossible") as caught:
        load_capture(rewritten(tmp_path, write_transforms(tmp_path) | change))
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("digits", [400, 5001])
@pytest.mark.parametrize("where", ["w", "fl_x", "pose", "bounds", "k1", "applied_transform", "ply_file_path"])
def test_integers_of_many_digits(tmp_path, where, digits):
    """They fit into no float, and Python does not even write the longer ones."""
    content = write_transforms(tmp_path)
    if where == "pose":
        content["frames"][0]["transform_matrix"][0][3] = "BIG"
    elif where == "bounds":
        bounds = {"absolute_min_temperature": "BIG", "absolute_max_temperature": 5}
        (tmp_path / "temperature_bounds.json").write_text(json.dumps(bounds).replace('"BIG"', "9" * digits))
    elif where == "applied_transform":
        content[where] = [["BIG"] * 4] * 3
        write_model(synthetic_model(8), tmp_path / "sparse" / "0")
    else:
        content[where] = "BIG"
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content).replace('"BIG"', "9" * digits))
    with pytest.raises(UserError) as caught:
        load_capture(tmp_path)
    assert len(str(caught.value)) < 800


def test_deeply_nested_json(tmp_path):
    """The parser's recursion ends as a sentence."""
    write_transforms(tmp_path)
    (tmp_path / "transforms_thermal.json").write_text('{"a": ' + "[" * 100_000 + "]" * 100_000 + "}")
    with pytest.raises(UserError, match="is not readable JSON: it is nested too deeply"):
        load_capture(tmp_path)


@pytest.mark.parametrize("key", ["file_path", "thermal_file_path", "ply_file_path"])
def test_names_of_thousands_of_characters(tmp_path, key):
    """No file has such a name, and the system says so in its own way."""
    content = write_transforms(tmp_path)
    entry = content if key == "ply_file_path" else content["frames"][1]
    entry[key] = "images/" + "x" * 5000 + ".png"
    capture = load_capture(rewritten(tmp_path, content))
    assert len(capture.train) + len(capture.test) == 8
    assert any("x" * 50 in note for note in capture.notes)


def test_names_of_thousands_of_characters_in_a_model(tmp_path):
    """The name fits into COLMAP's file and into no folder."""
    write_colmap_folder(tmp_path)
    for number in range(8):
        write_image(tmp_path / "thermal" / f"{number:04d}.png", rgb_image(number))
    model = synthetic_model(8, cameras=2)
    next(image for image in model.images.values() if image.name == "rgb/0003.png").name = "rgb/" + "x" * 3000
    write_model(model, tmp_path / "sparse" / "0")
    for image in model.images.values():
        if len(image.name) < 100:
            write_image(tmp_path / image.name, rgb_image(0))
    assert "1 images of the COLMAP model have no file and were left out." in load_capture(tmp_path).notes


@pytest.mark.parametrize("linked", [False, True])
def test_one_file_in_two_frames(tmp_path, linked):
    """Under two names it would be trained on and held out."""
    content = write_transforms(tmp_path)
    again = json.loads(json.dumps(content["frames"][1]))
    if linked:
        os.symlink("frame_train_00001.png", tmp_path / "images" / "frame_eval_00009.png")
        again |= {"file_path": "images/frame_eval_00009.png", "thermal_file_path": ""}
    else:
        again |= {"file_path": "images/../images/frame_train_00001.png"}
    content["frames"].append(again)
    with pytest.raises(UserError, match=r"frame_(train_0000|eval_0000).* of two frames are one file"):
        load_capture(rewritten(tmp_path, content))


@pytest.mark.parametrize(
    ("change", "says"),
    [({"w": 320}, "another aspect"), ({"fl_x": 0}, "is impossible"), ({}, r"thermal/.*is 10x20")],
)
def test_files_outside_the_capture_are_named(tmp_path, change, says):
    """Absolute paths that lie elsewhere, in messages about them."""
    content = write_transforms(tmp_path / "capture") | change
    (tmp_path / "capture" / "images").rename(tmp_path / "images")
    for frame in content["frames"]:
        frame["file_path"] = str(tmp_path / frame["file_path"])
    if not change:
        write_image(tmp_path / "capture" / content["frames"][0]["thermal_file_path"], rgb_image(0, 10, 20))
    with pytest.raises(UserError, match=says):
        load_capture(rewritten(tmp_path / "capture", content))


def test_points_in_one_place(tmp_path):
    """They are one point to start from: random ones are taken, and a note says so."""
    write_colmap_folder(tmp_path)
    model = synthetic_model(8)
    for point in model.points3D.values():
        point.xyz = np.ones(3)
    write_model(model, tmp_path / "sparse" / "0")
    capture = load_capture(tmp_path)
    assert len(capture.points) == 50_000
    assert any("has 30 points in 1 places: starting from 50,000 random points" in note for note in capture.notes)
