"""Point clouds from PLY files of every kind, and damaged ones."""

import numpy as np
import pytest

from capture_folders import write_transforms
from thermosplat.datasets import load_capture
from thermosplat.datasets.transforms.point_cloud import read_point_cloud
from thermosplat.errors import UserError

FIELDS = [(axis, "f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
WORDS = {"f4": "float", "f8": "double", "u1": "uchar"}


def header(kind, count, fields=FIELDS):
    properties = "".join(f"property {WORDS[letter]} {name}\n" for name, letter in fields)
    return f"ply\nformat {kind} 1.0\ncomment made for a test\nelement vertex {count}\n{properties}end_header\n".encode()


def rows(count, fields=FIELDS, order="<"):
    made = np.zeros(count, [(name, order + letter) for name, letter in fields])
    generator = np.random.default_rng(0)
    for name, letter in fields:
        made[name] = generator.integers(0, 256, count) if letter == "u1" else generator.normal(size=count)
    return made


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("fields", [FIELDS, [("nx", "f8"), *FIELDS[3:], ("confidence", "f4"), *FIELDS[:3]]])
def test_kinds_and_orders(tmp_path, kind, fields):
    """Points in the order of the file, whatever lies between them."""
    made = rows(7, fields, ">" if "big" in kind else "<")
    text = "\n".join(" ".join(str(value) for value in row) for row in made.tolist()).encode()
    body = text if kind == "ascii" else made.tobytes()
    (tmp_path / "a.ply").write_bytes(header(kind, 7, fields) + body + b"\n1 2 3\n")
    points, colors = read_point_cloud(tmp_path / "a.ply")
    assert (points.dtype, colors.dtype) == (np.float64, np.uint8)
    np.testing.assert_allclose(points, np.stack([made[axis] for axis in "xyz"], -1), rtol=1e-6)
    np.testing.assert_array_equal(colors, np.stack([made[name] for name in ("red", "green", "blue")], -1))


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_points_that_are_not_finite(tmp_path, kind):
    """They are left out with a note, as the documentation promises."""
    write_transforms(tmp_path)
    made = rows(20)
    made["y"][:3] = np.nan
    text = "\n".join(" ".join(str(value) for value in row) for row in made.tolist()).encode()
    (tmp_path / "sparse_pc.ply").write_bytes(header(kind, 20) + (text if kind == "ascii" else made.tobytes()))
    capture = load_capture(tmp_path)
    assert len(capture.points) == 17
    assert any("3 of 20 starting points are not finite" in note for note in capture.notes)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "it is no PLY file"),
        (b"ply\nformat ascii 1.0\n", "its header has no end"),
        (header("ascii", 10**12) + b"1 2 3 4 5 6", "too short for its 1,000,000,000,000 points"),
        (header("binary_little_endian", 10**12) + bytes(600), "too short for its 1,000,000,000,000 points"),
        (header("binary_little_endian", "9" * 5000), "not a number of vertices"),
        (header("binary_little_endian", -1), "not a number of vertices"),
        (header("binary_middle_endian", 1), "its header is no PLY header"),
        (header("ascii", 1, FIELDS[:4]), "its points lack green, blue"),
        (
            header("ascii", 1, [*FIELDS[:3], *((name, "f4") for name in ("red", "green", "blue"))]),
            "not of the type uchar",
        ),
        (header("ascii", 1) + b"1 2 x 4 5 6", "what is no number"),
        (header("ascii", 1) + b"1 2 3 4 5 600", "levels from 0 to 255"),
        (header("ascii", 1).replace(b"float x", b"list uchar int x"), "which is not known"),
    ],
)
def test_damaged_files(tmp_path, content, says):
    """What is wrong, at once and without memory for what a header claims."""
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(UserError, match=f"a.ply is not a readable point cloud: .*{says}"):
        read_point_cloud(tmp_path / "a.ply")
