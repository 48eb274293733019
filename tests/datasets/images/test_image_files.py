"""Reading image files of every kind, and refusing damaged ones."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from capture_folders import rgb_image, write_image
from thermosplat.datasets.images.image_bytes import read_header
from thermosplat.datasets.images.image_files import list_images, read_image, read_pixels, resize
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


@pytest.mark.parametrize(("name", "dtype"), [("a.png", np.uint8), ("a.png", np.uint16), ("a.webp", np.uint8)])
def test_alpha_is_a_mask(tmp_path, name, dtype):
    """A transparent pixel counts for nothing, one that is half so counts; colours are as they are stored."""
    color = rgb_image(1).astype(dtype) * (257 if dtype == np.uint16 else 1)
    alpha = np.full((24, 32), np.iinfo(dtype).max, dtype)
    alpha[:3], alpha[3] = 0, 100
    written = [cv2.IMWRITE_WEBP_QUALITY, 101] if name.endswith("webp") else []
    cv2.imwrite(str(tmp_path / name), np.dstack([color[..., ::-1], alpha]), written)
    pixels = read_pixels(tmp_path / name)
    np.testing.assert_array_equal(pixels.image[3:], color[3:])
    np.testing.assert_array_equal(pixels.mask, alpha > 0)
    np.testing.assert_array_equal(read_image(tmp_path / name), pixels.image)
    assert read_header(tmp_path / name)[0].has_alpha
    alpha[:3] = 1
    cv2.imwrite(str(tmp_path / name), np.dstack([color[..., ::-1], alpha]), written)
    assert read_pixels(tmp_path / name).mask is None


def png(depth: int, color: int, rows: np.ndarray, **chunks: bytes) -> bytes:
    """A PNG of stored rows [H, W, bytes of a pixel], with further chunks."""
    parts = {"IHDR": struct.pack(">IIBBBBB", rows.shape[1], rows.shape[0], depth, color, 0, 0, 0), **chunks}
    parts |= {"IDAT": zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows)), "IEND": b""}
    named = ((name.encode() + data, len(data)) for name, data in parts.items())
    body = b"".join(struct.pack(">I", size) + part + struct.pack(">I", zlib.crc32(part)) for part, size in named)
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("depth", [8, 16])
def test_grey_pngs_that_say_what_is_transparent(tmp_path, depth):
    """By one level (GDAL's NoData), or by alpha; 16 bits with alpha come in the wrong order of bytes from OpenCV."""
    levels = np.arange(24 * 32).reshape(24, 32) % 256
    big = levels.astype(np.uint8 if depth == 8 else ">u2")
    path = tmp_path / "a.png"
    path.write_bytes(png(depth, 0, big[..., None], tRNS=(7).to_bytes(2, "big")))
    pixels = read_pixels(path)
    np.testing.assert_array_equal(pixels.image, levels)
    np.testing.assert_array_equal(pixels.mask, levels != 7)
    assert read_header(path)[0].has_alpha
    alpha = np.where(levels == 9, 0, 2**depth - 1).astype(big.dtype)
    path.write_bytes(png(depth, 4, np.stack([big, alpha], -1)))
    if depth == 16:
        with pytest.raises(UserError, match="16-bit grey with an alpha channel, which OpenCV reads wrongly") as caught:
            read_pixels(path)
        assert "magick" in caught.value.hint
        return
    pixels = read_pixels(path)
    np.testing.assert_array_equal(pixels.image, levels)
    np.testing.assert_array_equal(pixels.mask, levels != 9)


@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.jpg"])
@pytest.mark.parametrize("orientation", [3, 6])
def test_orientation_is_ignored(tmp_path, name, orientation):
    """In every format: COLMAP's poses refer to the stored pixels."""
    pillow = pytest.importorskip("PIL.Image")
    exif = pillow.Exif()
    exif[274] = orientation
    image = pillow.fromarray(rgb_image(2))
    plain, turned = tmp_path / f"plain_{name}", tmp_path / name
    image.save(plain, lossless=True)
    image.save(turned, lossless=True, exif=exif)
    np.testing.assert_array_equal(read_image(turned), read_image(plain), strict=True)


@pytest.mark.parametrize("suffix", [".jfif", ".jpe", ".JPEG"])
def test_jpegs_by_other_names(tmp_path, suffix):
    """They are listed and read as JPEGs are."""
    write_image(tmp_path / "a.jpg", rgb_image(0))
    path = (tmp_path / "a.jpg").rename(tmp_path / f"a{suffix}")
    assert list_images(tmp_path) == [path]
    assert read_image(path).shape == (24, 32, 3)


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
