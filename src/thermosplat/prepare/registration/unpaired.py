"""Places of thermal images that have no photograph of their moment, by the edges of photographs in space.

Each thermal image is tried where photographs near it were taken, with their directions, at the place that GPS states if
there is one. A correlation of edges finds the shift (``edge_correlation``), and an alignment of the image alone the
pose (``edge_alignment``). All images share one lens: its focal length is the one by which a few images correlate best,
and all that are placed refine it together. What GPS says of all images is wrong by a common error of metres: once some
are placed, others begin where GPS has them less that error.

An image counts as placed if clearly more edges meet than by chance, as in most others, and if it lies where GPS has it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.edge_alignment import Meeting, Stage, align
from thermosplat.prepare.registration.edge_correlation import FOCAL_LENGTHS, QUARTERS, best_shift, edge_field
from thermosplat.prepare.registration.rig_camera import UNKNOWNS, Array, RigCamera
from thermosplat.prepare.registration.stereo_edges import EdgePoints

_POSE, _LENS = UNKNOWNS[:6], UNKNOWNS[6:]
_COARSE: Sequence[Stage] = (
    (UNKNOWNS[:3], ((10, 4.0),) * 4),
    (_POSE, ((10, 4.0),) * 5 + ((6, 2.0),) * 4 + ((3, 0.8),) * 4),
)
_FINE: Sequence[Stage] = ((_POSE, ((4, 1.5),) * 4 + ((3, 0.8),) * 4),)
_OF_LENS: Sequence[Stage] = ((_LENS, ((4, 1.5),) * 3 + ((3, 0.8),) * 3),)
_ROUNDS = 3
_NEAR_BY_GPS = 8
"""Photographs whose directions are tried where GPS has an image: those of strips to and fro, and oblique ones."""
_EDGES_OF = 4
"""Photographs whose edges an image is aligned with."""
_ASKED = 5
"""Images that tell the focal length, each by its best trial."""
_TRIED = 3
"""Best trials of an image that are aligned."""
_ABOVE_CHANCE = 1.35
"""How many times as many edges must meet as by chance; where thermal and visible edges agree it is twice to three
times."""
_OF_USUAL = 0.5
"""Of what is above chance in the images' median, below which an image is left out."""
_OFF_GPS = 5.0
"""Robust standard deviations from GPS, less its common error, beyond which an image is left out."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs in the world, and their edges.

    Args:
        rotations: World to camera, [N, 3, 3].
        centres: Places, [N, 3].
        edges: Edges in each one's axes.
    """

    rotations: Array
    centres: Array
    edges: EdgePoints

    def seen_from(self, numbers: Sequence[int], rotation: Array, centre: Array) -> EdgePoints:
        """The edges of some photographs in the axes of a camera elsewhere.

        Args:
            numbers: Which photographs.
            rotation: World to that camera, [3, 3].
            centre: Its place, [3].
        """
        points, along = [], []
        for number in numbers:
            mine = self.edges.frame == number
            turn = rotation @ self.rotations[number].T
            shift = rotation @ (self.centres[number] - centre)
            points.append(self.edges.points[mine] @ turn.T + shift)
            along.append(self.edges.along[mine] @ turn.T + shift)
        both = np.concatenate(points), np.concatenate(along)
        return EdgePoints(np.zeros(len(both[0]), np.int64), *both)


@dataclass(frozen=True, eq=False)
class Place:
    """Where a thermal image was taken.

    Args:
        rotation: World to camera, [3, 3].
        centre: In the world, [3].
        met: How its edges meet those of photographs.
    """

    rotation: Array
    centre: Array
    met: Meeting

    @property
    def above_chance(self) -> float:
        """How many times as many edges meet as by chance."""
        return self.met.near / max(self.met.by_chance, 1.0)


@dataclass(frozen=True, eq=False)
class Placement:
    """Thermal images in the world.

    Args:
        lens: Their lens, at the pose of no rig.
        places: By number of the image; those that could not be placed are missing.
    """

    lens: RigCamera
    places: Mapping[int, Place]


def placed_images(
    photographs: Photographs, slopes: Sequence[NDArray[np.float32]], gps: Sequence[Array | None]
) -> Placement:
    """Place thermal images.

    Args:
        photographs: The photographs.
        slopes: Slopes [H, W, 2] of each thermal image.
        gps: Where GPS has each, in the world, [3]; None: it does not say.
    """
    height, width = slopes[0].shape[:2]
    fields = [edge_field(field) for field in slopes]
    focal_length = _focal_length(photographs, fields, gps, width, height)
    lens = RigCamera.looking_along(width, height, focal_length)
    places: dict[int, Place] = {}
    offset = np.zeros(3)
    with progress_bar("places", 2 * len(slopes)) as advance:
        for first in (True, False):
            for number, field in enumerate(slopes):
                if first or number not in places:
                    start = None if gps[number] is None else gps[number] - offset
                    found = _placed(photographs, field, fields[number], start, lens)
                    if found is not None and found.above_chance >= _ABOVE_CHANCE:
                        places[number] = found
                advance(1)
            known = [places[number].centre for number in places if gps[number] is not None]
            if known:
                stated = [gps[number] for number in places if gps[number] is not None]
                offset = np.median(np.array(stated) - np.array(known), axis=0)
    for _ in range(_ROUNDS):
        good = _sound(places, gps)
        if not good:
            break
        lens = _refined_lens(photographs, slopes, good, lens)
        for number, place in places.items():
            places[number] = _aligned(photographs, slopes[number], place.rotation, place.centre, lens, _FINE) or place
    return Placement(lens, _sound(places, gps))


def _candidates(photographs: Photographs, start: Array | None) -> list[tuple[int, Array]]:
    """Photographs whose direction is tried, and where."""
    if start is None:
        return list(enumerate(photographs.centres))
    apart = np.linalg.norm(photographs.centres - start, axis=1)
    return [(int(number), start) for number in np.argsort(apart)[:_NEAR_BY_GPS]]


def _trials(
    photographs: Photographs, field: NDArray[np.complex64], start: Array | None, width: int, height: int, f: float
) -> list[tuple[float, Array, Array]]:
    """Score, rotation and place of all trials, the best first."""
    found = []
    for number, centre in _candidates(photographs, start):
        edges = photographs.seen_from([number], photographs.rotations[number], centre)
        for angle in QUARTERS:
            score, camera = best_shift(edges, {0: field}, width, height, f, angle)
            found.append((score, camera.rotation @ photographs.rotations[number], centre))
    return sorted(found, key=lambda trial: -trial[0])


def _focal_length(
    photographs: Photographs,
    fields: Sequence[NDArray[np.complex64]],
    gps: Sequence[Array | None],
    width: int,
    height: int,
) -> float:
    """The focal length [px] by which some images correlate best."""
    asked = np.unique(np.linspace(0, len(fields) - 1, min(_ASKED, len(fields))).round().astype(int))
    lengths = [width * factor for factor in FOCAL_LENGTHS[::2]]
    scores = np.zeros(len(lengths))
    with progress_bar("focal length", len(lengths)) as advance:
        for number, f in enumerate(lengths):
            scores[number] = sum(_trials(photographs, fields[i], gps[i], width, height, f)[0][0] for i in asked)
            advance(1)
    return lengths[int(scores.argmax())]


def _placed(
    photographs: Photographs,
    slopes: NDArray[np.float32],
    field: NDArray[np.complex64],
    start: Array | None,
    lens: RigCamera,
) -> Place | None:
    """The best of an image's best trials."""
    trials = _trials(photographs, field, start, lens.width, lens.height, lens.lens[0])[:_TRIED]
    found = [_aligned(photographs, slopes, rotation, centre, lens, _COARSE) for _, rotation, centre in trials]
    return max((one for one in found if one is not None), key=lambda one: one.above_chance, default=None)


def _aligned(
    photographs: Photographs,
    slopes: NDArray[np.float32],
    rotation: Array,
    centre: Array,
    lens: RigCamera,
    stages: Sequence[Stage],
) -> Place | None:
    """An image's pose with all edges that photographs near it have, from one that is about right."""
    edges = photographs.seen_from(_seeing(photographs, rotation, centre), rotation, centre)
    camera = replace(lens, rotation=np.eye(3), translation=np.zeros(3))
    found = align(camera, edges, [slopes], stages=stages)
    if 0 not in found.frames:
        return None
    turned = found.camera.rotation @ rotation
    return Place(turned, centre - turned.T @ found.camera.translation, found.frames[0])


def _seeing(photographs: Photographs, rotation: Array, centre: Array) -> list[int]:
    """Photographs that look about where a camera looks, from near it."""
    along = photographs.rotations[:, 2] @ rotation[2]
    apart = np.linalg.norm(photographs.centres - centre, axis=1)
    usual = np.median(np.sort(apart)[: 2 * _EDGES_OF]) + 1e-9
    return [int(number) for number in np.argsort(apart / usual + 4 * np.arccos(np.clip(along, -1, 1)))[:_EDGES_OF]]


def _refined_lens(
    photographs: Photographs,
    slopes: Sequence[NDArray[np.float32]],
    places: Mapping[int, Place],
    lens: RigCamera,
) -> RigCamera:
    """The lens by which edges of all placed images meet best."""
    parts = [
        photographs.seen_from(_seeing(photographs, place.rotation, place.centre), place.rotation, place.centre)
        for place in places.values()
    ]
    frame = np.repeat(np.arange(len(parts)), [len(part.points) for part in parts])
    edges = EdgePoints(
        frame, np.concatenate([part.points for part in parts]), np.concatenate([part.along for part in parts])
    )
    camera = replace(lens, rotation=np.eye(3), translation=np.zeros(3))
    return align(camera, edges, [slopes[number] for number in places], stages=_OF_LENS).camera


def _sound(places: Mapping[int, Place], gps: Sequence[Array | None]) -> dict[int, Place]:
    """Images that meet edges as most do, and lie where GPS has them."""
    if not places:
        return {}
    usual = float(np.median([place.above_chance for place in places.values()]))
    least = max(_ABOVE_CHANCE, 1 + _OF_USUAL * (usual - 1))
    good = {number: place for number, place in places.items() if place.above_chance >= least}
    off = {number: gps[number] - place.centre for number, place in good.items() if gps[number] is not None}
    if len(off) < 4:
        return good
    apart = np.array(list(off.values())) - np.median(list(off.values()), axis=0)
    distance = np.linalg.norm(apart, axis=1)
    far = distance > _OFF_GPS * max(float(np.median(distance)), 1e-9) / 1.538
    wrong = {number for number, is_far in zip(off, far) if is_far}
    return {number: place for number, place in good.items() if number not in wrong}
