"""The pseudo-colours of thermal images."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_STOPS = [
    (0.00, (0, 0, 0)),
    (0.10, (14, 0, 80)),
    (0.25, (82, 0, 146)),
    (0.40, (165, 8, 140)),
    (0.54, (214, 52, 72)),
    (0.68, (240, 112, 16)),
    (0.82, (253, 176, 6)),
    (0.92, (255, 228, 84)),
    (1.00, (255, 255, 255)),
]


def ironbow() -> NDArray[np.uint8]:
    """256 colours, [256, 3]; their luma grows strictly."""
    from scipy.interpolate import PchipInterpolator

    positions, colors = np.array([stop for stop, _ in _STOPS]), np.array([color for _, color in _STOPS], float)
    return np.clip(np.round(PchipInterpolator(positions, colors)(np.linspace(0, 1, 256))), 0, 255).astype(np.uint8)


def colored(celsius: NDArray[Any], span: tuple[float, float], palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture of temperatures, [H, W, 3]."""
    low, high = span
    return palette[np.clip(np.round((celsius - low) / (high - low) * 255), 0, 255).astype(int)]


def span_of(images: list[NDArray[Any]]) -> tuple[float, float]:
    """The palette's ends [deg C], in halves of a degree: 2% of the pixels lie below, 0.5% above."""
    seen = np.concatenate([image.ravel()[::5] for image in images])
    low, high = np.percentile(seen, [2, 99.5])
    return float(np.floor(low * 2) / 2), float(np.ceil(high * 2) / 2)


def write_palette(path: Path, palette: NDArray[np.uint8]) -> None:
    """Write ironbow_lut.json."""
    how = "PCHIP through control points (position, RGB); Rec.709 luma strictly increasing"
    known = {"space": "sRGB 8 bit, R G B", "construction": how, "control_points": _STOPS, "lut": palette.tolist()}
    path.write_text(json.dumps(known))
