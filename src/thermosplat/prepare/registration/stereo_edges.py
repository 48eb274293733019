"""Edges of the photographs as points in space: contours that a thermal camera is likely to see, too.

Each photograph is compared with a neighbour of its own camera path: both are rectified to rows along their baseline,
semi-global matching (OpenCV) gives depths, and Canny's edges are taken to space with the depth of the nearest surface
around them. A silhouette belongs to the object in front.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2  # before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.spectrum_files import as_rgb
from thermosplat.prepare.progress import progress_bar

Array = NDArray[np.float64]

BEST_ANGLE = 8.0
"""Angle [°] between the rays of two photographs: less is imprecise, more differs too much for block matching."""
_FEWEST_SHARED_POINTS = 30
_BLOCK, _PENALTY = 5, 8
"""Block size [px] of semi-global matching, and its smoothness penalty per block pixel (OpenCV's documentation)."""
_OUTLINE, _STEP_OF_OUTLINE, _LEAST_STEP = 9, 0.08, 1.5
"""An outline is where disparities differ by this share within so many pixels, and by so many at least. Warm or
cold, things differ from what is behind them more often than print differs from print."""
_LOW, _HIGH = 3.0, 6.0
"""Thresholds of Canny's detector [grey levels per pixel]."""
_COARSE = 4.0
"""Standard deviation [px] of the blur that takes grain away and leaves contours of what is large enough to have a
temperature of its own. Open choice."""
_SIDES_LIMIT = 2000
"""Largest extent [px] of a rectified photograph from its centre, for baselines that nearly point along the view."""


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Points on edges of photographs.

    Args:
        frame: [N] which photograph, in the order in which they were given.
        points: [N, 3] in the axes of its camera [world units].
        along: [N, 3] a point two pixels further along the edge.
        depth: Median depth of the points [world units].
    """

    frame: NDArray[np.int64]
    points: Array
    along: Array

    @classmethod
    def joined(cls, parts: Iterable["EdgePoints"]) -> "EdgePoints":
        """Those of all parts, one part after another; none of no part."""
        lists = [(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))]
        lists += [(part.frame, part.points, part.along) for part in parts]
        frame, points, along = (np.concatenate(values) for values in zip(*lists))
        return cls(frame, points, along)


def photograph_edges(
    model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image], folder: Path, width: int, most: int
) -> EdgePoints:
    """Edges of photographs in space.

    Args:
        width: The photographs are used at about this width [px].

    Returns:
        The points. Photographs without a neighbour have none.
    """
    seen = {image.image_id: _points_of(image) for image in images}
    found: list[EdgePoints] = []
    with progress_bar("edges", len(images)) as advance:
        for number, image in enumerate(images):
            partner = _partner(model, image, images, seen)
            if partner is not None:
                points, along, outline, strength = _edges(model, image, partner, folder, width)
                chosen = chosen_edges(outline, strength, most)
                found.append(EdgePoints(np.full(len(chosen), number), points[chosen], along[chosen]))
            advance(1)
    return EdgePoints.joined(found)


def chosen_edges(outline: NDArray[np.bool_], strength: NDArray[np.float32], most: int) -> NDArray[np.int64]:
    """At most so many points by a fixed seed: half of them on outlines, if there are so many, others by strength."""
    generator = np.random.default_rng(0)
    on, off = generator.permutation(np.flatnonzero(outline)), np.flatnonzero(~outline)
    first = on[: max(most // 2, most - len(off))]
    room = most - len(first)
    if room < len(off):
        likely = strength[off] + 1e-6
        off = generator.choice(off, room, replace=False, p=likely / likely.sum())
    return np.concatenate([first, off])


def _points_of(image: pycolmap.Image) -> set[int]:
    return {point.point3D_id for point in image.points2D if point.has_point3D()}


def _partner(
    model: pycolmap.Reconstruction,
    image: pycolmap.Image,
    others: Sequence[pycolmap.Image],
    seen: Mapping[int, set[int]],
) -> pycolmap.Image | None:
    """The photograph that shares many points with this one, seen at a good angle."""
    best, best_score = None, 0.0
    centre = image.projection_center()
    for other in others:
        shared = sorted(seen[image.image_id] & seen[other.image_id])
        if other.image_id == image.image_id or len(shared) < _FEWEST_SHARED_POINTS:
            continue
        points = np.array([model.points3D[point].xyz for point in shared[:200]])
        rays = [points - centre, points - other.projection_center()]
        cosine = (rays[0] * rays[1]).sum(1) / np.prod([np.linalg.norm(ray, axis=1) for ray in rays], axis=0)
        angle = np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))
        score = len(shared) * np.exp(-(2 * np.log(max(angle, 1e-3) / BEST_ANGLE) ** 2))
        if score > best_score:
            best, best_score = other, float(score)
    return best


@dataclass(frozen=True, eq=False)
class _Box:
    """The part of a rectified image plane that is looked at: its corner [px from the axis] and size [px]."""

    left: int
    top: int
    width: int
    height: int


def _edges(
    model: pycolmap.Reconstruction, image: pycolmap.Image, partner: pycolmap.Image, folder: Path, width: int
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.float32]]:
    """Edge points of one photograph, points along their edges, in its camera's axes.

    Which of them are on outlines, and how steep the blurred photograph is there [grey levels per pixel].
    """
    camera = model.cameras[image.camera_id]
    f = camera.mean_focal_length() * min(1.0, width / camera.width)
    left_axes, right_axes, baseline = _rectifying(image, partner)
    depths = np.array([model.points3D[p].xyz for p in _points_of(image)]) @ image.cam_from_world().matrix()[2, :3]
    depths += image.cam_from_world().translation[2]
    near, far = np.percentile(depths[depths > 0], [2, 98])
    largest = int(np.ceil(f * baseline / (0.8 * near)))
    least = max(0, int(f * baseline / (2 * far)))
    span = max(16, -(-(largest - least) // 16) * 16)
    box = _box(camera, left_axes, f, least + span)
    left = _rectified(folder / image.name, camera, left_axes, box, f)
    right = _rectified(folder / partner.name, model.cameras[partner.camera_id], right_axes, box, f)
    matcher = cv2.StereoSGBM.create(
        minDisparity=least,
        numDisparities=span,
        blockSize=_BLOCK,
        P1=_PENALTY * _BLOCK**2,
        P2=4 * _PENALTY * _BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=80,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    disparity[disparity <= max(least, 0.5)] = 0
    in_front = cv2.dilate(disparity, np.ones((_BLOCK, _BLOCK), np.uint8))
    behind = cv2.erode(np.where(disparity > 0, disparity, np.float32(1e6)), np.ones((_OUTLINE, _OUTLINE), np.uint8))
    pixels, normals = _canny(left, in_front > 0)
    at = np.floor(pixels).astype(int)
    kept = in_front[at[:, 1], at[:, 0]] > 0
    pixels, normals, at = pixels[kept], normals[kept], at[kept]
    nearest, farthest = (disparities[at[:, 1], at[:, 0]] for disparities in (in_front, behind))
    outline = nearest - farthest > _step(nearest)
    depth = f * baseline / front_disparity(disparity, at)
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    corner = np.array([box.left, box.top])
    points, along = (
        np.column_stack([(p + corner) / f, np.ones(len(p))]) * depth[:, None] @ left_axes
        for p in (pixels, pixels + 2 * tangents)
    )
    return points, along, outline, contour_strength(left)[at[:, 1], at[:, 0]]


def contour_strength(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """How steep a blurred photograph [H, W, 3] is in its steepest channel [grey levels per pixel], [H, W].

    Contours of a road or a roof keep their slope where grain of asphalt, which has far more edges, loses its own.
    """
    return np.asarray(np.hypot(*_slopes(image, _COARSE)).max(2), np.float32)


def _slopes(image: NDArray[np.uint8], blur: float) -> list[NDArray[np.float32]]:
    """Slopes [grey levels per pixel] along rows and columns of each channel, [H, W, 3]."""
    smooth = cv2.GaussianBlur(image, (0, 0), blur).astype(np.float32)
    return [np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) / 8) for order in ((1, 0), (0, 1))]


def _step(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """By how much disparities [px] differ at least at an outline."""
    return np.maximum(_STEP_OF_OUTLINE * disparity, np.float32(_LEAST_STEP))


def front_disparity(disparity: NDArray[np.float32], at: NDArray[np.int64]) -> NDArray[np.float32]:
    """Disparity [px] of the nearest surface around each of some pixels, [N].

    It is the mean over what is about as near as the nearest. The largest disparity of a block is that of its noise: by
    it points lay 0.7% too near, and all thermal cameras that see them from beside were drawn aside.

    Args:
        disparity: Of each pixel [px], 0 where it is unknown, [H, W].
        at: Columns and rows, [N, 2].
    """
    half = _BLOCK // 2
    padded = cv2.copyMakeBorder(disparity, half, half, half, half, cv2.BORDER_CONSTANT)
    blocks = np.lib.stride_tricks.sliding_window_view(padded, (_BLOCK, _BLOCK))
    around = blocks[at[:, 1], at[:, 0]].reshape(len(at), -1)
    nearest = around.max(1, keepdims=True, initial=0.0)
    front = around >= nearest - _step(nearest) / 2
    return np.asarray((around * front).sum(1) / front.sum(1), np.float32)


def _rectifying(image: pycolmap.Image, partner: pycolmap.Image) -> tuple[Array, Array, float]:
    """Axes of the rectified cameras as rows, in each photograph's own axes, and the length of the baseline."""
    relative = partner.cam_from_world() * image.cam_from_world().inverse()
    rotation = relative.rotation.matrix()
    towards = -rotation.T @ relative.translation
    baseline = float(np.linalg.norm(towards))
    x = towards / baseline
    z = np.array([0.0, 0.0, 1.0]) + rotation[2]
    z -= x * (z @ x)
    z /= np.linalg.norm(z)
    axes = np.stack([x, np.cross(z, x), z])
    return axes, axes @ rotation.T, baseline


def _box(camera: pycolmap.Camera, axes: Array, f: float, disparities: int) -> _Box:
    """What the photograph covers of the rectified plane, and room on the left for the largest disparity."""
    grid = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    rays = np.column_stack([camera.cam_from_img(np.stack(grid, -1).reshape(-1, 2)), np.ones(81)]) @ axes.T
    rays = rays[rays[:, 2] > 0.2]
    plane = np.clip(f * rays[:, :2] / rays[:, 2:], -_SIDES_LIMIT, _SIDES_LIMIT)
    low, high = np.floor(plane.min(0)).astype(int), np.ceil(plane.max(0)).astype(int)
    return _Box(int(low[0]) - disparities, int(low[1]), int(high[0] - low[0]) + disparities, int(high[1] - low[1]))


def _rectified(path: Path, camera: pycolmap.Camera, axes: Array, box: _Box, f: float) -> NDArray[np.uint8]:
    """[H, W, 3] the photograph on the rectified plane, black where it does not reach."""
    photograph = as_rgb(path, read_image(path))
    x, y = np.meshgrid(np.arange(box.width) + box.left + 0.5, np.arange(box.height) + box.top + 0.5)
    rays = np.stack([x / f, y / f, np.ones_like(x)], -1).reshape(-1, 3) @ axes
    position = camera.img_from_cam(rays) - 0.5
    position[rays[:, 2] < 0.1] = -1e4
    shrink = f / camera.mean_focal_length()
    if shrink < 0.75:
        photograph = cv2.GaussianBlur(photograph, (0, 0), 0.4 / shrink)
    maps = position.reshape(box.height, box.width, 2).astype(np.float32)
    return cv2.remap(photograph, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _canny(image: NDArray[np.uint8], usable: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Edge positions [N, 2] to a fraction of a pixel (centres at halves), and unit normals [N, 2]."""
    slopes = _slopes(image, 1.0)
    channel = (slopes[0] ** 2 + slopes[1] ** 2).argmax(2)[..., None]
    gx, gy = (np.take_along_axis(slope, channel, 2)[..., 0] for slope in slopes)
    scaled = [np.clip(g * 64, -32000, 32000).astype(np.int16) for g in (gx, gy)]
    edges = cv2.Canny(scaled[0], scaled[1], 64 * _LOW, 64 * _HIGH, L2gradient=True) > 0
    covered = cv2.erode((image.max(2) > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    y, x = np.nonzero(edges & usable & covered)
    magnitude = np.hypot(gx, gy)
    normals = np.column_stack([gx[y, x], gy[y, x]]).astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    centres = np.column_stack([x, y]).astype(np.float64)
    before, here, after = (sampled(magnitude, centres + shift * normals) for shift in (-1, 0, 1))
    offset = np.clip(0.5 * (before - after) / np.minimum(before - 2 * here + after, -1e-6), -0.7, 0.7)
    return centres + 0.5 + offset[:, None] * normals, normals


def sampled(image: NDArray[np.float32], positions: Array) -> NDArray[np.float32]:
    """Bilinear samples of an image [H, W] or [H, W, C] at positions [N, 2] counted from the first pixel's centre."""
    if not len(positions):
        return np.zeros((0, *image.shape[2:]), np.float32)
    maps = positions[None].astype(np.float32)
    rows = 30000  # cv2.remap takes at most 32767 columns
    parts = [
        cv2.remap(image, maps[:, k : k + rows], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[0]
        for k in range(0, maps.shape[1], rows)
    ]
    return np.concatenate(parts)
