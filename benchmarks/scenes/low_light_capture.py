"""A capture as it would be in the dark: its photographs get the noise of few photons, all else stays.

Photographs are made linear (gamma 2.2), counted as electrons, and encoded again:

    electrons = Poisson(linear · E) + Normal(0, read noise),    pixel = clip(electrons / E, 0, 1)^(1 / 2.2)

with E electrons at white. Thermal images are those of the capture: thermal cameras do not need light.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets import load_capture

GAMMA = 2.2
READ_NOISE = 2.5
"""Standard deviation of the noise of reading a pixel [electrons], of usual CMOS sensors."""
_IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_AS_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]


def darkened(
    image: NDArray[np.uint8], electrons: float, random: np.random.Generator, read_noise: float = READ_NOISE
) -> NDArray[np.uint8]:
    """A photograph with the noise of little light.

    Args:
        image: [H, W, 3].
        electrons: At white, more than 0.
        random: Draws the noise.
        read_noise: Standard deviation [electrons].
    """
    linear = (image / 255.0) ** GAMMA
    counted = random.poisson(linear * electrons) + random.normal(0.0, read_noise, image.shape)
    encoded = np.clip(counted / electrons, 0.0, 1.0) ** (1.0 / GAMMA)
    return np.uint8(encoded * 255.0 + 0.5)


def low_light_copy(
    capture: Path, out: Path, electrons: float | None, *, shrink: int = 1, seed: int = 0
) -> dict[str, float]:
    """Copy a capture and darken its photographs.

    Args:
        capture: Folder of a capture.
        out: The copy; what lies there is deleted.
        electrons: At white. None: the photographs stay as they are.
        shrink: Divide the images' width and height by this first, so that what is seen is noise of single pixels.
        seed: Of the noise.

    Returns:
        By spectrum of the photographs the PSNR that the images before they were darkened have on the held-out views
        [dB]: nothing that generalises gets above it. Empty where they stay as they are.
    """
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(capture, out, ignore=shutil.ignore_patterns("ground_truth") if shrink > 1 else None)
    if shrink > 1:
        for path in sorted(path for path in out.rglob("*") if path.suffix.lower() in _IMAGES):
            image = _read(path)
            size = (image.shape[1] // shrink, image.shape[0] // shrink)
            _write(path, cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    if electrons is None:
        return {}
    loaded, random = load_capture(out), np.random.default_rng(seed)
    errors: dict[str, list[float]] = {}
    for held_out, frames in ((False, loaded.train), (True, loaded.test)):
        for frame in frames:
            for name, view in frame.views.items():
                if loaded.scales[name].kind != "photograph":
                    continue
                clean = _read(view.path)
                _write(view.path, darkened(clean, electrons, random))
                if held_out:
                    stored = _read(view.path) / 255.0
                    errors.setdefault(name, []).append(float(np.mean((stored - clean / 255.0) ** 2)))
    return _mean_psnr(errors)


def _mean_psnr(errors: Mapping[str, list[float]]) -> dict[str, float]:
    return {name: float(np.mean(-10.0 * np.log10(found))) for name, found in errors.items()}


def _read(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path} cannot be read as an image.")
    return image


def _write(path: Path, image: NDArray[Any]) -> None:
    cv2.imwrite(str(path), image, _AS_JPEG if path.suffix.lower() in (".jpg", ".jpeg") else [])
