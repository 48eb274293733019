"""The first pose of one thermal image: a correlation of edges from where GPS has it.

As in ``edge_correlation``, edges are complex numbers with twice the angle of their normal. Each image is searched
alone: wind turns a drone by degrees from image to image, which is tens of pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.placing.world_edges import Photographs, Pose
from thermosplat.prepare.registration.edge_correlation import LEAST_COVERED, rotation_between, turn_about_axis
from thermosplat.prepare.registration.rig_camera import Array, RigCamera

SEARCH_WIDTH = 160
"""Width [px] at which edges are compared."""
_BLUR = 0.8
"""Standard deviation [px] of drawn edges."""
_ONE_PEAK = 5
"""Distance [px of the field] from the best shift up to which others are the same."""

Field = NDArray[np.complex64]


@dataclass(frozen=True, eq=False)
class Trial:
    """A pose that was tried.

    Args:
        score: Normalised correlation of the edges, 1 for the same.
        pose: The pose.
        other: The next best pose from the same start.
        clear: How many times the score is that of the next best pose from any start.
    """

    score: float
    pose: Pose
    other: Pose
    clear: float


def best_trial(
    field: Field,
    photographs: Photographs,
    starts: Sequence[Pose],
    lens: RigCamera,
    turns: Sequence[float],
    *,
    edges_of: int,
    reach: float,
    weights: Array | None = None,
) -> Trial:
    """The pose near some others at which edges agree best.

    Args:
        field: Edges of the thermal image at the working width.
        photographs: The photographs.
        starts: Poses to search about.
        lens: The thermal lens.
        turns: Turns about the optical axis that are tried [°].
        edges_of: How many photographs' edges are drawn.
        reach: Largest shift [image widths].
        weights: How much each edge point of the photographs counts, 0 to 1; None: all alike.
    """
    found = []
    for start in starts:
        near, peaks = photographs.near(start, edges_of), []
        for turn in turns:
            pose = Pose(turn_about_axis(turn) @ start.rotation, start.centre)
            drawn = _drawn(photographs, near, pose.camera(lens), field, weights)
            peaks.append([(score, _shifted(pose, lens, cells)) for score, cells in _peaks(field, drawn, reach)])
        found.append(max(peaks, key=lambda two: two[0][0]))
    found.sort(key=lambda two: -two[0][0])
    (score, pose), (other_score, other) = found[0]
    return Trial(score, pose, other, score / max(other_score, *(two[0][0] for two in found[1:2]), 1e-9))


def _shifted(pose: Pose, lens: RigCamera, cells: Array) -> Pose:
    """The pose turned so that the middle of the image is seen elsewhere by so many cells."""
    towards = np.array([*cells * lens.width / SEARCH_WIDTH / lens.lens[0], 1.0])
    return Pose(
        rotation_between(np.array([0.0, 0.0, 1.0]), towards / np.linalg.norm(towards)) @ pose.rotation, pose.centre
    )


def _drawn(
    photographs: Photographs, near: Sequence[int], camera: RigCamera, field: Field, weights: Array | None
) -> Field:
    """[2h, 2w] the photographs' edges as the camera sees them, the image in the middle, in units of the field."""
    height, width = 2 * field.shape[0], 2 * field.shape[1]
    numbers = photographs.before(camera, near, weights)
    edges = photographs.some(numbers)
    pixels, ends = camera.project(edges.points)[0], camera.project(edges.along)[0]
    middle = np.array([camera.width, camera.height]) / 2
    at = np.floor((pixels - middle) * field.shape[1] / camera.width + np.array([width, height]) / 2)
    fits = (at >= 0).all(1) & (at < [width, height]).all(1)
    along = (ends - pixels)[fits]
    normal = (-along[:, 1] + 1j * along[:, 0]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    x, y = at[fits].astype(int).T
    drawn, count = np.zeros((height, width), np.complex64), np.zeros((height, width), np.float32)
    np.add.at(drawn, (y, x), normal**2 if weights is None else normal**2 * weights[numbers[fits]])
    np.add.at(count, (y, x), 1)
    parts = [cv2.GaussianBlur(np.ascontiguousarray(part), (0, 0), _BLUR) for part in (drawn.real, drawn.imag)]
    full = np.maximum(cv2.GaussianBlur(count, (0, 0), _BLUR), 1)
    return ((parts[0] + 1j * parts[1]) / full).astype(np.complex64)


def _peaks(field: Field, drawn: Field, reach: float) -> list[tuple[float, Array]]:
    """Score and shift [px of the field] of the best agreement, and of the best one elsewhere."""
    (h, w), (tall, wide) = field.shape, drawn.shape
    agreement = np.fft.ifft2(np.fft.fft2(field, drawn.shape) * np.conj(np.fft.fft2(drawn))).real
    window = np.fft.fft2(np.ones((h, w), np.float32), drawn.shape)
    energy = np.abs(drawn) ** 2
    inside = np.fft.ifft2(window * np.conj(np.fft.fft2(energy))).real
    inside = np.maximum(inside, LEAST_COVERED * energy.sum() + 1e-9)
    score = agreement / np.sqrt(inside * (np.abs(field) ** 2).sum() + 1e-9)
    score = np.roll(score, ((tall - h) // 2 + tall // 2, (wide - w) // 2 + wide // 2), (0, 1))
    radius = round(reach * w)
    rows, columns = (slice(size // 2 - radius, size // 2 + radius + 1) for size in score.shape)
    near = score[rows, columns]
    peaks = []
    for _ in range(2):
        y, x = np.unravel_index(near.argmax(), near.shape)
        peaks.append((float(near[y, x]), np.array([x - radius, y - radius], np.float64)))
        near[max(0, y - _ONE_PEAK) : y + _ONE_PEAK + 1, max(0, x - _ONE_PEAK) : x + _ONE_PEAK + 1] = -np.inf
    return peaks
