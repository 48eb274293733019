"""Images that are read line by line while the camera moves: in which order, and where the camera was.

A pose is world to camera, [4, 4]. A *motion* is a pair of matrices [2, 4, 4] from the camera axes of an image's own
pose to those when the middle of its first line is read, and of its last: ``motion[0] @ viewmat`` is the pose at the
first line. Times count readouts: 0 at the first line, 1 at the last. Between them the rotation turns evenly and the
translation moves evenly, as the renderer has it (docs/conventions.md).
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.lens import Lens, positions_in_file

LineOrder = Literal["top-to-bottom", "left-to-right", "bottom-to-top", "right-to-left"]

_SAMPLES = 33
"""Places along each side of an image at which it is looked up where its pixels lay in the file."""


@dataclass(frozen=True, eq=False)
class Readout:
    """How one image was read.

    Args:
        order: In which order its lines were read; "left-to-right" and its reverse are columns.
        motion: [2, 4, 4] float64, the camera's motion from its first line to its last.
    """

    order: LineOrder
    motion: NDArray[np.float64]

    def is_same_as(self, other: "Readout | None") -> bool:
        """Whether another image was read in the same way, with the same motion."""
        return other is not None and self.order == other.order and np.array_equal(self.motion, other.motion)

    def scaled(self, factor: float) -> "Readout":
        """The readout in other units of length: a motion is so many times as long."""
        motion = self.motion.copy()
        motion[:, :3, 3] *= factor
        return Readout(self.order, motion)

    def lines(self, camera: Camera) -> int:
        """How many lines an image of a camera has."""
        return camera.height if self.order in ("top-to-bottom", "bottom-to-top") else camera.width

    def between(self, first: float, last: float) -> "Readout":
        """The readout of an image whose first and last line belong to these times, which may be beyond 0 and 1."""
        return Readout(self.order, np.stack([self._pose_at(first), self._pose_at(last)]))

    def resized(self, before: Camera, after: Camera) -> "Readout":
        """The readout of the same image at another size.

        Args:
            before: The camera of the image that this is the readout of.
            after: The camera of the resized image.
        """
        lines, others = self.lines(before), self.lines(after)
        if lines == others or lines == 1:
            return self
        first = (0.5 * lines / others - 0.5) / (lines - 1)
        return self.between(first, 1.0 - first)

    def undistorted(self, lens: Lens, file: tuple[int, int], camera: Camera) -> "Readout":
        """The readout of the pinhole image that an image becomes: each of its lines has the mean time of its pixels.

        A line of the pinhole image is a curve in the file. The times along it differ; their mean is fitted by a
        straight line over the image.

        Args:
            file: Width and height of the file's image [px].
        """
        across = self.order in ("left-to-right", "right-to-left")
        axis = 0 if across else 1
        x, y = np.meshgrid(
            np.linspace(0.5, camera.width - 0.5, _SAMPLES), np.linspace(0.5, camera.height - 0.5, _SAMPLES)
        )
        at = positions_in_file(lens, *file, camera, np.stack([x, y], axis=-1))[..., axis]
        lines, others = file[axis], self.lines(camera)
        if lines == 1 or others == 1:
            return self
        times = (at - 0.5) / (lines - 1)
        slope, start = np.polyfit(((x if across else y).ravel() - 0.5) / (others - 1), times.ravel(), 1)
        if self.order in ("bottom-to-top", "right-to-left"):  # the last line is the first that is read
            start = 1.0 - start - slope
        return self.between(start, start + slope)

    def _pose_at(self, time: float) -> NDArray[np.float64]:
        first, last = self.motion
        turn = cv2.Rodrigues(last[:3, :3] @ first[:3, :3].T)[0]
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(time * turn)[0] @ first[:3, :3]
        pose[:3, 3] = (1.0 - time) * first[:3, 3] + time * last[:3, 3]
        return pose


def motion_of(
    viewmat: NDArray[np.float64], turning: NDArray[np.float64], moving: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The motion of a camera whose pose is that of the middle of the readout, [2, 4, 4].

    Args:
        viewmat: Its pose, [4, 4].
        turning: Rotation vector of its axes during the readout, in its own axes [rad], [3].
        moving: How far its centre moves in the world during the readout [world units], [3].
    """
    motion = np.stack([np.eye(4), np.eye(4)])
    for half, pose in zip((-0.5, 0.5), motion, strict=True):
        pose[:3, :3] = cv2.Rodrigues(half * turning)[0]
        # the centre moves by `moving`, so what the camera sees moves against it
        pose[:3, 3] = -pose[:3, :3] @ viewmat[:3, :3] @ (half * moving)
    return motion


def paces(viewmats: NDArray[np.float64], times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How fast a camera turned and moved at each of its images, from the images before and after.

    The parabola through three poses one after the other is differentiated, of the first and the last image at its end;
    of two poses the difference is taken.

    Args:
        viewmats: Poses in the order of time, [V, 4, 4], V >= 2.
        times: When they were, strictly ascending, [V].

    Returns:
        Rotation vectors of the axes in camera axes [rad per unit of time], [V, 3], and velocities of the centres in the
        world [world units per unit of time], [V, 3].
    """
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("vji,vj->vi", rotations, viewmats[:, :3, 3])
    gaps = np.diff(times)[:, None]
    steps = rotations[1:] @ rotations[:-1].transpose(0, 2, 1)
    turns = np.stack([cv2.Rodrigues(step)[0][:, 0] for step in steps]) / gaps
    moves = np.diff(centers, axis=0) / gaps
    return _slopes(turns, gaps), _slopes(moves, gaps)


def _slopes(between: NDArray[np.float64], gaps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives at V times of parabolas whose mean slopes between them are known, [V-1, 3]."""
    if len(between) == 1:
        return np.repeat(between, 2, axis=0)
    inner = (gaps[1:] * between[:-1] + gaps[:-1] * between[1:]) / (gaps[1:] + gaps[:-1])
    return np.concatenate([2 * between[:1] - inner[:1], inner, 2 * between[-1:] - inner[-1:]])
