"""Models that pycolmap cannot read: which file, which line, what is there."""

import struct
from pathlib import Path

import pytest

from capture_folders import synthetic_model, write_model
from thermosplat.datasets.colmap.model import read_model
from thermosplat.errors import UserError


def text_model(folder: Path) -> Path:
    synthetic_model(3).write_text(folder)
    return folder


def told(folder: Path) -> str:
    with pytest.raises(UserError, match="incomplete or damaged") as caught:
        read_model(folder)
    assert str(folder) in caught.value.message
    assert caught.value.hint
    assert "Check failed" not in caught.value.message
    return caught.value.message


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_missing_file(tmp_path, kind, name):
    """Its name, and what is there."""
    if kind == "bin":
        write_model(synthetic_model(3), tmp_path)
    else:
        text_model(tmp_path)
    (tmp_path / f"{name}.{kind}").unlink()
    message = told(tmp_path)
    assert f": {name}.{kind} is missing beside " in message
    assert f"rigs.{kind}" in message or f"frames.{kind}" in message


def test_models_without_rigs_are_whole(tmp_path):
    """COLMAP before 3.12 wrote three files."""
    text_model(tmp_path)
    for name in ("rigs", "frames"):
        (tmp_path / f"{name}.txt").unlink()
    assert len(read_model(tmp_path).images) == 3


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            " 40 42",
            " nan 42",
            "line 4 of cameras.txt: camera 1 (PINHOLE, 32x24) has the parameters nan 42 16 12; "
            "expected are numbers for fx, fy, cx, cy.",
        ),
        (" 40 42", " 42", "has the parameters 42 16 12; expected are numbers for fx, fy, cx, cy."),
        (" 40 42", " wide 42", "has the parameters wide 42 16 12"),
        ("PINHOLE", "PIN_HOLE", "camera 1 has the model 'PIN_HOLE', which COLMAP does not have"),
        ("1 PINHOLE 32 24 40 42 16 12", "1 PINHOLE", "'1 PINHOLE' is no camera with model, width"),
    ],
)
def test_wrong_cameras_in_text(tmp_path, old, new, says):
    """The line, the camera and what it has."""
    path = text_model(tmp_path) / "cameras.txt"
    path.write_text(path.read_text().replace(old, new))
    assert says in told(tmp_path)


def test_a_wrong_image_in_text(tmp_path):
    """The line and what it says; lines of points are none of its concern."""
    path = text_model(tmp_path) / "images.txt"
    lines = path.read_text().splitlines()
    second = next(number for number, line in enumerate(lines) if line.endswith("0001.png"))
    lines[second] = "2 nowhere 0001.png"
    path.write_text("\n".join(lines))
    assert f"line {second + 1} of images.txt is no image with pose, camera and name: '2 nowhere 0001.png'" in told(
        tmp_path
    )


def test_an_unknown_model_in_binary(tmp_path):
    """Models have numbers there."""
    write_model(synthetic_model(3, cameras=2), tmp_path)
    path = tmp_path / "cameras.bin"
    content = bytearray(path.read_bytes())
    second = 8 + 24 + 4 * 8
    camera, _ = struct.unpack_from("<Ii", content, second)
    struct.pack_into("<i", content, second + 4, 99)
    path.write_bytes(content)
    assert f"cameras.bin is damaged: camera {camera} has the model number 99, which COLMAP does not have" in told(
        tmp_path
    )


def test_other_damage(tmp_path):
    """pycolmap's reason, without its file and line."""
    path = text_model(tmp_path) / "points3D.txt"
    path.write_text("1 here\n")
    with pytest.raises(UserError, match="incomplete or damaged: ") as caught:
        read_model(tmp_path)
    assert ".cc:" not in caught.value.message
