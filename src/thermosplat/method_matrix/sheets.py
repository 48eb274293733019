"""Comparison sheets: one picture per frame, a row per method, all spectra with error maps, and depths if known."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from thermosplat.evaluation.held_out import file_stem
from thermosplat.method_matrix.panels import Panels, read_panels
from thermosplat.pictures.comparison_strips import GAP, HEADER_HEIGHT, titled
from thermosplat.pictures.image_display import Image8, write_png
from thermosplat.runs.atomic_writes import plain_folder
from thermosplat.spectra import label

PANEL_WIDTH = 320  # [px]


def write_sheets(out: Path, scene: str, cells: Mapping[str, Path]) -> list[Path]:
    """Write the sheets of a scene: ``sheets/<scene>_<frame>.png``.

    Args:
        cells: Run folder of each method's cell, in the order of the rows; one without pictures is left out.
    """
    panels = {method: read_panels(folder) for method, folder in cells.items()}
    frames = sorted({frame for of_method in panels.values() for frame, _ in of_method})
    written = []
    for frame in frames:
        spectra = dict.fromkeys(
            name for of_method in panels.values() for of_frame, name in of_method if of_frame == frame
        )
        rows = {
            method: {name: of_method.get((frame, name)) for name in spectra} for method, of_method in panels.items()
        }
        shown = {method: row for method, row in rows.items() if any(row.values())}
        path = plain_folder(out, "sheets") / f"{scene}_{file_stem(frame)}.png"
        write_png(path, sheet(shown, f"{scene}, {frame}"))
        written.append(path)
    return written


def sheet(rows: Mapping[str, Mapping[str, Panels | None]], title: str = "") -> Image8:
    """The picture of one frame.

    Args:
        rows: Pictures by method and spectrum, at least one; None where a method has no such spectrum.
        title: What the sheet shows; stands above it.

    Returns:
        8-bit RGB. First row: ground truth of all spectra; then a row per method: render and error of each, and its
        depth where the true one is known.
    """
    spectra = dict.fromkeys(name for row in rows.values() for name in row)
    first = {name: _first(rows, name) for name in spectra}
    lines = [[_truth(panels, name) for name, panels in first.items() if panels is not None]]
    for method, row in rows.items():
        lines.append([_group(method, row.get(name), panels) for name, panels in first.items() if panels is not None])
    pictures = [_beside(line) for line in lines]
    header = titled(title, np.zeros((1, 1, 3), np.uint8), pictures[0].shape[1])[:HEADER_HEIGHT]
    return _stacked([header, *pictures])


def _first(rows: Mapping[str, Mapping[str, Panels | None]], spectrum: str) -> Panels | None:
    return next((row[spectrum] for row in rows.values() if row.get(spectrum) is not None), None)


def _truth(panels: Panels, spectrum: str) -> Image8:
    image = titled(f"{label(spectrum)} ground truth", panels.truth, PANEL_WIDTH)
    if panels.true_depth is None:
        return _beside([image, np.zeros_like(image)])
    depth = titled(f"true depth {panels.depth_range}", panels.true_depth, PANEL_WIDTH)
    return _beside([image, np.zeros_like(image), depth])


def _group(method: str, panels: Panels | None, like: Panels) -> Image8:
    """Render, error and depth of a method; black where it has none, of the size of ``like``."""
    if panels is None:
        height = HEADER_HEIGHT + max(1, round(like.truth.shape[0] * PANEL_WIDTH / like.truth.shape[1]))
        count = 2 if like.depth is None else 3
        return np.zeros((height, count * PANEL_WIDTH + (count - 1) * GAP, 3), np.uint8)
    images = [
        titled(f"{method} {panels.score}", panels.render, PANEL_WIDTH),
        titled("error 0", panels.error, PANEL_WIDTH, palette_end=panels.palette_end),
    ]
    if like.depth is not None:
        depth = np.zeros_like(panels.render) if panels.depth is None else panels.depth
        images.append(titled("depth", depth, PANEL_WIDTH))
    return _beside(images)


def _beside(images: Sequence[Image8]) -> Image8:
    """Images in a row; lower ones get black below."""
    height = max(image.shape[0] for image in images)
    gap = np.zeros((height, GAP, 3), np.uint8)
    padded = [np.pad(image, ((0, height - image.shape[0]), (0, 0), (0, 0))) for image in images]
    return np.concatenate([part for image in padded for part in (image, gap)][:-1], axis=1)


def _stacked(lines: Sequence[Image8]) -> Image8:
    gap = np.zeros((GAP, lines[0].shape[1], 3), np.uint8)
    return np.concatenate([part for line in lines for part in (line, gap)][:-1])
