"""The first pose of one thermal image: a correlation of edges from where GPS has it.

As in ``edge_correlation``, edges are complex numbers with twice the angle of their normal. Each image is searched
alone: wind turns a drone by degrees from image to image, which is tens of pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

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


class Sought(NamedTuple):
    """The edges of an image, to be found in views.

    Args:
        spectrum: Of the padded field.
        energy: Of the field.
        shape: Of the field.
    """

    spectrum: Field
    energy: float
    shape: tuple[int, int]

    @classmethod
    def of(cls, field: Field) -> "Sought":
        """Of the field of an image."""
        height, width = field.shape
        spectrum: Field = np.fft.fft2(field, (2 * height, 2 * width)).astype(np.complex64)
        return cls(spectrum, float((np.abs(field) ** 2).sum()), (height, width))


class View(NamedTuple):
    """The photographs' edges before a camera, to find images in.

    Args:
        pose: The camera's.
        lens: Its lens.
        spectrum: Of the drawn edges, conjugate.
        inside: Energy of the edges that each shift has inside an image.
    """

    pose: Pose
    lens: RigCamera
    spectrum: Field
    inside: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        photographs: Photographs,
        near: Sequence[int],
        pose: Pose,
        lens: RigCamera,
        shape: tuple[int, int],
        weights: Array | None,
    ) -> "View":
        """What a camera sees of the edges of some photographs, for fields of a shape."""
        drawn = _drawn(photographs, near, pose.camera(lens), shape, weights)
        window = np.fft.fft2(np.ones(shape, np.float32), drawn.shape)
        energy = np.abs(drawn) ** 2
        inside = np.fft.ifft2(window * np.conj(np.fft.fft2(energy))).real
        return cls(pose, lens, np.conj(np.fft.fft2(drawn)), np.maximum(inside, LEAST_COVERED * energy.sum() + 1e-9))

    def peaks(self, sought: Sought, reach: float, most: int = 2) -> list[tuple[float, Pose]]:
        """Score and pose of the best agreement of an image, and of the best ones elsewhere, up to a shift [widths]."""
        (h, w), (tall, wide) = sought.shape, self.inside.shape
        score = np.fft.ifft2(sought.spectrum * self.spectrum).real / np.sqrt(self.inside * sought.energy + 1e-9)
        score = np.roll(score, ((tall - h) // 2 + tall // 2, (wide - w) // 2 + wide // 2), (0, 1))
        radius = round(reach * w)
        rows, columns = (slice(size // 2 - radius, size // 2 + radius + 1) for size in score.shape)
        near = score[rows, columns]
        peaks = []
        for _ in range(most):
            y, x = np.unravel_index(near.argmax(), near.shape)
            cells = np.array([x - radius, y - radius]) / w
            peaks.append((float(near[y, x]), self._shifted(cells)))
            near[max(0, y - _ONE_PEAK) : y + _ONE_PEAK + 1, max(0, x - _ONE_PEAK) : x + _ONE_PEAK + 1] = -np.inf
        return peaks

    def _shifted(self, shift: Array) -> Pose:
        """The pose turned so that the middle of the image is seen elsewhere by a shift [image widths]."""
        towards = np.array([*shift * self.lens.width / self.lens.lens[0], 1.0])
        rotation = rotation_between(np.array([0.0, 0.0, 1.0]), towards / np.linalg.norm(towards))
        return Pose(rotation @ self.pose.rotation, self.pose.centre)


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
    sought, found = Sought.of(field), []
    for start in starts:
        near = photographs.near(start, edges_of)
        views = [View.of(photographs, near, turned(start, turn), lens, sought.shape, weights) for turn in turns]
        found.append(max((view.peaks(sought, reach) for view in views), key=lambda two: two[0][0]))
    found.sort(key=lambda two: -two[0][0])
    (score, pose), (other_score, other) = found[0]
    return Trial(score, pose, other, score / max(other_score, *(two[0][0] for two in found[1:2]), 1e-9))


def turned(pose: Pose, angle: float) -> Pose:
    """The pose turned about its optical axis [°]."""
    return Pose(turn_about_axis(angle) @ pose.rotation, pose.centre)


def _drawn(
    photographs: Photographs, near: Sequence[int], camera: RigCamera, shape: tuple[int, int], weights: Array | None
) -> Field:
    """[2h, 2w] the photographs' edges as the camera sees them, the image of that shape in the middle."""
    height, width = 2 * shape[0], 2 * shape[1]
    numbers = photographs.before(camera, near, weights)
    edges = photographs.some(numbers)
    pixels, ends = camera.project(edges.points)[0], camera.project(edges.along)[0]
    middle = np.array([camera.width, camera.height]) / 2
    at = np.floor((pixels - middle) * shape[1] / camera.width + np.array([width, height]) / 2)
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
