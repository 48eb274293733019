"""Stacks of channels in every file that they come in, and what is wrong with others."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from thermosplat.datasets.images.stack_files import list_stacks, read_stack
from thermosplat.errors import UserError

STACK = np.random.default_rng(0).random((4, 5, 7)).astype(np.float32)


def envi(path: Path, stack: np.ndarray, interleave: str, order: tuple[int, int, int], **fields: object) -> None:
    """An ENVI cube; ``order`` has the axes of [H, W, C] as they lie in the file."""
    height, width, channels = stack.shape
    stated = {"samples": width, "lines": height, "bands": channels, "data type": 4, "interleave": interleave, **fields}
    lines = [f"{key.replace('_', ' ')} = {value}" for key, value in stated.items()]
    path.write_text("\n".join(["ENVI", "description = {\n a cube }", *lines, "wavelength = {400, 500}"]))
    path.with_suffix(".img").write_bytes(
        b"\0" * int(str(fields.get("header_offset", 0))) + stack.transpose(order).tobytes()
    )


def write(path: Path, how: str) -> None:
    if how == "npy":
        np.save(path, STACK)
    elif how == "npy, channels first":
        np.save(path, STACK.transpose(2, 0, 1)[None].astype(np.float64))
    elif how == "tiff, pages":
        tifffile.imwrite(path, STACK.transpose(2, 0, 1), photometric="minisblack")
    elif how == "tiff, samples":
        tifffile.imwrite(path, STACK, photometric="minisblack", planarconfig="contig")
    else:
        order = {"bsq": (2, 0, 1), "bil": (0, 2, 1), "BIP": (0, 1, 2)}[how]
        envi(path, STACK, how, order, header_offset=12)


@pytest.mark.parametrize(
    ("name", "how"),
    [
        *(("a.npy", "npy"), ("a.npy", "npy, channels first"), ("a.tif", "tiff, pages"), ("a.tiff", "tiff, samples")),
        *(("a.hdr", "bsq"), ("a.hdr", "bil"), ("a.hdr", "BIP")),
    ],
)
def test_a_stack_comes_back(tmp_path: Path, name: str, how: str) -> None:
    """Whichever of its axes the channels are."""
    write(tmp_path / name, how)
    np.testing.assert_array_equal(read_stack(tmp_path / name, 7), STACK)
    assert list_stacks(tmp_path) == [tmp_path / name]


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.npy", STACK[..., :3], "a.npy holds float32 of shape .*, and channels says 7"),
        ("a.npy", STACK[..., 0], "and channels says 7"),
        ("a.npy", np.array(["a"] * 140).reshape(4, 5, 7), "and channels says 7"),
        ("a.npy", np.where(STACK > 0.5, np.nan, STACK), "a.npy has values that are no finite numbers"),
        ("a.npy", np.array([{}], object), "a.npy cannot be read"),
        ("a.npy", b"", "a.npy cannot be read"),
        ("a.tif", b"II*\0", "a.tif cannot be read"),
        ("a.hdr", b"ENVI\nlines = 4", "a.hdr cannot be read"),
        ("a.hdr", b"nothing", "a.hdr cannot be read"),
        ("a.hdr", b"ENVI\nlines=4\nsamples=5\nbands=7\ninterleave=bsq\ndata type=4", "a.hdr has no data beside it"),
        ("a.hdr", b"ENVI\nlines=-4\nsamples=5\nbands=7\ninterleave=bsq\ndata type=4", "has no data|cannot be read"),
        ("a.hdr", b"ENVI\nlines=4\nsamples=5\nbands=7\ninterleave=bsq\ndata type=6", "a.hdr cannot be read"),
    ],
)
def test_what_is_no_stack_is_refused(tmp_path: Path, name: str, content: object, expected: str) -> None:
    """Other channels, damage, objects and missing data are errors that name the file."""
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content, allow_pickle=True)
    with pytest.raises(UserError, match=expected):
        read_stack(path, 7)


def test_an_envi_cube_is_whole(tmp_path: Path) -> None:
    """Data that are shorter than the header states are refused."""
    envi(tmp_path / "a.hdr", STACK, "bsq", (2, 0, 1))
    data = tmp_path / "a.img"
    data.write_bytes(data.read_bytes()[:-1])
    with pytest.raises(UserError, match=r"a.img has 559 bytes, fewer than its header a.hdr states"):
        read_stack(tmp_path / "a.hdr", 7)
