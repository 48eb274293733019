"""Changed images of every format: pixels, or one sentence; never other pixels where there is a checksum."""

import importlib.util
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from capture_folders import rgb_image, temperatures
from fuzzing import Fuzzer, changed_bytes, main, number_of_cases, run_apart
from thermosplat.datasets.images.flir_metadata import read_flir_palette
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.jpeg_warnings import check_jpegs
from thermosplat.errors import UserError

JPEGS_TOGETHER = 40


def formats() -> dict[str, list[bytes]]:
    """Files of every format by their ending: 8 and 16 bits, floats, compressed and not."""
    color = cv2.GaussianBlur(rgb_image(0, 64, 48), (0, 0), 2)
    grey, celsius = color[..., 0], temperatures(0, 64, 48)
    alpha = np.dstack([color, grey])

    def encoded(suffix: str, image: np.ndarray, *options: int) -> bytes:
        return cv2.imencode(suffix, image, list(options))[1].tobytes()

    return {
        ".png": [encoded(".png", image) for image in (color, grey, alpha, np.uint16(100 * celsius))],
        ".jpg": [
            encoded(".jpg", color),
            encoded(".jpg", grey, cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
            encoded(".jpg", color, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        ],
        ".tiff": [
            encoded(".tiff", np.float32(celsius)),
            *(encoded(".tiff", np.uint16(100 * celsius), cv2.IMWRITE_TIFF_COMPRESSION, kind) for kind in (1, 5, 8)),
            encoded(".tiff", color),
            *_of_tifffile(color, celsius),
        ],
        ".bmp": [encoded(".bmp", color), encoded(".bmp", grey)],
        ".webp": [encoded(".webp", color), encoded(".webp", alpha, cv2.IMWRITE_WEBP_QUALITY, 101)],
    }


def _of_tifffile(color: np.ndarray, celsius: np.ndarray) -> list[bytes]:
    """Kinds that OpenCV does not read: planes, alpha, NoData, orientation, tiles, numbers of 64 bits."""
    levels = np.uint16(100 * celsius)
    with_alpha = np.dstack([levels, np.full_like(levels, 65535)])
    kinds: list[tuple[np.ndarray, dict[str, Any]]] = [
        (np.moveaxis(np.uint16(color) * 257, -1, 0), {"photometric": "rgb", "planarconfig": "separate"}),
        (with_alpha, {"photometric": "minisblack", "planarconfig": "contig", "extrasamples": ["unassalpha"]}),
        (np.dstack([color, color[..., :2]]), {"photometric": "rgb", "tile": (16, 16), "extrasamples": [2, 0]}),
        (np.float16(celsius), {"bigtiff": True, "extratags": [(42113, 2, 0, "-9999", True)]}),
        (np.int16(levels), {"byteorder": ">", "extratags": [(274, 3, 1, 6, True)], "rowsperstrip": 7}),
    ]
    if importlib.util.find_spec("imagecodecs") is not None:
        kinds += [(image, {**how, "compression": code}) for image, how in kinds[:3] for code in ("lzw", "zlib", "zstd")]
    files = []
    for image, how in kinds:
        file = BytesIO()
        tifffile.imwrite(file, image, metadata=None, **how)
        files.append(file.getvalue())
    return files


def make(root: Path) -> Fuzzer:
    """JPEG files are looked at together, as those of a capture are."""
    files, jpegs = formats(), list[Path]()
    made = 0

    def fuzzer(rng: np.random.Generator) -> str:
        nonlocal made
        made += 1
        suffix = list(files)[rng.integers(0, len(files))]
        original = files[suffix][rng.integers(0, len(files[suffix]))]
        path = root / f"{made}{suffix}"
        path.write_bytes(changed_bytes(original, rng))
        try:
            image = read_image(path)
            read_flir_palette(path)
            assert image.ndim in (2, 3)
            if suffix == ".png":
                (root / "original.png").write_bytes(original)
                assert np.array_equal(image, read_image(root / "original.png"))
        except UserError:
            path.unlink()
            raise
        if suffix == ".jpg":
            jpegs.append(path)
        else:
            path.unlink()
        if len(jpegs) >= JPEGS_TOGETHER:
            looked_at = jpegs.copy()
            jpegs.clear()
            check_jpegs(looked_at)
        return suffix

    return fuzzer


@pytest.mark.rotating("fuzzed input")
def test_changed_images():
    """Headers, data and ends."""
    run_apart(__file__, number_of_cases(1000))


if __name__ == "__main__":
    main(make)
