"""All poses of thermal images, their one lens and the common error of their GPS, adjusted together.

Residuals are distances of edges along their normals, as in ``edge_alignment``, and distances from GPS less its common
error. Once some images are placed, they are also differences of an image's look from theirs. Edges tie images to the
photographs, looks tie them to each other. Gauss-Newton steps with Geman and McClure's weights change all unknowns at
once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermosplat.prepare.placing.thermal_looks import Expected, Scene, Shown, compared
from thermosplat.prepare.placing.world_edges import Pose
from thermosplat.prepare.registration.edge_alignment import USUAL_WIDTH, matches
from thermosplat.prepare.registration.rig_camera import UNKNOWNS, Array, RigCamera, cross_matrices

_COUNT = 150.0
"""So many measurements the edges of an image are worth at most, and its look: neighbouring edge points err together."""
_COUNT_BESIDE_LOOKS = 30.0
"""So many the edges of an image are worth where its look counts, too: a ledge below a roof's edge draws all images of
one flight line aside alike, and other lines see it otherwise."""
_LEAST_SCALE = 0.7
"""Standard deviation [px] of an edge's place, at least."""
_FEWEST_MATCHES = 30
_TO_DEVIATION = 1.4826
"""Standard deviation of the median absolute value of a normal distribution."""
_LEAST_GAIN = 0.3
"""Contrast of an image beside that of the mean of others, at least. Open choice."""
_LENS_SPREADS = np.array([np.inf, 0.04, 0.04, 0.6, 0.4])
"""How far the lens is from its usual values, as ``edge_alignment`` has it: only edges tell the focal length."""
_COMMON_ERROR = 10.0
"""Standard deviation [m] of the error that all GPS positions share: receivers promise 8 m for 95% of the time."""
_ROBUST = 3.0
"""Standard deviations from GPS at which its weight is a half (Cauchy). Open choice."""
_STEP_IN_DEVIATIONS, _STEP_OF_TURN = 4.0, 0.05
"""Usual size of one step: of a place [standard deviations of GPS], of a turn [rad]. An image with few edges goes no
farther (Levenberg's damping)."""
_POSE, _LENS, _SHARED = 6, 5, 8

Window = tuple[float, float, int | None]
"""How far an edge is looked for and the scale of its robust weight, as in ``edge_alignment.STAGES``; which of
``thermal_looks.SCALES`` is compared, None: edges alone."""
Step = tuple[Sequence[str], Window]
"""Unknowns of the lens that change, and the window."""

ALL = ("log_f", "k1", "cx", "cy", "k2")
PLAIN_STEPS: list[Step] = [
    *[(ALL[:1], (10.0, 4.0, None))] * 3,
    *[(ALL[:2], (8.0, 3.0, None))] * 5,
    *[(ALL[:4], (5.0, 2.0, None))] * 5,
]
FINE_STEPS: list[Step] = [
    (ALL, window) for window in ((3.0, 1.25, None), (2.0, 0.75, None), (1.5, 0.5, None)) for _ in range(4)
]
"""The lens follows when poses are about right. By all edges, and by those of temperature."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """What is known of thermal images.

    Args:
        lens: Their lens, at the pose of no rig.
        poses: By number of the image.
        common_error: What GPS positions are wrong by together, [3].
        deviation: Standard deviation of GPS beyond that, by axis.
    """

    lens: RigCamera
    poses: Mapping[int, Pose]
    common_error: Array
    deviation: float


def adjusted(scene: Scene, known: Adjusted, steps: Sequence[Step], shown: Shown | None = None) -> Adjusted:
    """Poses, lens and common error after some steps.

    Args:
        scene: Edges and places.
        known: Where to start.
        steps: The steps.
        shown: What placed images show; None: any edge counts.
    """
    numbers = sorted(known.poses)
    poses, lens, common = dict(known.poses), known.lens, known.common_error
    size = _POSE * len(numbers)
    for names, window in steps:
        normal, right = np.zeros((size + _SHARED,) * 2), np.zeros(size + _SHARED)
        shared = np.arange(size, size + _SHARED)
        for place, number in enumerate(numbers):
            mine = np.concatenate([np.arange(_POSE * place, _POSE * (place + 1)), shared])
            own = None if shown is None else shown.without(number)
            error = scene.places[number] - common - poses[number].centre
            matrix, side = _of_image(scene, number, poses[number], lens, window, own, error, known.deviation)
            normal[np.ix_(mine, mine)] += matrix
            right[mine] += side
        away = np.concatenate([[0.0], lens.lens[1:] - [lens.width / 2, lens.height / 2, 0, 0], common])
        spreads = _LENS_SPREADS * [1, lens.width, lens.width, 1, 1]
        information = 1 / np.concatenate([spreads, np.full(3, _COMMON_ERROR)]) ** 2
        normal[shared, shared] += information
        right[shared] -= information * away
        free = np.array([*range(size), *(size + UNKNOWNS.index(name) - _POSE for name in names), *shared[_LENS:]])
        change = np.zeros(size + _SHARED)
        change[free] = np.linalg.solve(normal[np.ix_(free, free)], right[free])
        moved = {
            number: Pose.of(poses[number].camera(lens).moved(np.concatenate([turn, np.zeros(_LENS)])))
            for number, turn in zip(numbers, change[:size].reshape(-1, _POSE))
        }
        poses, common = moved, common + change[size + _LENS :]
        lens = lens.moved(np.concatenate([np.zeros(_POSE), change[size : size + _LENS]]))
    off = [float(np.linalg.norm(scene.places[n] - common - poses[n].centre)) for n in numbers]
    return replace(
        known, lens=lens, poses=poses, common_error=common, deviation=_deviation(off, known.deviation, scene.deviation)
    )


def aligned(
    scene: Scene, number: int, pose: Pose, known: Adjusted, windows: Sequence[Window], expected: Expected
) -> Pose:
    """The pose of one image after some steps of its own.

    Args:
        scene: Edges and places.
        number: The image.
        pose: Where to start.
        known: The lens, and what is known of GPS.
        windows: The window of each.
        expected: What the image should show.
    """
    for window in windows:
        error = scene.places[number] - known.common_error - pose.centre
        matrix, side = _of_image(scene, number, pose, known.lens, window, expected, error, known.deviation)
        if not matrix[:3, :3].any():
            return pose
        change = np.linalg.solve(matrix[:_POSE, :_POSE], side[:_POSE])
        pose = Pose.of(pose.camera(known.lens).moved(np.concatenate([change, np.zeros(_LENS)])))
    return pose


def _deviation(off: Sequence[float], otherwise: float, least: float) -> float:
    """Standard deviation by axis of the median distance in three dimensions (chi distribution)."""
    return max(float(np.median(off)) / 1.538, least) if len(off) else otherwise


def _of_image(
    scene: Scene,
    number: int,
    pose: Pose,
    lens: RigCamera,
    window: Window,
    expected: Expected | None,
    error: Array,
    deviation: float,
) -> tuple[Array, Array]:
    """Normal matrix [14, 14] and right side [14] of one image: its pose, the lens, the common error of GPS."""
    reach, scale = np.multiply(window[:2], max(1.0, lens.width / USUAL_WIDTH))
    camera = pose.camera(lens)
    numbers = scene.before(pose, lens, None if expected is None else expected.weights)
    edges = scene.photographs.some(numbers)
    known = np.ones(len(numbers)) if expected is None else expected.weights[numbers]
    points, offsets, normals = matches(camera, edges, [scene.images[number].slopes], reach)
    normal, right = np.zeros((_POSE + _SHARED,) * 2), np.zeros(_POSE + _SHARED)
    if len(points) >= _FEWEST_MATCHES:
        rows = np.einsum("ni,nij->nj", normals, camera.derivatives(edges.points[points]))
        weight = known[points] / (1 + (offsets / scale) ** 2) ** 2
        most = _COUNT if window[2] is None else _COUNT_BESIDE_LOOKS
        weight *= most / max(weight.sum(), most) / max(scale / 2, _LEAST_SCALE) ** 2
        normal[: _POSE + _LENS, : _POSE + _LENS] = (rows * weight[:, None]).T @ rows
        right[: _POSE + _LENS] = (rows * weight[:, None]).T @ offsets
    if expected is not None and window[2] is not None:
        matrix, side = _of_look(scene, number, pose, lens, window[2], expected)
        normal[: _POSE + _LENS, : _POSE + _LENS] += matrix
        right[: _POSE + _LENS] += side
    weight_gps = 1 / (1 + (error @ error) / (_ROBUST * deviation) ** 2) / deviation**2
    moves = np.zeros((3, _POSE + _SHARED))  # the centre is -R't, and R becomes exp([w]x) R
    moves[:, :3] = -camera.rotation.T @ cross_matrices(camera.translation[None])[0]
    moves[:, 3:_POSE] = -camera.rotation.T
    moves[:, _POSE + _LENS :] = np.eye(3)
    normal[:_POSE, :_POSE] += moves[:, :_POSE].T @ moves[:, :_POSE] / (_STEP_IN_DEVIATIONS * deviation) ** 2
    normal[range(3), range(3)] += 1 / _STEP_OF_TURN**2
    return normal + weight_gps * moves.T @ moves, right + weight_gps * moves.T @ error


def _of_look(
    scene: Scene, number: int, pose: Pose, lens: RigCamera, scale: int, expected: Expected
) -> tuple[Array, Array]:
    """Normal matrix [11, 11] and right side [11] of an image's look at a scale: its pose and the lens."""
    points, pixels, theirs = compared(scene, pose, lens, scale, expected)
    if len(points) < _FEWEST_MATCHES:
        return np.zeros((_POSE + _LENS,) * 2), np.zeros(_POSE + _LENS)
    image = scene.images[number]
    look, slopes = image.look(scale, pixels), image.look_slopes(scale, pixels)
    residuals = max(float(look @ theirs / (theirs @ theirs + 1e-12)), _LEAST_GAIN) * theirs - look
    deviation = _TO_DEVIATION * float(np.median(np.abs(residuals))) + 1e-9
    weight = 1 / (1 + (residuals / (2 * deviation)) ** 2) ** 2 * expected.seen[points] / (expected.seen[points] + 1)
    weight *= _COUNT / max(weight.sum(), _COUNT) / deviation**2
    rows = np.einsum("ni,nij->nj", slopes, pose.camera(lens).derivatives(scene.photographs.edges.points[points]))
    return (rows * weight[:, None]).T @ rows, (rows * weight[:, None]).T @ residuals
