"""Contours of temperature as points in space, beside the edges that photographs show.

Each placed thermal image has contours of its own. They lie as deep as the photographs' edges around them, where these
lie on one surface. To the other images they are edges as those of photographs are.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.placing.adjustment import Adjusted
from thermosplat.prepare.placing.thermal_looks import EDGES_OF, Scene, ThermalImage
from thermosplat.prepare.placing.world_edges import Photographs, Pose
from thermosplat.prepare.registration.edge_alignment import LEAST_SLOPE
from thermosplat.prepare.registration.rig_camera import Array, RigCamera
from thermosplat.prepare.registration.stereo_edges import EdgePoints

_MOST = 2000
"""Points of one image."""
_WINDOW, _FEWEST = 21, 4
"""Edge points of photographs within a square of so many pixels tell how deep a contour lies, if there are so many."""
_ONE_SURFACE = 0.03
"""Standard deviation of the depths of one surface there, at most, over their mean. A step of 3 m, seen from 30 m, has
0.05 where either side has half of the points."""


def with_contours(scene: Scene, known: Adjusted, numbers: Sequence[int]) -> Scene:
    """The scene with contours of some thermal images beside the photographs' edges.

    Args:
        scene: Edges and images.
        known: Their lens and poses.
        numbers: The images that are placed.
    """
    photographs = scene.photographs
    count = len(photographs.poses)
    edges, last = photographs.edges, int(np.searchsorted(photographs.edges.frame, count))
    edges = EdgePoints(edges.frame[:last], edges.points[:last], edges.along[:last])
    plain = Photographs(photographs.poses, edges)
    found = [
        _contours(plain, scene.images[number], known.poses[number], known.lens, count + place)
        for place, number in enumerate(numbers)
    ]
    placed = {number: known.poses[number] for number in numbers}
    return scene._replace(photographs=Photographs(photographs.poses, EdgePoints.joined([edges, *found]), placed))


def _contours(plain: Photographs, image: ThermalImage, pose: Pose, lens: RigCamera, frame: int) -> EdgePoints:
    """Contours of one image in the world."""
    camera = pose.camera(lens)
    scaled = [np.clip(1000 * image.slopes[..., axis], -32000, 32000).astype(np.int16) for axis in (0, 1)]
    y, x = np.nonzero(cv2.Canny(scaled[0], scaled[1], 1000 * LEAST_SLOPE, 2000 * LEAST_SLOPE, L2gradient=True))
    chosen = np.random.default_rng(0).permutation(len(x))[:_MOST]
    y, x = y[chosen], x[chosen]
    pixels, normals = np.column_stack([x, y]) + 0.5, image.slopes[y, x].astype(np.float64)
    numbers = plain.before(camera, plain.near(pose, EDGES_OF))
    depth, one_surface = _depths(*camera.project(plain.edges.points[numbers]), image.slopes.shape[:2])
    kept = one_surface[y, x]
    pixels, normals, depth = pixels[kept], normals[kept], depth[y, x][kept]
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    lens_model = lens.colmap_camera()
    points, along = (
        np.column_stack([lens_model.cam_from_img(at), np.ones(len(at))]) * depth[:, None] @ camera.rotation
        + pose.centre
        for at in (pixels, pixels + 2 * tangents)
    )
    return EdgePoints(np.full(len(points), frame), points, along)


def _depths(pixels: Array, depths: Array, shape: tuple[int, int]) -> tuple[Array, NDArray[np.bool_]]:
    """Mean depth about each pixel [H, W] of edge points at pixels [N, 2], and whether all are of one surface."""
    height, width = shape
    inside = (depths > 0) & (pixels > 0).all(1) & (pixels < [width, height]).all(1)
    x, y = np.floor(pixels[inside]).astype(np.int64).T
    sums = np.zeros((height, width, 3))
    np.add.at(sums, (y, x), depths[inside][:, None] ** [0, 1, 2])
    count, first, second = np.moveaxis(cv2.boxFilter(sums, -1, (_WINDOW, _WINDOW), normalize=False), 2, 0)
    count = np.maximum(count, 1e-9)
    mean = first / count
    deviation = np.sqrt(np.maximum(second / count - mean**2, 0))
    return mean, (count > _FEWEST - 0.5) & (deviation < _ONE_SURFACE * mean)
