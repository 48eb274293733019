"""Reading image files of every kind, and refusing damaged ones."""

import cv2
import numpy as np
import pytest

from capture_folders import rgb_image, write_image
from thermosplat.datasets.images.image_files import list_images, read_image, resize
from thermosplat.errors import UserError


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("color.png", rgb_image(0)),
        ("grey.png", rgb_image(0)[..., 0]),
        ("radiometric.png", np.arange(768, dtype=np.uint16).reshape(24, 32) * 80),
        ("float.tiff", np.linspace(-20, 80, 768, dtype=np.float32).reshape(24, 32)),
    ],
)
def test_lossless_files_come_back_as_written(tmp_path, name, image):
    """Colour order, bit depth and values survive."""
    write_image(tmp_path / name, image)
    got = read_image(tmp_path / name)
    assert got.dtype == image.dtype
    np.testing.assert_array_equal(got, image)


def test_alpha_is_dropped(tmp_path):
    """A PNG with transparency gives its colours."""
    rgba = np.dstack([rgb_image(1)[..., ::-1], np.full((24, 32), 128, np.uint8)])
    cv2.imwrite(str(tmp_path / "a.png"), rgba)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), rgb_image(1))


def test_jpeg_orientation_is_ignored(tmp_path):
    """COLMAP's poses refer to the stored pixels, so an EXIF rotation must not turn them."""
    write_image(tmp_path / "a.jpg", rgb_image(2))
    data = (tmp_path / "a.jpg").read_bytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "a.jpg").write_bytes(data[:2] + segment + data[2:])
    assert cv2.imread(str(tmp_path / "a.jpg")).shape == (32, 24, 3)  # the tag is there: OpenCV's default obeys it
    assert read_image(tmp_path / "a.jpg").shape == (24, 32, 3)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tiff"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated_files_are_refused_by_name(tmp_path, name, share):
    """A file that was cut off is an error, not a half-grey picture."""
    write_image(tmp_path / name, rgb_image(3))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(len(data) * share)])
    with pytest.raises(UserError, match="damaged or not an image") as caught:
        read_image(tmp_path / name)
    assert str(tmp_path / name) in caught.value.message


def test_missing_file_is_refused_by_name(tmp_path):
    """A missing file is a UserError."""
    with pytest.raises(UserError, match=r"Cannot read .*none\.png"):
        read_image(tmp_path / "none.png")


def test_tiff_without_photometric_tag(tmp_path):
    """Workswell's TIFFs, which OpenCV 5 refuses, are read with Pillow."""
    pillow = pytest.importorskip("PIL.Image")
    values = np.arange(768, dtype=np.uint16).reshape(24, 32)
    path = tmp_path / "a.tiff"
    pillow.fromarray(values).save(path)
    data = bytearray(path.read_bytes())
    at = int.from_bytes(data[4:8], "little")
    count = int.from_bytes(data[at : at + 2], "little")
    entries = [data[at + 2 + 12 * k : at + 14 + 12 * k] for k in range(count)]
    kept = [entry for entry in entries if int.from_bytes(entry[:2], "little") != 262]
    assert len(kept) == count - 1
    data[at : at + 2 + 12 * count + 4] = len(kept).to_bytes(2, "little") + b"".join(kept) + bytes(4) + bytes(12)
    path.write_bytes(bytes(data))
    np.testing.assert_array_equal(read_image(path), values)


def test_list_images_sorts_and_filters(tmp_path):
    """Only image files, by name, hidden ones left out; a missing folder is empty."""
    for name in ("b.png", "a.JPG", "notes.txt", ".c.png"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "d.tif").write_bytes(b"x")
    assert [path.name for path in list_images(tmp_path)] == ["a.JPG", "b.png"]
    assert [path.name for path in list_images(tmp_path, recursive=True)] == ["a.JPG", "b.png", "d.tif"]
    assert list_images(tmp_path / "none") == []


def test_list_images_follows_links_once(tmp_path):
    """Folders are often links to where the images lie; one that leads back to itself gives nothing twice."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "a.png").write_bytes(b"x")
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb" / "train").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "again").symlink_to(tmp_path / "rgb")
    assert list_images(tmp_path / "rgb", recursive=True) == [tmp_path / "rgb" / "train" / "a.png"]


def test_resize_averages_where_it_shrinks():
    """Half the size is the mean of each 2x2 block; the same size is the same image."""
    image = np.arange(16, dtype=np.float32).reshape(4, 4)
    np.testing.assert_allclose(resize(image, 2, 2), [[2.5, 4.5], [10.5, 12.5]])
    assert resize(image, 4, 4) is image
