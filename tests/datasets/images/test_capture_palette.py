"""The palette of a capture: stated, stored in its files, or assumed."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from capture_folders import pseudo_color, temperatures, write_image
from thermosplat.datasets.images.capture_palette import choose_palette, palette_notes
from thermosplat.datasets.images.flir_metadata import read_flir_palette
from thermosplat.errors import UserError
from thermosplat.spectra import THERMAL, SpectrumConfig
from thermosplat.thermal.radiometry import FLIR_IRON, GREY


def write_flir_jpeg(path, ycc: np.ndarray, order: str = ">", pieces: int = 2) -> None:
    """A JPEG with a palette record in an FFF file, cut into APP1 segments."""
    record = bytearray(0x70 + ycc.size)
    record[0] = len(ycc)
    record[0x70:] = ycc.astype(np.uint8).tobytes()
    header = bytearray(0x40)
    header[:4] = b"FFF\0"
    struct.pack_into(order + "III", header, 0x14, 101, 0x40, 2)
    other = struct.pack(order + "HHIIII", 0x20, 0, 0, 0, 0x80, 0).ljust(32, b"\0")
    entry = struct.pack(order + "HHIIII", 0x22, 0, 0, 0, 0x80, len(record)).ljust(32, b"\0")
    fff = bytes(header) + other + entry + bytes(record)
    write_image(path, pseudo_color(temperatures(0)))
    data = path.read_bytes()
    step = -(-len(fff) // pieces)
    segments = b""
    for number in range(pieces):
        body = b"FLIR\0\x01" + bytes([number, pieces - 1]) + fff[number * step : (number + 1) * step]
        segments += b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body
    path.write_bytes(data[:2] + segments + data[2:])


@pytest.mark.parametrize("order", ["<", ">"])
def test_palette_in_a_flir_file(tmp_path, order):
    """Y, Cr, Cb entries in limited range become RGB, in either byte order and from several segments."""
    ycc = np.array([[16, 128, 128], [81, 240, 90], [145, 34, 54], [41, 110, 240], [235, 128, 128]])
    write_flir_jpeg(tmp_path / "a.jpg", ycc, order)
    levels = read_flir_palette(tmp_path / "a.jpg").colors * 255
    # BT.601: black, red, green, blue, white.
    np.testing.assert_allclose(levels, [(0, 0, 0), (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)], atol=2)


def test_palette_behind_other_segments(tmp_path):
    """Segments of other makers, and bytes that look like a picture's beginning within them, are stepped over."""
    ycc = np.array([[16, 128, 128], [100, 120, 140], [235, 128, 128]])
    write_flir_jpeg(tmp_path / "a.jpg", ycc)
    data = (tmp_path / "a.jpg").read_bytes()
    other = b"FLIR\0\x01\x07\x01" + b"\xff\xda junk"
    segments = b"\xff\xe2" + (len(other) + 2).to_bytes(2, "big") + other
    (tmp_path / "b.jpg").write_bytes(data[:2] + segments + data[2:])
    np.testing.assert_array_equal(
        read_flir_palette(tmp_path / "b.jpg").colors, read_flir_palette(tmp_path / "a.jpg").colors
    )


def test_files_without_a_palette(tmp_path):
    """Other images, cut-off files and missing ones give None."""
    write_image(tmp_path / "a.png", pseudo_color(temperatures(0)))
    write_flir_jpeg(tmp_path / "b.jpg", np.full((5, 3), 128))
    data = (tmp_path / "b.jpg").read_bytes()
    (tmp_path / "c.jpg").write_bytes(data[:40])
    (tmp_path / "d.jpg").write_bytes(data.replace(b"FFF\0", b"XXX\0"))
    for name in ("a.png", "c.jpg", "d.jpg", "none.jpg"):
        assert read_flir_palette(tmp_path / name) is None


def test_order_of_choice(tmp_path):
    """The user's palette, then the capture's, then the camera's, then FLIR Iron, which alone is an assumption."""
    files = [tmp_path / "a.jpg"]
    write_image(files[0], pseudo_color(temperatures(0)))
    chosen = choose_palette(tmp_path, "thermal", THERMAL, files)
    assert chosen.palette == FLIR_IRON
    assert not chosen.stated
    write_flir_jpeg(files[0], np.array([[16, 128, 128], [100, 120, 140], [235, 128, 128]]))
    chosen = choose_palette(tmp_path, "thermal", THERMAL, files)
    assert len(chosen.palette.colors) == 3
    assert chosen.stated
    (tmp_path / "ironbow_lut.json").write_text('{"lut": [[0, 0, 0], [9, 9, 9], [90, 90, 90], [255, 255, 255]]}')
    assert len(choose_palette(tmp_path, "thermal", THERMAL, files).palette.colors) == 4
    (tmp_path / "mine.csv").write_text("0,0,0\n255,255,255\n")
    mine = replace(THERMAL, palette=str(tmp_path / "mine.csv"))
    assert len(choose_palette(tmp_path, "thermal", mine, files).palette.colors) == 2


def test_right_palette_is_not_doubted(tmp_path):
    """Images of the palette give no note; negatives of them do."""
    chosen = choose_palette(tmp_path, "thermal", THERMAL, [])
    images = [pseudo_color(temperatures(number)) for number in range(3)]
    assert palette_notes(chosen, images, "thermal") == []
    (note,) = palette_notes(chosen, [255 - image for image in images], "thermal")
    assert note.startswith("Colours of the thermal images lie ")
    assert "FLIR Iron" in note
    assert note.endswith("give the right one with --thermal.palette.")


def test_palettes_that_need_no_file(tmp_path):
    """grey, which a further spectrum has unless it says otherwise, and iron; the capture's own is for none of them."""
    (tmp_path / "ironbow_lut.json").write_text('{"lut": [[0, 0, 0], [9, 9, 9], [90, 90, 90], [255, 255, 255]]}')
    for config, palette in ((SpectrumConfig(), GREY), (SpectrumConfig(palette="iron"), FLIR_IRON)):
        chosen = choose_palette(tmp_path, "nir", config, [])
        assert chosen.palette == palette
        assert chosen.stated


def test_a_palette_that_cannot_be_used_names_the_spectrums_flag(tmp_path):
    """A file that is not there, given to a further spectrum."""
    with pytest.raises(UserError, match=r"Cannot read the palette .*gone\.csv") as caught:
        choose_palette(tmp_path, "nir", SpectrumConfig(palette=str(tmp_path / "gone.csv")), [])
    assert caught.value.hint.endswith("to --nir.palette.")
