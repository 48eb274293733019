"""TIFFs of every kind give the samples that tifffile wrote, or a sentence: never others."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import tifffile

from thermosplat.datasets.images import tiff_pixels
from thermosplat.datasets.images.image_files import read_image, read_pixels
from thermosplat.datasets.large_captures import read_header
from thermosplat.errors import UserError
from tiff_files import NODATA, ORIENTATION, TYPES, TiffKind, tiff_file, tiff_kinds

GREY16 = (np.arange(24 * 32).reshape(24, 32) * 40 + 1000).astype(np.uint16)
COLOR = np.dstack([GREY16 // 200, GREY16 // 250, 255 - GREY16 // 200]).astype(np.uint8)


def check(path: Path, kind: TiffKind) -> bool:
    """Hold the reader against what was written; whether there was an image."""
    path.write_bytes(kind.file())
    try:
        pixels = read_pixels(path)
    except UserError as error:
        if "imagecodecs" not in error.hint:
            raise
        return False
    truth = kind.samples_of()
    truth = truth.astype(np.float32) if truth.dtype == np.float16 else truth
    image = truth if kind.samples == 1 else truth[..., 0] if kind.samples == 2 else truth[..., :3]
    np.testing.assert_array_equal(pixels.image, image, strict=True, err_msg=str(kind))
    assert pixels.void is None
    assert (pixels.mask is None) == (kind.alpha is None), kind
    if kind.alpha is not None:
        np.testing.assert_array_equal(pixels.mask, truth[..., kind.alpha] > 0, err_msg=str(kind))
    header = read_header(path)[0]
    assert header is not None
    assert (header.height, header.width, header.channels) == (*image.shape[:2], 1 if image.ndim == 2 else 3)
    assert header.has_alpha == (kind.alpha is not None)
    return True


@pytest.mark.rotating
@pytest.mark.parametrize("codecs", [True, False])
@pytest.mark.parametrize("dtype", TYPES)
def test_every_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dtype: str, codecs: bool) -> None:
    """Depth, samples, planes, compression, tiles, byte order, BigTIFF, orientation; with imagecodecs and without."""
    if codecs:
        pytest.importorskip("imagecodecs")
    else:
        without_imagecodecs(monkeypatch)
    kinds = list(tiff_kinds(dtype, every=False))
    read = [check(tmp_path / "a.tif", kind) for kind in kinds]
    assert all(done for done, kind in zip(read, kinds) if codecs or kind.compression is None)
    if dtype in ("uint16", "float32"):  # what cameras write needs nothing more
        usual = [kind.samples in (1, 3) and kind.planar == "contig" and kind.compression != "zstd" for kind in kinds]
        assert all(done for done, is_usual in zip(read, usual) if is_usual)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", TYPES)
def test_all_combinations(tmp_path: Path, dtype: str) -> None:
    """As ``test_every_kind``, with nothing left out."""
    assert any([check(tmp_path / "a.tif", kind) for kind in tiff_kinds(dtype, every=True)])


def without_imagecodecs(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = importlib.util.find_spec

    def find_spec(name: str, package: str | None = None) -> Any:
        return None if name == "imagecodecs" else usual(name, package)

    monkeypatch.setattr(tiff_pixels.importlib.util, "find_spec", find_spec)


def written(path: Path, values: np.ndarray, **how: Any) -> Path:
    path.write_bytes(tiff_file(values, **how))
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_that_of_pycolmap(tmp_path: Path, orientation: int) -> None:
    """Pixels as they are stored: poses refer to these."""
    path = written(tmp_path / "a.tif", COLOR, photometric="rgb", tags={ORIENTATION: orientation})
    np.testing.assert_array_equal(read_image(path), COLOR)
    np.testing.assert_array_equal(read_image(path), pycolmap.Bitmap.read(str(path), as_rgb=True).to_array())


@pytest.mark.parametrize("bits", [1, 2, 4, 10, 12, 14])
def test_odd_depths(tmp_path: Path, bits: int) -> None:
    """Few levels become 8 bits, more than 8 bits stay the numbers that they are."""
    pytest.importorskip("imagecodecs")
    values = (np.arange(24 * 32, dtype=np.uint16) * 7).reshape(24, 32) % (1 << bits)
    stored = values.astype(np.bool_ if bits == 1 else np.uint8 if bits < 8 else np.uint16)
    path = written(tmp_path / "a.tif", stored, photometric="minisblack", bitspersample=bits)
    expected = (values * (255 // ((1 << bits) - 1))).astype(np.uint8) if bits < 8 else values
    np.testing.assert_array_equal(read_image(path), expected, strict=True)


@pytest.mark.parametrize("compression", [None, "lzw"])
def test_white_is_zero(tmp_path: Path, compression: str | None) -> None:
    """A picture is turned to its look, as pycolmap does; values stay."""
    grey = COLOR[..., 0].copy()
    path = written(tmp_path / "a.tif", grey, photometric="miniswhite", compression=compression)
    np.testing.assert_array_equal(read_image(path), 255 - grey)
    path = written(tmp_path / "b.tif", GREY16, photometric="miniswhite", compression=compression)
    np.testing.assert_array_equal(read_image(path), GREY16)


def test_colours_that_are_stored_otherwise(tmp_path: Path) -> None:
    """A palette, YCbCr and CMYK of 8 bits are colours; three 16-bit samples that no tag calls so are, too."""
    levels = np.stack([np.arange(256), np.arange(256)[::-1], np.full(256, 100)]).astype(np.uint16) * 257
    palette = written(tmp_path / "a.tif", COLOR[..., 0], photometric="palette", colormap=levels)
    np.testing.assert_array_equal(read_image(palette), (levels // 257).T.astype(np.uint8)[COLOR[..., 0]])
    no_ink = written(tmp_path / "b.tif", np.zeros((24, 32, 4), np.uint8), photometric="separated")
    assert (read_image(no_ink) == 255).all()
    assert read_image(no_ink).shape == (24, 32, 3)
    bands = written(tmp_path / "c.tif", np.uint16(COLOR) * 257, photometric="minisblack", planarconfig="contig")
    np.testing.assert_array_equal(read_image(bands), np.uint16(COLOR) * 257)


def test_colours_multiplied_by_their_alpha(tmp_path: Path) -> None:
    """They are right where alpha is full."""
    alpha = np.full((24, 32), 255, np.uint8)
    alpha[:4], alpha[4:8] = 0, 100
    path = written(tmp_path / "a.tif", np.dstack([COLOR, alpha]), photometric="rgb", extrasamples=["assocalpha"])
    pixels = read_pixels(path)
    np.testing.assert_array_equal(pixels.image, COLOR)
    np.testing.assert_array_equal(pixels.mask, alpha == 255)


@pytest.mark.parametrize(
    ("values", "how", "match"),
    [
        (np.dstack([GREY16] * 2), {"photometric": "minisblack", "planarconfig": "contig"}, "2 bands of 16 bits, of"),
        (np.dstack([GREY16] * 5), {"photometric": "minisblack", "planarconfig": "contig"}, "5 bands of 16 bits, of"),
        (np.dstack([np.float32(GREY16)] * 3), {"photometric": "minisblack", "planarconfig": "contig"}, "3 bands of 32"),
        (GREY16.astype(np.complex64), {}, "complex numbers"),
        (np.dstack([GREY16] * 4), {"photometric": "separated"}, r"colours as CMYK \(16 bits\)"),
        (COLOR, {"photometric": "cielab"}, r"colours as CIE L\*a\*b\* \(8 bits\)"),
        (GREY16, {"photometric": "palette", "colormap": np.zeros((3, 65536), np.uint16)}, "stored in an unusual way"),
    ],
)
def test_what_is_not_read(tmp_path: Path, values: np.ndarray, how: dict[str, Any], match: str) -> None:
    """A sentence says what the file holds, and how to save it."""
    path = written(tmp_path / "a.tif", values, **how)
    with pytest.raises(UserError, match=match) as caught:
        read_image(path)
    assert str(path) in caught.value.message
    assert "Save it anew" in caught.value.hint


def test_a_compression_without_a_decoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two planes packed by LZW: the package that would help is named."""
    pytest.importorskip("imagecodecs")
    kind = TiffKind("uint16", 3, "separate", "lzw")
    (tmp_path / "a.tif").write_bytes(kind.file())
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), kind.samples_of())
    without_imagecodecs(monkeypatch)
    with pytest.raises(UserError, match=r"a\.tif is a TIFF of a kind \(LZW\) that needs imagecodecs") as caught:
        read_image(tmp_path / "a.tif")
    assert caught.value.hint.endswith("pip install imagecodecs")


def test_without_a_photometric_tag(tmp_path: Path) -> None:
    """Workswell's TIFFs do not say what their values are; OpenCV 5 refuses them."""
    data = bytearray(tiff_file(GREY16))
    with tifffile.TiffFile(written(tmp_path / "a.tif", GREY16)) as file:
        entry = file.pages.first.tags[262]
    data[entry.offset : entry.offset + 2] = (40000).to_bytes(2, "little")  # a tag of no meaning
    (tmp_path / "a.tif").write_bytes(bytes(data))
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), GREY16)


def test_segments_that_lie_beyond_the_end(tmp_path: Path) -> None:
    """A file that lost its end is damaged, whoever decodes it."""
    content = TiffKind("uint16", 3, "separate").file()
    (tmp_path / "a.tif").write_bytes(content[:-200])
    with pytest.raises(UserError, match="damaged or not an image"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("values", "tag", "fill"),
    [
        (np.float32(GREY16 / 100), "-9999", -9999),
        (np.float32(GREY16 / 100), " -9999.0 ", -9999),
        (np.float64(GREY16 / 100), "-3.4028234663852886e+38", -3.4028234663852886e38),
        (np.float32(GREY16 / 100), "-3.4028234663852886e+38", np.finfo(np.float32).min),
        (np.float32(GREY16 / 100), "nan", np.nan),
        (GREY16, "0", 0),
        (GREY16, "65535", 65535),
        (np.int16(GREY16), "-32768", -32768),
        # no tag: what no sensor measures
        (np.float32(GREY16 / 100), None, -3.4e38),
        (np.float32(GREY16 / 100), None, -9999),
        (np.float64(GREY16 / 100), None, 9.96921e36),
        (np.int16(GREY16), None, -32768),
    ],
)
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_pixels_without_a_value(
    tmp_path: Path, values: np.ndarray, tag: str | None, fill: float, compression: str | None
) -> None:
    """GDAL's tag, and fill values without it; ``read_image`` has NaN there."""
    values = values.copy()
    values[3:5, 4:9] = fill
    path = written(tmp_path / "a.tif", values, compression=compression, tags={} if tag is None else {NODATA: tag})
    pixels = read_pixels(path)
    assert pixels.void is not None
    expected = np.zeros((24, 32), np.bool_)
    expected[3:5, 4:9] = True
    np.testing.assert_array_equal(pixels.void, expected)
    np.testing.assert_array_equal(np.isnan(read_image(path)), expected)
    np.testing.assert_array_equal(read_image(path)[~expected], values[~expected])


@pytest.mark.parametrize("tag", ["-9999", "nonsense", "1e400", ""])
def test_nodata_that_no_pixel_has(tmp_path: Path, tag: str) -> None:
    """Or that is no number of the image's type: every pixel has a value."""
    path = written(tmp_path / "a.tif", GREY16, tags={NODATA: tag})
    assert read_pixels(path).void is None
    np.testing.assert_array_equal(read_image(path), GREY16, strict=True)


def test_nodata_of_a_picture(tmp_path: Path) -> None:
    """Where all colours are it, there is nothing to see: it masks, as alpha does."""
    color = COLOR.copy()
    color[:2] = 7
    color[5, 5] = 7, 7, 8
    pixels = read_pixels(written(tmp_path / "a.tif", color, photometric="rgb", tags={NODATA: "7"}))
    assert pixels.void is None
    assert pixels.mask is not None
    assert not pixels.mask[:2].any()
    assert pixels.mask[2:].all()


def test_low_values_that_are_measured(tmp_path: Path) -> None:
    """-9999 among others like it is a value."""
    values = np.linspace(-20_000, 0, 24 * 32, dtype=np.float32).reshape(24, 32)
    values[3, 3] = -9999
    assert read_pixels(written(tmp_path / "a.tif", values)).void is None
