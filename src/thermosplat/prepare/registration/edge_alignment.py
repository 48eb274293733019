"""A thermal camera's lens and pose on the mount, by moving its edges onto those of the photographs.

Each edge point of a photograph is projected to the thermal image and looked for along the normal of its edge. The
distance to the strongest slope there is the residual: nothing is known along an edge. Gauss-Newton steps with a robust
weight (Geman and McClure) change the eleven unknowns of the rig, which all frames share. Windows shrink from step to
step. Most edges of a photograph are invisible to a thermal camera (print, checks). They find nothing, or noise on
either side alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.rig_camera import UNKNOWNS, Array, RigCamera
from thermosplat.prepare.registration.stereo_edges import EdgePoints, sampled

_DIRECTION = UNKNOWNS[:7]
STAGES = (
    (_DIRECTION, ((10, 4.0),) * 5),
    ((*_DIRECTION, "k1"), ((6, 3.0),) * 6),
    (UNKNOWNS, ((4, 1.5),) * 6 + ((3, 0.8),) * 6),
)
"""Which unknowns change, and step by step how far an edge is looked for and the scale of the robust weight. Both are
pixels of an image that is 320 px wide: in larger images they are larger, in smaller ones the same.
The lens follows when the direction is about right: with all unknowns from the start, wrong matches bend it."""
LEAST_SLOPE = 0.25
"""Slope [contrasts per pixel] below which there is no edge."""
USUAL_WIDTH = 320
_FEWEST_MATCHES = 200
_STEP = 0.5
_MARGIN = 4
_SPREADS = np.array([np.inf] * 3 + [np.nan] * 3 + [np.inf, 0.04, 0.04, 0.6, 0.4])
"""How far each unknown is from its usual value [rad, -, -, image widths, -]; translations follow the scene's depth.
They decide only where the images do not."""
_TRANSLATION = 0.3
"""Usual baseline in median depths, at most."""


Stage = tuple[Sequence[str], Sequence[tuple[float, float]]]


@dataclass(frozen=True)
class Meeting:
    """How the edges of a photograph meet those of a thermal image.

    Args:
        points: Edge points inside the thermal image.
        near: How many of them have a thermal edge within 1 px.
        by_chance: The same with the thermal image moved aside: what noise and clutter give.
    """

    points: int
    near: int
    by_chance: float


@dataclass(frozen=True, eq=False)
class Alignment:
    """A camera that was aligned.

    Args:
        deviations: [11] standard deviations of ``rig_camera.UNKNOWNS`` from the residuals' scatter.
        frames: How edges meet in each frame that has edge points inside; none where too few are found to align by.
    """

    camera: RigCamera
    deviations: Array
    frames: dict[int, Meeting]

    @property
    def near(self) -> float:
        """Share of all edge points inside the thermal images that have a thermal edge within 1 px."""
        return sum(met.near for met in self.frames.values()) / max(sum(met.points for met in self.frames.values()), 1)

    @property
    def by_chance(self) -> float:
        """The same share with the thermal images moved aside."""
        points = sum(met.points for met in self.frames.values())
        return sum(met.by_chance for met in self.frames.values()) / max(points, 1)


def align(
    camera: RigCamera,
    edges: EdgePoints,
    slopes: Sequence[NDArray[np.float32]],
    *,
    stages: Sequence[Stage] = STAGES,
) -> Alignment:
    """Move a camera until its edges lie on those of the photographs.

    Args:
        camera: Where to start: edges have to be within the first window.
        slopes: Slopes [H, W, 2] of each frame's thermal image.
        stages: Which of ``rig_camera.UNKNOWNS`` change, with search range and robust scale of each step [px].
    """
    usual = RigCamera.looking_along(camera.width, camera.height, 1.0)
    information = prior_information(edges, camera)
    finer = max(1.0, camera.width / USUAL_WIDTH)
    steps = [(names, (finer * reach, finer * scale)) for names, windows in stages for reach, scale in windows]
    deviations = np.zeros(len(UNKNOWNS))
    with progress_bar("alignment", len(steps)) as advance:
        for names, (reach, scale) in steps:
            free = np.array([UNKNOWNS.index(name) for name in names])
            points, offsets, normals = matches(camera, edges, slopes, reach)
            if len(points) < _FEWEST_MATCHES:
                return Alignment(camera, np.full(len(UNKNOWNS), np.inf), {})
            rows = np.einsum("ni,nij->nj", normals, camera.derivatives(edges.points[points]))
            weights = 1 / (1 + (offsets / scale) ** 2) ** 2
            away = np.concatenate([np.zeros(3), camera.translation, [0.0], camera.lens[1:] - usual.lens[1:]])
            normal_matrix = (rows * weights[:, None]).T @ rows + np.diag(information)
            right_side = (rows * weights[:, None]).T @ offsets - information * away
            inverse = np.linalg.inv(normal_matrix[np.ix_(free, free)])
            step = np.zeros(len(UNKNOWNS))
            step[free] = inverse @ right_side[free]
            camera = camera.moved(step)
            scatter = (weights * offsets**2).sum() / weights.sum()
            deviations[free] = np.sqrt(np.diag(inverse) * scatter)
            advance(1)
    return Alignment(camera, deviations, _meetings(camera, edges, slopes))


def edge_information(camera: RigCamera, edges: EdgePoints, slopes: Sequence[NDArray[np.float32]]) -> Array:
    """[11, 11] what the matches of a camera that is aligned say of all unknowns, by the scatter of their residuals."""
    reach, scale = (max(1.0, camera.width / USUAL_WIDTH) * value for value in STAGES[-1][1][-1])
    points, offsets, normals = matches(camera, edges, slopes, reach)
    rows = np.einsum("ni,nij->nj", normals, camera.derivatives(edges.points[points]))
    weights = 1 / (1 + (offsets / scale) ** 2) ** 2
    scatter = (weights * offsets**2).sum() / max(weights.sum(), 1e-9)
    return (rows * weights[:, None]).T @ rows / max(scatter, 1e-9)


def prior_information(edges: EdgePoints, camera: RigCamera) -> Array:
    """[11] how firmly each of ``rig_camera.UNKNOWNS`` is near its usual value: one over its variance."""
    depth = float(np.median(edges.points[:, 2])) if len(edges.points) else 1.0
    spreads = _SPREADS.copy()
    spreads[3:6] = _TRANSLATION * depth
    spreads[7:9] *= camera.width
    return 1 / spreads**2


def projected(camera: RigCamera, edges: EdgePoints) -> tuple[NDArray[np.int64], Array, Array]:
    """Which points lie inside the image, their pixels, and the unit normals of their edges there."""
    pixels, depth = camera.project(edges.points)
    ends, end_depth = camera.project(edges.along)
    along = ends - pixels
    length = np.linalg.norm(along, axis=1)
    low, high = _MARGIN, np.array([camera.width, camera.height]) - _MARGIN
    inside = (depth > 0) & (end_depth > 0) & (pixels > low).all(1) & (pixels < high).all(1) & (length > 0.05)
    chosen = np.flatnonzero(inside)
    normals = np.column_stack([along[chosen, 1], -along[chosen, 0]]) / length[chosen, None]
    return chosen, pixels[chosen], normals


def slopes_across(
    edges: EdgePoints,
    chosen: NDArray[np.int64],
    pixels: Array,
    normals: Array,
    slopes: Sequence[NDArray[np.float32]],
    offsets: Array,
) -> Array:
    """[N, M] strength of the slope across each edge at the offsets [px] along its normal."""
    frame = edges.frame[chosen]
    profiles = np.zeros((len(chosen), len(offsets)))
    for number in np.unique(frame):
        mine = frame == number
        at = pixels[mine, None] - 0.5 + offsets[:, None] * normals[mine, None]
        slope = sampled(slopes[number], at.reshape(-1, 2)).reshape(at.shape)
        profiles[mine] = np.abs((slope * normals[mine, None]).sum(2))
    return profiles


def matches(
    camera: RigCamera, edges: EdgePoints, slopes: Sequence[NDArray[np.float32]], reach: float
) -> tuple[NDArray[np.int64], Array, Array]:
    """Edge points that find an edge: their numbers, its offset [px] along the normal, and the normal."""
    chosen, pixels, normals = projected(camera, edges)
    offsets = np.arange(-reach, reach + _STEP / 2, _STEP)
    profiles = slopes_across(edges, chosen, pixels, normals, slopes, offsets)
    nearby = profiles * np.exp(-((offsets / reach) ** 2))
    peak = nearby[:, 1:-1].argmax(1) + 1
    row = np.arange(len(chosen))
    before, here, after = profiles[row, peak - 1], profiles[row, peak], profiles[row, peak + 1]
    kept = (here >= before) & (here >= after) & (here > LEAST_SLOPE)
    between = 0.5 * (before - after) / np.minimum(before - 2 * here + after, -1e-9)
    found = offsets[peak] + _STEP * np.clip(between, -1, 1)
    return chosen[kept], found[kept], normals[kept]


def _meetings(camera: RigCamera, edges: EdgePoints, slopes: Sequence[NDArray[np.float32]]) -> dict[int, Meeting]:
    """In each frame, edge points with a thermal edge within 1 px, and those 8 px aside."""
    chosen, pixels, normals = projected(camera, edges)
    within = np.arange(-1, 1.1, _STEP)
    here, left, right = (
        slopes_across(edges, chosen, pixels, normals, slopes, within + away).max(1, initial=0) > LEAST_SLOPE
        for away in (0, -8, 8)
    )
    frame = edges.frame[chosen]
    return {
        int(number): Meeting(int(mine.sum()), int(here[mine].sum()), float(left[mine].sum() + right[mine].sum()) / 2)
        for number in np.unique(frame)
        if (mine := frame == number).any()
    }
