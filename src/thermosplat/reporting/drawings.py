"""Pictures of a report: a finding in the spectra of its scene, and a plan of all findings."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.export.maps.georeference import located_frame
from thermosplat.export.maps.map_frame import MapFrame, camera_centers, local_frame
from thermosplat.pictures.color_bar import color_bar, tick_values
from thermosplat.pictures.image_display import Image8, fitted, side_by_side
from thermosplat.reporting.findings import Finding
from thermosplat.thermography.reprojection import resized
from thermosplat.viewer.display import Display
from thermosplat.viewer.layers import Layer
from thermosplat.viewer.measuring import Measurer

_WIDTH = 480
"""Of each spectrum's picture [px]."""
_PLAN = 640
"""Longer side of the plan [px]."""
_EDGE = 0.08
"""Share of the plan's side that is left free."""
_MARK, _RIM = (255, 255, 255), (0, 0, 0)
_POINTS, _CAMERAS, _GRID, _FINDINGS = (150, 160, 170), (90, 140, 220), (226, 230, 235), (200, 30, 30)


@torch.no_grad()
def in_all_spectra(measurer: Measurer, finding: Finding, spectrum: str) -> Image8:
    """A finding in every spectrum of the scene, from the view that sees the most of it, with a colour bar.

    Args:
        measurer: Of the scene.
        finding: The finding.
        spectrum: Whose values are measured; it is shown last.
    """
    small = finding.seen.view
    view = resized(small, _WIDTH, max(1, round(_WIDTH * small.height / small.width)))
    names = [*(name for name in measurer.scene.model.spectra if name != spectrum), spectrum]
    layers = [Layer("image", name) for name in names]
    images = measurer.renderer.render(layers, view, temperatures=measurer.temperatures)
    display, pictures = Display(), []
    for layer in layers:
        picture = np.ascontiguousarray(display.picture(replace(images[layer], changed=None)))
        pictures.append(_outlined(picture, finding.pixels))
    last = images[layers[-1]]
    bar = color_bar(display.palette_of(last), *display.range_of(last), last.unit, max(60, view.height))
    return side_by_side([*pictures, fitted(bar, bar.shape[1], view.height)])


def map_frame(capture: Capture, spectrum: str) -> MapFrame:
    """East, north and up of a capture: on the Earth where it says where it lies, else as its cameras are held."""
    return local_frame(capture, spectrum) if capture.geo is None else located_frame(capture.geo, capture.placement)


def plan(frame: MapFrame, capture: Capture, spectrum: str, findings: Sequence[Finding]) -> tuple[Image8, float]:
    """The scene from above with its findings, and the distance of the grid's lines in the frame's unit.

    Args:
        frame: Where up is, and north if it is known.
        capture: Its sparse points and cameras.
        spectrum: Whose cameras.
        findings: Numbered from 1.
    """
    points = frame.to_map(capture.points)[:, :2]
    cameras = frame.to_map(camera_centers(capture, spectrum)[0])[:, :2]
    places = [frame.to_map(capture.placement.to_scene(np.array([one.region.place])))[0, :2] for one in findings]
    shown = np.concatenate([cameras, *([np.percentile(points, (2, 98), axis=0)] if len(points) else [])])
    shown = np.concatenate([shown, np.array(places).reshape(-1, 2)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    side = max(float((high - low).max()), 1e-9)
    margin = _EDGE * side
    scale = _PLAN / (side + 2 * margin)
    width, height = (max(80, round(float(scale * (span + 2 * margin)))) for span in (high - low))
    picture = np.full((height, width, 3), 255, np.uint8)

    def at(place: NDArray[np.float64]) -> tuple[int, int]:
        x, y = (place - low + margin) * scale
        return round(float(np.clip(x, -9999, 9999))), round(float(np.clip(height - y, -9999, 9999)))

    ticks = tick_values(0.0, side)
    step = ticks[1] - ticks[0] if len(ticks) > 1 else side
    for axis in (0, 1):
        for line in np.arange(np.ceil(low[axis] / step), high[axis] / step + 1) * step:
            place = low.copy()
            place[axis] = line
            x, y = at(place)
            start, end = ((x, 0), (x, height)) if axis == 0 else ((0, y), (width, y))
            cv2.line(picture, start, end, _GRID, 1)
    for point in points[:: max(1, len(points) // 20_000)]:
        cv2.circle(picture, at(point), 0, _POINTS, -1)
    for camera in cameras:
        cv2.circle(picture, at(camera), 2, _CAMERAS, -1)
    for number, place in enumerate(places, 1):
        x, y = at(place)
        cv2.circle(picture, (x, y), 5, _FINDINGS, -1, cv2.LINE_AA)
        cv2.putText(picture, str(number), (x + 7, y - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _FINDINGS, 2, cv2.LINE_AA)
    if frame.crs is not None:
        cv2.arrowedLine(picture, (24, 62), (24, 26), _RIM, 2, cv2.LINE_AA, tipLength=0.3)
        cv2.putText(picture, "N", (17, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _RIM, 2, cv2.LINE_AA)
    return picture, float(step)


def _outlined(picture: Image8, pixels: NDArray[np.bool_]) -> Image8:
    """A picture with a line around pixels of a smaller one, one picture's width."""
    height, width = picture.shape[:2]
    large = cv2.resize(pixels.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    around = cv2.dilate(large, np.ones((9, 9), np.uint8))
    contours, _ = cv2.findContours(around, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, _RIM, 4, cv2.LINE_AA)
    cv2.drawContours(picture, contours, -1, _MARK, 2, cv2.LINE_AA)
    return picture
