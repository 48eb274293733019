"""Text models as people, programs and editors leave them are read as COLMAP's own."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from capture_folders import synthetic_model
from thermosplat.datasets.colmap.model import ColmapModel, read_model
from thermosplat.errors import UserError

Edit = Callable[[str], str]
FILES = ("cameras", "images", "points3D", "rigs", "frames")


def text_model(folder: Path, edit: Edit = str, names: Callable[[int], str] = "{:04d}.png".format) -> Path:
    """A model of three images, each file of which is edited."""
    model = synthetic_model(3)
    for image in model.images.values():
        image.name = names(image.frame_id - 1)
    model.write_text(folder)
    for name in FILES:
        path = folder / f"{name}.txt"
        path.write_bytes(edit(path.read_text()).encode(errors="surrogateescape"))
    return folder


def assert_same(found: ColmapModel, expected: ColmapModel) -> None:
    """Names, cameras, poses and points."""
    assert [image.name for image in found.images] == [image.name for image in expected.images]
    for one, other in zip(found.images, expected.images, strict=True):
        assert one.lens == other.lens
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.point_colors, expected.point_colors)


def each_line(edit: Edit) -> Edit:
    return lambda text: "".join(f"{edit(line)}\n" for line in text.splitlines())


EDITS: dict[str, Edit] = {
    "as it is": str,
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "CR": lambda text: text.replace("\n", "\r"),
    "tabs": lambda text: text.replace(" ", "\t"),
    "several spaces": lambda text: text.replace(" ", "   "),
    "trailing blanks": each_line(lambda line: f"{line} \t "),
    "indented": each_line(lambda line: f"  {line}"),
    "a mark": lambda text: f"\ufeff{text}",
    "no comments": lambda text: "".join(f"{line}\n" for line in text.splitlines() if not line.startswith("#")),
    "more comments": each_line(lambda line: f"{line}\n  # a remark, 1 2 3"),
    "no end": lambda text: text.rstrip("\n"),
    "lines of blanks": lambda text: f"\n \n{text}\n\t\n",
}


@pytest.mark.parametrize("kind", EDITS)
def test_what_editors_and_writers_do(kind: str, tmp_path: Path) -> None:
    """Line ends, blanks, comments and byte-order marks change nothing."""
    expected = read_model(text_model(tmp_path))
    assert_same(read_model(text_model(tmp_path, EDITS[kind])), expected)


def test_utf_16(tmp_path: Path) -> None:
    """As Windows' shells write files."""
    expected = read_model(text_model(tmp_path))
    for name in FILES:
        path = tmp_path / f"{name}.txt"
        path.write_bytes(path.read_text().encode("utf-16"))
    assert_same(read_model(tmp_path), expected)


@pytest.mark.parametrize(
    "names",
    [
        "Photo ({}).jpg",
        "a/second folder/{}  two.png",
        "5 6 {}",
        "# {}.png",
        "Fenster über {}.JPG",
        "C:\\my pictures\\{}.jpg",
    ],
)
def test_names_are_the_rest_of_the_line(names: str, tmp_path: Path) -> None:
    """With spaces, numbers, backslashes, and what would be a comment elsewhere."""
    found = [str(image.name) for image in read_model(text_model(tmp_path, names=names.format)).images]
    assert found == sorted(names.format(k).replace("\\", "/") for k in range(3))


@pytest.mark.parametrize("names", ["{:04d}.png", "Photo ({}).jpg", "{:04d}"])
def test_images_without_their_second_lines(names: str, tmp_path: Path) -> None:
    """Every second image would be taken for points: the line is named, and what it lacks."""
    text_model(tmp_path, names=names.format)
    path = tmp_path / "images.txt"
    ends = ("#", *(f" {names.format(number)}" for number in range(3)))
    kept = [line for line in path.read_text().splitlines() if line.startswith("#") or line.endswith(ends)]
    path.write_text("\n".join(kept) + "\n")
    second = kept.index([line for line in kept if not line.startswith("#")][1]) + 1
    with pytest.raises(UserError, match=f"line {second} of images.txt must have points") as caught:
        read_model(tmp_path)
    assert "write an empty line below every image" in caught.value.message


@pytest.mark.parametrize(
    ("name", "line", "said"),
    [
        ("points3D", "7 0.5 here 0.5 1 2 3 0", "of points3D.txt is no point with id, x, y, z"),
        ("points3D", "7 0,5 0,5 0,5 1 2 3", "of points3D.txt is no point"),
        ("images", "1 1 0 0 0 0,5 0 0 1 a.png", "of images.txt is no image with pose"),
        ("images", "one 1 0 0 0 5 0 0 1 a.png", "of images.txt is no image with pose"),
        ("images", "1 1 0 0 0 5 0 0 1", "of images.txt is no image with pose, camera and name: '1 1 0 0 0 5 0 0 1'"),
        ("cameras", "1 PINHOLE 32 24 1_0 42 16 12", "has the parameters 1_0 42 16 12"),
    ],
)
def test_wrong_lines(name: str, line: str, said: str, tmp_path: Path) -> None:
    """Decimal commas and words are told with their line."""
    text_model(tmp_path)
    path = tmp_path / f"{name}.txt"
    path.write_text(f"{path.read_text()}\n{line}\n")
    number = len(path.read_text().splitlines())
    with pytest.raises(UserError, match="incomplete or damaged") as caught:
        read_model(tmp_path)
    assert f"line {number} of {name}.txt" in caught.value.message
    assert said.removeprefix("of ") in caught.value.message
