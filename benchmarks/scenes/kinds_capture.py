"""A rendered capture with images of other kinds beside its own: labels, feature maps drawn from them, and bands.

Feature maps have a random direction of length 1 for each label, and noise of 0.3 of this length that is independent
from pixel to pixel: a perfect render has a cosine of 1 / sqrt(1 + 0.3²) = 0.96 to them. Bands are made of the
photographs' colours and the thermal images' values t, both in [0, 1], with noise of 0.01:

    band(λ) = (Σ g(λ) rgb)^(0.7 + 0.6 λ) · (1 - 0.4 t λ),    λ in [0, 1]

where g are three bells about the middles of blue, green and red.
"""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets import load_capture
from thermosplat.datasets.ground_truth import LABELS
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.thermal.intensity import pixel_intensity

LABEL_NAMES = tuple(name.replace(" ", "_") for name in LABELS.values())
"""By number."""
_NOISE_OF_FEATURES, _NOISE_OF_BANDS = 0.3, 0.01
_MIDDLES, _WIDTH = (0.85, 0.5, 0.15), 0.25
"""Where red, green and blue lie among the wavelengths, and the standard deviation of their bells."""
_SHRUNK = 4
"""Feature maps are smaller than photographs, as those of networks are."""


def capture_with_labels(capture: Path, labels: Path, out: Path) -> Path:
    """Copy a capture and put the labels of all its views beside its images.

    Args:
        capture: A rendered capture.
        labels: Folder ``labels`` of the same capture as ``python -m rendered_captures`` writes it.
        out: The copy; what lies there is deleted.
    """
    _copy(capture, out)
    shutil.copytree(labels, out / "labels")
    return out


def capture_with_features(capture: Path, labels: Path, out: Path, channels: int, *, seed: int = 0) -> Path:
    """The same with feature maps ``maps``, float16 [H / 4, W / 4, channels]."""
    _copy(capture, out)
    random = np.random.default_rng(seed)
    directions = random.normal(size=(len(LABEL_NAMES), channels))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for path in sorted(labels.rglob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        size = (image.shape[1] // _SHRUNK, image.shape[0] // _SHRUNK)
        small = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        noise = random.normal(0.0, _NOISE_OF_FEATURES / np.sqrt(channels), (*small.shape, channels))
        _write(out / "maps" / path.relative_to(labels).with_suffix(".npy"), directions[small] + noise)
    return out


def capture_with_bands(capture: Path, out: Path, channels: int, chosen: int | None = None, *, seed: int = 0) -> Path:
    """The same with stacks ``bands``, float16 [H, W, chosen].

    Args:
        channels: Bands from λ = 0 to 1.
        chosen: So many of them are kept, spread over all; None: all.
    """
    _copy(capture, out)
    loaded = load_capture(capture)
    wavelengths = np.linspace(0.0, 1.0, channels)
    if chosen is not None:
        wavelengths = wavelengths[evenly_chosen(range(channels), chosen)]
    bells = np.exp(-0.5 * np.square((wavelengths[:, None] - np.array(_MIDDLES)) / _WIDTH))
    bells /= bells.sum(axis=1, keepdims=True)
    random = np.random.default_rng(seed)
    for part, frames in (("train", loaded.train), ("test", loaded.test)):
        for frame in frames:
            photograph, thermal = (_unit(frame.views[name].pixels().image) for name in ("rgb", "thermal"))
            warmth = pixel_intensity(torch.from_numpy(thermal), loaded.scales["thermal"]).numpy()[..., None]
            bands = (photograph @ bells.T) ** (0.7 + 0.6 * wavelengths) * (1.0 - 0.4 * warmth * wavelengths)
            _write(out / "bands" / part / f"{frame.name}.npy", bands + random.normal(0.0, _NOISE_OF_BANDS, bands.shape))
    return out


def _unit(image: NDArray[Any]) -> NDArray[np.float64]:
    """An image in [0, 1]."""
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)


def _copy(capture: Path, out: Path) -> None:
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(capture, out)


def _write(path: Path, stack: NDArray[np.float64]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, stack.astype(np.float16))
