"""The like of each part of a scene: the same surface and the same colour, within its surroundings.

Heat behind a surface is warmer than the same surface beside it. A road beside a lawn, or a roof above them, is another
material and has another temperature. So the views of a capture are joined into small elements of its surfaces, and an
element is compared with those around it that lie on its plane, face as it does, and have its colour in the photograph:
with the half of them whose colours are nearest.
"""

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.thermography.hot_regions import cells_of
from thermosplat.thermography.reprojection import resized
from thermosplat.viewer.measuring import Measurer, SearchedView, grid_cell

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
_SURROUNDINGS = 1 / 4
"""Radius of an element's surroundings, as a share of the picture's shorter side: a finding fills less than half."""
_SAMPLES = 6
"""Samples along this radius."""
_FEWEST_LIKE = 12
"""Of the about 100 samples of a plane: with fewer nobody knows what is usual there."""
_FEWEST_VIEWS = 3
"""Of an element: views that agree."""
_OFF_PLANE, _COSINE, _CONTRAST = 0.1, 0.9, 0.06
"""Share of the radius, cosine of the angle between normals, and difference of colours in [0, 1] of what is alike."""
_NEAREST_COLORS = 0.5
"""Share of what is alike that counts, the nearest in colour: a dark roof is almost as blue as modules on it. Chosen on
three flights, as the next one is."""
_TONE = 0.7
"""Weight of the shares of red, green and blue where colours are compared; the rest is that of their values, which shade
changes, too."""
_BLACK = 0.01
"""Added to the sum of a colour that is divided by it."""
_AROUND = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
_VOTES = 0.5
"""Share of the pixels that see an element, which must agree."""


@torch.no_grad()
def photographs_of(measurer: Measurer, views: Sequence[SearchedView]) -> list[NDArray[np.float32]] | None:
    """Colours in [0, 1] of the scene's photographs in views of another spectrum, [H, W, 3]; None without any.

    Args:
        measurer: Of the scene.
        views: Where to look from.
    """
    scene = measurer.scene
    name = next((name for name, scale in scene.scales.items() if scale.kind == "photograph"), None)
    if name is None:
        return None
    colors = []
    for view in (one.view for one in views):
        half = resized(view, -(-view.width // 2), -(-view.height // 2))  # elements have two pixels
        image = scene.model.render({name: half}, sh_degree=scene.sh_degree).images[name].clamp(0, 1)
        colors.append(cv2.resize(image.cpu().numpy(), (view.width, view.height)))
    return colors


class Elements:
    """Small parts of a scene's surfaces, and what all views together say of them.

    Args:
        views: Of the capture, at least one.
        photographs: Colours in [0, 1] that are seen in them, [H, W, 3]; None: nobody knows.
    """

    def __init__(self, views: Sequence[SearchedView], photographs: Sequence[NDArray[np.float32]] | None) -> None:
        self._cell = grid_cell(views)
        shorter = min(views[0].values.shape)
        self._radius = _SURROUNDINGS * shorter * self._cell / 2
        self._there = [view.there for view in views]
        points = np.concatenate([view.points[there] for view, there in zip(views, self._there)])
        values = np.concatenate([view.values[there] for view, there in zip(views, self._there)])
        self._of_pixel: Indices = np.unique(_keys(points, self._cell), return_inverse=True)[1]
        self._pixels = np.bincount(self._of_pixel)
        self._ends = np.cumsum([there.sum() for there in self._there])[:-1]
        self._values = self._mean(values)
        self._places = np.stack([self._mean(axis) for axis in points.T], axis=-1)
        self._colors = np.zeros((len(self._pixels), 3), np.float32)
        if photographs is not None:
            colors = np.concatenate([one[there] for one, there in zip(photographs, self._there)])
            self._colors = np.stack([self._mean(channel) for channel in colors.T], axis=-1).astype(np.float32)
        seen = np.zeros(len(self._pixels), np.int64)
        for part in np.split(self._of_pixel, self._ends):
            seen[np.unique(part)] += 1
        self._sound: Indices = np.flatnonzero(seen >= _FEWEST_VIEWS)

    def references(self) -> list[Array]:
        """The median of each pixel's like, [H, W] for each view; NaN where too little is like it."""
        of_each = np.full(len(self._pixels), np.nan)
        if len(self._sound):
            of_each[self._sound] = self._medians()
        return [self._spread(part, of_each, np.nan) for part in self._parts()]

    def agreed(self, masks: Sequence[NDArray[np.bool_]]) -> list[NDArray[np.bool_]]:
        """Masks [H, W] of the views without the elements of which most pixels are in no mask."""
        chosen = np.concatenate([mask[there] for mask, there in zip(masks, self._there)])
        votes = np.bincount(self._of_pixel, chosen, len(self._pixels)) >= _VOTES * self._pixels
        return [mask & self._spread(part, votes, False) for mask, part in zip(masks, self._parts())]

    def _mean(self, of_pixels: Array) -> Array:
        return np.bincount(self._of_pixel, of_pixels) / self._pixels

    def _parts(self) -> list[tuple[NDArray[np.bool_], Indices]]:
        return list(zip(self._there, np.split(self._of_pixel, self._ends)))

    @staticmethod
    def _spread(part: tuple[NDArray[np.bool_], Indices], of_each: NDArray, nothing: float) -> NDArray:
        there, elements = part
        image = np.full(there.shape, nothing, of_each.dtype)
        image[there] = of_each[elements]
        return image

    def _medians(self) -> Array:
        """Of each sound element the median of its like, [S]."""
        places, values = self._places[self._sound], self._values[self._sound]
        middle = places.mean(axis=0)
        x, t = (places - middle).astype(np.float32), values.astype(np.float32)
        colors, normals = self._colors[self._sound], _normals(places - middle, max(self._radius / 16, 2 * self._cell))
        shares = colors / (colors.sum(axis=1, keepdims=True) + _BLACK)
        looks = np.concatenate([colors, shares], axis=1)
        order = np.random.default_rng(0).permutation(len(x))
        samples = order[np.unique(_keys(places[order], self._radius / _SAMPLES), return_index=True)[1]]
        blocks = np.floor((x - x.min(axis=0)) / (self._radius / 2)).astype(np.int64)
        of_block = _grouped(_flat(blocks))
        lowest, at = x.min(axis=0), x[samples]
        medians = np.full(len(x), np.nan)

        def fill(mine: Indices) -> None:
            low = lowest + blocks[mine[0]] * self._radius / 2
            near = samples[((at > low - self._radius) & (at < low + 1.5 * self._radius)).all(axis=1)]
            medians[mine] = self._of_block(mine, near, x, t, looks, normals)

        with ThreadPoolExecutor(torch.get_num_threads()) as threads:  # NumPy leaves the interpreter to others meanwhile
            list(threads.map(fill, of_block))
        return medians

    def _of_block(
        self, mine: Indices, near: Indices, x: NDArray, t: NDArray, looks: NDArray, normals: NDArray
    ) -> Array:
        """Medians of neighbouring elements, whose samples are the same."""
        apart = np.abs(normals[mine] @ x[near].T - (normals[mine] * x[mine]).sum(axis=1)[:, None])
        like = (apart < _OFF_PLANE * self._radius) & (np.abs(normals[mine] @ normals[near].T) > _COSINE)
        squares = (x[mine] ** 2).sum(axis=1)[:, None] + (x[near] ** 2).sum(axis=1) - 2 * x[mine] @ x[near].T
        rows, columns = np.nonzero(like & (squares < self._radius**2))
        one, other = looks[mine].T, looks[near].T
        parts = [np.abs(one[k][rows] - other[k][columns]) for k in range(6)]
        contrast, tones = sum(parts[:3]), sum(parts[3:])
        alike = np.flatnonzero(contrast < 3 * _CONTRAST)
        contrast = (_TONE * tones + (1 - _TONE) * contrast)[alike]
        rows, columns = rows[alike], columns[alike]
        count = np.bincount(rows, minlength=len(mine))
        known = np.flatnonzero(count >= _FEWEST_LIKE)
        medians = np.full(len(mine), np.nan)
        if len(known) == 0:
            return medians
        place = np.arange(len(rows)) - (np.cumsum(count) - count)[rows]  # in a row for each element, inf at its end
        contrasts, values = np.full((2, len(mine), count.max()), np.inf, np.float32)
        contrasts[rows, place], values[rows, place] = contrast, t[near][columns]
        contrasts, values, count = contrasts[known], values[known], count[known]
        kept = np.maximum((_NEAREST_COLORS * count).astype(np.intp), _FEWEST_LIKE)
        every = np.arange(len(known))
        farthest = np.sort(contrasts, axis=1)[every, kept - 1]
        nearest = contrasts <= farthest[:, None]
        of_like = np.sort(np.where(nearest, values, np.inf), axis=1)
        medians[known] = of_like[every, (nearest.sum(axis=1) - 1) // 2]
        return medians


def _keys(points: Array, cell: float) -> NDArray[np.int64]:
    """A number for each point's cell."""
    return _flat(cells_of(points, cell)) if len(points) else np.zeros(0, np.int64)


def _flat(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    return (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]


def _grouped(keys: NDArray[np.int64]) -> list[Indices]:
    """Indices of equal keys."""
    order = np.argsort(keys, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)


def _normals(places: Array, side: float) -> NDArray[np.float32]:
    """Unit normals of the planes through what is around each place, [N, 3]: of 27 cubes of a side."""
    cubes = np.floor((places - places.min(axis=0)) / side).astype(np.int64) + 1
    keys, of_each = np.unique(_flat(cubes), return_inverse=True)
    moments = np.stack([np.ones(len(places)), *places.T, *(a * b for a in places.T for b in places.T)])
    sums = np.stack([np.bincount(of_each, moment) for moment in moments], axis=-1)
    total = np.zeros_like(sums)
    for step in _flat(_AROUND):
        at = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        total += np.where((keys[at] == keys + step)[:, None], sums[at], 0)
    mean = total[:, 1:4] / total[:, :1]
    covariance = total[:, 4:].reshape(-1, 3, 3) / total[:, :1, None] - mean[:, :, None] * mean[:, None]
    normals: NDArray[np.float32] = np.linalg.eigh(covariance)[1][:, :, 0].astype(np.float32)
    return normals[of_each]
