"""Comparison sheets: a picture a frame, a row a method, both modalities with their error maps."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from thermosplat.comparison_strips import GAP, HEADER_HEIGHT, titled
from thermosplat.datasets.capture import Modality
from thermosplat.evaluation import file_stem
from thermosplat.image_display import Image8, write_png
from thermosplat.method_matrix.panels import Panels, read_panels

PANEL_WIDTH = 320  # [px]
MODALITIES: tuple[Modality, ...] = ("rgb", "thermal")


def write_sheets(out: Path, scene: str, cells: Mapping[str, Path]) -> list[Path]:
    """Write the sheets of a scene: ``sheets/<scene>_<frame>.png``.

    Args:
        out: The matrix's folder.
        scene: The scene's name.
        cells: Run folder of each method's cell, in the order of the rows; one without pictures is left out.

    Returns:
        The files.
    """
    panels = {method: read_panels(folder) for method, folder in cells.items()}
    frames = sorted({frame for of_method in panels.values() for frame, _ in of_method})
    written = []
    for frame in frames:
        rows = {
            method: {modality: of_method.get((frame, modality)) for modality in MODALITIES}
            for method, of_method in panels.items()
        }
        shown = {method: row for method, row in rows.items() if any(row.values())}
        path = out / "sheets" / f"{scene}_{file_stem(frame)}.png"
        write_png(path, sheet(shown))
        written.append(path)
    return written


def sheet(rows: Mapping[str, Mapping[Modality, Panels | None]]) -> Image8:
    """The picture of one frame.

    Args:
        rows: Pictures by method and modality, at least one; None where a method has no such modality.

    Returns:
        8-bit RGB. First row: ground truth of both modalities; then a row a method: render and error of each.
    """
    first = {modality: _first(rows, modality) for modality in MODALITIES}
    lines = [[_truth(panels, modality) for modality, panels in first.items() if panels is not None]]
    for method, row in rows.items():
        lines.append([_pair(method, row[modality], panels) for modality, panels in first.items() if panels is not None])
    return _stacked([_beside(line) for line in lines])


def _first(rows: Mapping[str, Mapping[Modality, Panels | None]], modality: Modality) -> Panels | None:
    return next((row[modality] for row in rows.values() if row[modality] is not None), None)


def _truth(panels: Panels, modality: Modality) -> Image8:
    left = titled(f"{modality} ground truth", panels.truth, PANEL_WIDTH)
    return _beside([left, np.zeros_like(left)])


def _pair(method: str, panels: Panels | None, like: Panels) -> Image8:
    """Render and error of a method; black where it has none, of the size of ``like``."""
    if panels is None:
        height = HEADER_HEIGHT + max(1, round(like.truth.shape[0] * PANEL_WIDTH / like.truth.shape[1]))
        return np.zeros((height, 2 * PANEL_WIDTH + GAP, 3), np.uint8)
    render = titled(f"{method} {panels.score}", panels.render, PANEL_WIDTH)
    error = titled("error 0", panels.error, PANEL_WIDTH, palette_end=panels.palette_end)
    return _beside([render, error])


def _beside(images: Sequence[Image8]) -> Image8:
    """Images in a row; lower ones get black below."""
    height = max(image.shape[0] for image in images)
    gap = np.zeros((height, GAP, 3), np.uint8)
    padded = [np.pad(image, ((0, height - image.shape[0]), (0, 0), (0, 0))) for image in images]
    return np.concatenate([part for image in padded for part in (image, gap)][:-1], axis=1)


def _stacked(lines: Sequence[Image8]) -> Image8:
    gap = np.zeros((GAP, lines[0].shape[1], 3), np.uint8)
    return np.concatenate([part for line in lines for part in (line, gap)][:-1])
