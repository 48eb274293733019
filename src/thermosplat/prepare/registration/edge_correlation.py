"""Where a thermal camera looks and how strongly it magnifies, from edges alone: the start of registration.

The edges of the photographs are drawn as a thermal camera at the same place would see them, for a grid of focal lengths
and turns about the optical axis. Two cameras on one mount differ by nearly the same shift in all frames. So the
correlations with the thermal edges are added up over the frames, and their highest point is the shift, which is a
rotation. Edges are complex numbers with twice the angle of their normal: an edge is the same whether the inside or the
outside is warm.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.prepare.registration import thermal_edges
from thermosplat.prepare.registration.rig_camera import Array, RigCamera
from thermosplat.prepare.registration.stereo_edges import EdgePoints

WORKING_WIDTH = 96
"""Width [px] at which edges are compared."""
FOCAL_LENGTHS = tuple(0.55 * 1.07**step for step in range(28))
"""In image widths: from 85° to 18° of view."""
QUARTERS = (0.0, 90.0, 180.0, 270.0)
_ROLLS = (-6.0, -3.0, 0.0, 3.0, 6.0)
_COARSE_FRAMES, _FINE_FRAMES = 8, 20
_SATURATION = 0.1
"""Slope [contrasts per pixel] from which an edge counts fully."""
LEAST_COVERED = 0.05
"""Share of the edges' energy that must lie inside the thermal image for a correlation to count."""


@dataclass(frozen=True)
class Match:
    """A place where edges agree.

    Args:
        score: Normalised correlation, 1 for the same edges.
        camera: The thermal camera that sees them there.
        mirrored: The thermal images had to be mirrored.
    """

    score: float
    camera: RigCamera
    mirrored: bool


def correlate(edges: EdgePoints, slopes: Sequence[NDArray[np.float32]]) -> list[Match]:
    """The best agreement without and with mirrored thermal images, best first.

    Args:
        slopes: Slopes [H, W, 2] of each frame's thermal image.
    """
    frames = evenly_chosen(np.unique(edges.frame).tolist(), _COARSE_FRAMES)
    height, width = slopes[0].shape[:2]
    best: list[Match] = []
    for mirrored in (False, True):
        thermal = {frame: edge_field(slopes[frame], mirrored) for frame in frames}
        coarse = max(
            (_best_shift(edges, thermal, width, height, f * width, angle) for f in FOCAL_LENGTHS for angle in QUARTERS),
            key=lambda found: found[0],
        )
        best.append(Match(coarse[0], coarse[1], mirrored))
    best.sort(key=lambda match: -match.score)
    return [_refined(best[0], edges, slopes), *best[1:]]


def _refined(match: Match, edges: EdgePoints, slopes: Sequence[NDArray[np.float32]]) -> Match:
    """The match on more frames, with small turns about the optical axis."""
    frames = evenly_chosen(np.unique(edges.frame).tolist(), _FINE_FRAMES)
    thermal = {frame: edge_field(slopes[frame], match.mirrored) for frame in frames}
    camera = match.camera
    quarter = np.degrees(np.arctan2(camera.rotation[1, 0], camera.rotation[0, 0]))
    trials = [
        _best_shift(edges, thermal, camera.width, camera.height, camera.lens[0] * change, quarter + roll)
        for change in (0.965, 1.0, 1.035)
        for roll in _ROLLS
    ]
    score, found = max(trials, key=lambda trial: trial[0])
    return Match(score, found, match.mirrored)


def edge_field(
    slopes: NDArray[np.float32], mirrored: bool = False, working_width: int = WORKING_WIDTH
) -> NDArray[np.complex64]:
    """[h, w] edges at a working width [px]: strength, and twice the angle of the normal."""
    if mirrored:
        slopes = thermal_edges.mirrored(slopes)
    strength = np.hypot(slopes[..., 0], slopes[..., 1])
    unit = (slopes[..., 0] + 1j * slopes[..., 1]) / np.maximum(strength, 1e-9)
    field = unit**2 * (strength**2 / (strength**2 + _SATURATION**2))
    size = (working_width, max(1, round(working_width * slopes.shape[0] / slopes.shape[1])))
    parts = [
        cv2.resize(np.ascontiguousarray(part), size, interpolation=cv2.INTER_AREA) for part in (field.real, field.imag)
    ]
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def _best_shift(
    edges: EdgePoints,
    thermal: dict[int, NDArray[np.complex64]],
    width: int,
    height: int,
    focal_length: float,
    angle: float,
) -> tuple[float, RigCamera]:
    """The shift that fits best for one focal length [px] and one turn [°] about the optical axis."""
    camera = RigCamera.looking_along(width, height, focal_length, turn_about_axis(angle))
    h, w = next(iter(thermal.values())).shape
    scale = w / width
    pad_h, pad_w = 2 * h, 2 * w
    agreement = np.zeros((pad_h, pad_w), np.complex64)
    drawn_energy = np.zeros((pad_h, pad_w), np.float32)
    thermal_energy = 0.0
    for frame, field in thermal.items():
        drawn = _drawn(edges, frame, camera, scale, pad_h, pad_w)
        agreement += np.fft.fft2(field, (pad_h, pad_w)) * np.conj(np.fft.fft2(drawn))
        drawn_energy += np.abs(drawn) ** 2
        thermal_energy += float((np.abs(field) ** 2).sum())
    window = np.fft.fft2(np.ones((h, w), np.float32), (pad_h, pad_w))
    inside = np.fft.ifft2(window * np.conj(np.fft.fft2(drawn_energy))).real
    inside = np.maximum(inside, LEAST_COVERED * drawn_energy.sum() + 1e-9)
    score = np.fft.ifft2(agreement).real / np.sqrt(inside * thermal_energy + 1e-9)
    y, x = np.unravel_index(score.argmax(), score.shape)
    # drawn fields have their axis in the middle of the padded image: a shift of (h, w) / 2 - pad / 2 is no rotation
    shift = np.array([(x + w) % pad_w - w + pad_w / 2 - w / 2, (y + h) % pad_h - h + pad_h / 2 - h / 2]) / scale
    shift = np.array([_wrapped(shift[0], pad_w / scale), _wrapped(shift[1], pad_h / scale)])
    towards = np.array([shift[0] / focal_length, shift[1] / focal_length, 1.0])
    rotation = rotation_between(np.array([0.0, 0.0, 1.0]), towards / np.linalg.norm(towards)) @ camera.rotation
    return float(score[y, x]), RigCamera.looking_along(width, height, focal_length, rotation)


def _drawn(
    edges: EdgePoints, frame: int, camera: RigCamera, scale: float, height: int, width: int
) -> NDArray[np.complex64]:
    """[height, width] the photograph's edges as the camera sees them, its axis in the middle."""
    chosen = edges.frame == frame
    pixels, depth = camera.project(edges.points[chosen])
    ends, end_depth = camera.project(edges.along[chosen])
    middle = np.array([camera.width, camera.height]) / 2
    at = np.floor((pixels - middle) * scale + np.array([width, height]) / 2)
    fits = (depth > 0) & (end_depth > 0) & (at >= 0).all(1) & (at < [width, height]).all(1)
    along = (ends - pixels)[fits]
    normal = (-along[:, 1] + 1j * along[:, 0]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    x, y = at[fits].astype(int).T
    field = np.zeros((height, width), np.complex64)
    np.add.at(field, (y, x), normal**2)
    strength = np.abs(field)
    parts = [cv2.GaussianBlur(np.ascontiguousarray(part), (0, 0), 0.8) for part in (field.real, field.imag)]
    saturation = 1 / np.maximum(cv2.GaussianBlur(strength, (0, 0), 0.8), 1)
    return ((parts[0] + 1j * parts[1]) * saturation).astype(np.complex64)


def _wrapped(value: float, period: float) -> float:
    return (value + period / 2) % period - period / 2


def turn_about_axis(degrees: float) -> Array:
    """Rotation [3, 3] about the optical axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def rotation_between(one: Array, other: Array) -> Array:
    """The smallest rotation that takes a unit vector to another."""
    axis = np.cross(one, other)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, one @ other)
    return cv2.Rodrigues(axis / max(sine, 1e-12) * angle)[0]
