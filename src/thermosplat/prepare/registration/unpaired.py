"""Places of thermal images that have no photograph of their moment, by the edges of photographs in space.

Images that a straight piece of a flight took look about one way. They are tried together with the directions of
photographs near them, each at the place that GPS states. An image of which GPS says nothing is tried alone, wherever a
photograph was taken. A correlation of edges finds the shift (``edge_correlation``), and an alignment of each image its
pose (``edge_alignment``). What GPS says of all images is wrong by a common error of metres: once some are placed, the
others begin where GPS has them less that error. At last all poses and the one lens are adjusted together.

An image counts as placed if clearly more edges meet than by chance, as in most others, and if it lies where GPS has it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.edge_alignment import Meeting, Stage, align, matched_rows, meetings
from thermosplat.prepare.registration.edge_correlation import FOCAL_LENGTHS, QUARTERS, best_shift, edge_field
from thermosplat.prepare.registration.rig_camera import UNKNOWNS, Array, RigCamera
from thermosplat.prepare.registration.stereo_edges import EdgePoints, joined

_POSE = UNKNOWNS[:6]
_DIRECTION = (*UNKNOWNS[:3], "log_f")
_WITH_LENS: Sequence[Stage] = (
    (_DIRECTION, ((10, 4.0),) * 5),
    ((*_DIRECTION, "k1"), ((10, 4.0),) * 4),
    ((*_POSE, "log_f", "k1"), ((10, 4.0),) * 6 + ((6, 3.0),) * 6),
)
"""Of the images of a piece at once: GPS misses each by some pixels of its own, which windows let pass."""
_TOGETHER_STAGES: Sequence[Stage] = ((UNKNOWNS[:3], ((10, 4.0),) * 3), (_POSE, ((10, 4.0),) * 5 + ((6, 3.0),) * 4))
_ALONE: Sequence[Stage] = ((_POSE, ((6, 2.5),) * 3 + ((4, 1.5),) * 4 + ((3, 0.8),) * 4),)
_ADJUSTED = ((6, 2.5),) * 3 + ((4, 1.5),) * 4 + ((3, 0.8),) * 5
"""Search range and robust scale of each step of the adjustment, as in ``edge_alignment.STAGES``."""
_NEAR_BY_GPS = 6
"""Photographs whose directions are tried where GPS has images: those of strips to and fro, and oblique ones."""
_STRAIGHT = 0.85
"""Cosine of the turn of a path up to which it is straight."""
_TOGETHER = 6
"""Images of a straight piece that are tried together."""
_EDGES_OF = 3
"""Photographs whose edges an image is aligned with."""
_ASKED = 4
"""Pieces that tell the focal length, each by its best trial."""
_FEWEST_AGREEING, _LENSES_AGREE = 3, 0.03
"""Pieces whose edges must meet to tell a lens, and the median difference of their focal lengths, as a share."""
_ROUNDS = 2
_TRIED = 2
"""Best trials of a piece whose images are aligned."""
_ABOVE_CHANCE = 1.35
"""How many times as many edges must meet as by chance; where thermal and visible edges agree it is twice to three
times."""
_FEWEST_MET = 150
"""Edge points that must meet an edge: fewer may all lie on one contour."""
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

    def seen_from(self, numbers: Sequence[int], rotation: Array, centre: Array, frame: int = 0) -> EdgePoints:
        """The edges of some photographs in the axes of a camera elsewhere.

        Args:
            numbers: Which photographs.
            rotation: World to that camera, [3, 3].
            centre: Its place, [3].
            frame: What the frame is called.
        """
        points, along = [], []
        for number in numbers:
            mine = self.edges.frame == number
            turn = rotation @ self.rotations[number].T
            shift = rotation @ (self.centres[number] - centre)
            points.append(self.edges.points[mine] @ turn.T + shift)
            along.append(self.edges.along[mine] @ turn.T + shift)
        both = np.concatenate(points), np.concatenate(along)
        return EdgePoints(np.full(len(both[0]), frame), *both)

    def near(self, rotation: Array, centre: Array, most: int = _EDGES_OF) -> list[int]:
        """The photographs that look about where a camera looks, from near it.

        Args:
            rotation: World to the camera, [3, 3].
            centre: Its place, [3].
            most: How many.
        """
        angle = np.arccos(np.clip(self.rotations[:, 2] @ rotation[2], -1, 1))
        apart = np.linalg.norm(self.centres - centre, axis=1)
        usual = np.median(np.sort(apart)[: 2 * _EDGES_OF]) + 1e-9
        return [int(number) for number in np.argsort(apart / usual + 4 * angle)[:most]]


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
    photographs: Photographs,
    slopes: Sequence[NDArray[np.float32]],
    gps: Sequence[Array | None],
    lens: RigCamera | None = None,
) -> Placement | None:
    """Place thermal images.

    Args:
        photographs: The photographs.
        slopes: Slopes [H, W, 2] of each thermal image, in the order in which they were taken.
        gps: Where GPS has each, in the world, [3]; None: it does not say.
        lens: Their lens, where a board showed it; None: the images tell it.

    Returns:
        None where the images do not tell their lens.
    """
    fields = [edge_field(field) for field in slopes]
    pieces = _pieces(gps)
    lens = lens or _first_lens(photographs, slopes, fields, gps, pieces)
    if lens is None:
        return None
    places: dict[int, Place] = {}
    with progress_bar("places", _ROUNDS * len(slopes)) as advance:
        for _ in range(_ROUNDS):
            errors = list(gps_errors(places, gps).values())
            offset = np.median(errors, axis=0) if errors else np.zeros(3)
            moved = [None if place is None else place - offset for place in gps]
            for piece in pieces:
                if any(number not in places for number in piece):
                    trials = _trials(photographs, {n: fields[n] for n in piece}, moved, lens)
                    found = max(
                        (_each(photographs, slopes, piece, moved, *trial, lens) for trial in trials[:_TRIED]),
                        key=lambda one: sum(place.above_chance for place in one.values()),
                    )
                    places |= {number: place for number, place in found.items() if number not in places}
                advance(len(piece))
            if places:
                lens, places = _adjusted(photographs, slopes, places, lens)
                places = _sound(places, gps)
    return Placement(lens, places)


def _pieces(gps: Sequence[Array | None]) -> list[list[int]]:
    """Images of straight pieces of the path; those without a position alone."""
    pieces: list[list[int]] = []
    towards: Array | None = None
    for number, place in enumerate(gps):
        before = gps[number - 1] if number else None
        step = None if place is None or before is None else (place - before)[:2]
        step = None if step is None or not np.linalg.norm(step) else step / np.linalg.norm(step)
        goes_on = step is not None and (towards is None or float(step @ towards) > _STRAIGHT)
        if pieces and goes_on and len(pieces[-1]) < _TOGETHER:
            pieces[-1].append(number)
            towards = step
        else:
            pieces.append([number])
            towards = None
    return pieces


def _trials(
    photographs: Photographs,
    fields: Mapping[int, NDArray[np.complex64]],
    gps: Sequence[Array | None],
    lens: RigCamera,
) -> list[tuple[float, Array, Array | None]]:
    """Score and rotation of all trials for a piece, the best first; and the place, where GPS does not say it."""
    places = [place for place in (gps[number] for number in fields) if place is not None]
    chosen = range(len(photographs.centres))
    if places:
        apart = np.linalg.norm(photographs.centres - np.mean(places, axis=0), axis=1)
        chosen = np.argsort(apart)[:_NEAR_BY_GPS].tolist()
    found = []
    for number in chosen:
        rotation, own = photographs.rotations[number], None if places else photographs.centres[number]
        edges = joined(
            photographs.seen_from(photographs.near(rotation, centre, 1), rotation, centre, image)
            for image in fields
            if (centre := own if own is not None else gps[image]) is not None
        )
        for angle in QUARTERS:
            score, camera = best_shift(edges, dict(fields), lens.width, lens.height, lens.lens[0], angle)
            found.append((score, camera.rotation @ rotation, own))
    return sorted(found, key=lambda trial: -trial[0])


def _focal_length(
    photographs: Photographs,
    fields: Sequence[NDArray[np.complex64]],
    gps: Sequence[Array | None],
    pieces: Sequence[Sequence[int]],
    width: int,
    height: int,
) -> float:
    """The focal length [px] by which some pieces correlate best."""
    largest = sorted(pieces, key=lambda piece: -len(piece))
    count = sum(len(piece) > 1 for piece in pieces) or len(pieces)
    asked = [largest[i] for i in np.unique(np.linspace(0, count - 1, min(_ASKED, count)).round().astype(int))]
    lengths = [width * factor for factor in FOCAL_LENGTHS[2::3]]
    scores = np.zeros(len(lengths))
    with progress_bar("focal length", len(lengths)) as advance:
        for number, f in enumerate(lengths):
            lens = RigCamera.looking_along(width, height, f)
            scores[number] = sum(
                _trials(photographs, {i: fields[i] for i in piece}, gps, lens)[0][0] for piece in asked
            )
            advance(1)
    return lengths[int(scores.argmax())]


def _each(
    photographs: Photographs,
    slopes: Sequence[NDArray[np.float32]],
    piece: Sequence[int],
    gps: Sequence[Array | None],
    score: float,
    rotation: Array,
    own: Array | None,
    lens: RigCamera,
) -> dict[int, Place]:
    """The images of a piece, aligned together and then each alone; those whose edges do not meet are missing."""
    together = align(lens, *_of_piece(photographs, slopes, piece, gps, rotation, own), stages=_TOGETHER_STAGES).camera
    found = {}
    for number in piece:
        turned = together.rotation @ rotation
        centre = _centre(gps, number, own) - turned.T @ together.translation
        edges = photographs.seen_from(photographs.near(turned, centre), turned, centre)
        camera = replace(lens, rotation=np.eye(3), translation=np.zeros(3))
        aligned = align(camera, edges, [slopes[number]], stages=_ALONE)
        met = aligned.frames.get(0)
        if met is not None and met.near >= _FEWEST_MET and met.near >= _ABOVE_CHANCE * met.by_chance:
            again = aligned.camera.rotation @ turned
            found[number] = Place(again, centre - again.T @ aligned.camera.translation, met)
    return found


def _of_piece(
    photographs: Photographs,
    slopes: Sequence[NDArray[np.float32]],
    piece: Sequence[int],
    gps: Sequence[Array | None],
    rotation: Array,
    own: Array | None,
) -> tuple[EdgePoints, list[NDArray[np.float32]]]:
    """Edges that the images of a piece see if they look one way from where GPS has them, and their slopes."""
    parts = []
    for frame, number in enumerate(piece):
        centre = _centre(gps, number, own)
        parts.append(photographs.seen_from(photographs.near(rotation, centre), rotation, centre, frame))
    return joined(parts), [slopes[number] for number in piece]


def _centre(gps: Sequence[Array | None], number: int, own: Array | None) -> Array:
    """Where an image is tried: where GPS has it, or at a photograph's place."""
    stated = gps[number]
    return stated if own is None and stated is not None else np.asarray(own)


def _first_lens(
    photographs: Photographs,
    slopes: Sequence[NDArray[np.float32]],
    fields: Sequence[NDArray[np.complex64]],
    gps: Sequence[Array | None],
    pieces: Sequence[Sequence[int]],
) -> RigCamera | None:
    """The lens that several pieces tell when each is aligned with the lens free; None where they do not agree.

    Flat ground looks the same through a longer lens from farther away.
    """
    height, width = slopes[0].shape[:2]
    start = RigCamera.looking_along(width, height, _focal_length(photographs, fields, gps, pieces, width, height))
    lenses = []
    for piece in sorted(pieces, key=lambda one: -len(one))[:_ASKED]:
        _, rotation, own = _trials(photographs, {i: fields[i] for i in piece}, gps, start)[0]
        found = align(start, *_of_piece(photographs, slopes, piece, gps, rotation, own), stages=_WITH_LENS)
        if found.near >= _ABOVE_CHANCE * found.by_chance:
            lenses.append(found.camera.lens)
    if len(lenses) < _FEWEST_AGREEING:
        return None
    middle = np.median(lenses, axis=0)
    apart = np.abs(np.log(np.array(lenses)[:, 0] / middle[0]))
    return replace(start, lens=middle) if float(np.median(apart)) < _LENSES_AGREE else None


def _adjusted(
    photographs: Photographs,
    slopes: Sequence[NDArray[np.float32]],
    places: Mapping[int, Place],
    lens: RigCamera,
) -> tuple[RigCamera, dict[int, Place]]:
    """All poses and the lens together: Gauss-Newton steps, with the poses eliminated (Schur complement)."""
    numbers = list(places)
    cameras = {n: (places[n].rotation, places[n].centre) for n in numbers}
    fields = [slopes[n] for n in numbers]
    at_rest = replace(lens, rotation=np.eye(3), translation=np.zeros(3))

    def seen() -> EdgePoints:
        return joined(
            photographs.seen_from(photographs.near(*cameras[n]), *cameras[n], frame) for frame, n in enumerate(numbers)
        )

    for reach, scale in _ADJUSTED:
        frame, rows, offsets, weights = matched_rows(at_rest, seen(), fields, reach, scale)
        steps, of_lens = _solved(frame, rows, offsets, weights, len(numbers), at_rest.width)
        at_rest = at_rest.moved(np.concatenate([np.zeros(6), of_lens]))
        for step, n in zip(steps, numbers):
            rotation, centre = cameras[n]
            turned = cv2.Rodrigues(np.ascontiguousarray(step[:3]))[0] @ rotation
            cameras[n] = turned, centre - turned.T @ step[3:]
    met = meetings(at_rest, seen(), fields)
    return at_rest, {n: Place(*cameras[n], met[frame]) for frame, n in enumerate(numbers) if frame in met}


def _solved(
    frame: NDArray[np.int64],
    rows: Array,
    offsets: Array,
    weights: Array,
    count: int,
    width: int,
) -> tuple[Array, Array]:
    """Steps of the poses [count, 6] and of the lens [5], of least weighted squares."""
    spreads = np.array([0.3, 0.04 * width, 0.04 * width, 0.6, 0.4])  # of the lens; images say far more
    of_lens, right = np.diag(1 / spreads**2), np.zeros(5)
    inverses, mixed, rights = np.zeros((count, 6, 6)), np.zeros((count, 6, 5)), np.zeros((count, 6))
    for number in range(count):
        mine = frame == number
        weighted = rows[mine] * weights[mine, None]
        normal, side = weighted.T @ rows[mine], weighted.T @ offsets[mine]
        damped = normal[:6, :6] + np.diag(1e-6 * np.diag(normal)[:6] + 1e-9)
        inverses[number], mixed[number], rights[number] = np.linalg.inv(damped), normal[:6, 6:], side[:6]
        of_lens += normal[6:, 6:] - mixed[number].T @ inverses[number] @ mixed[number]
        right += side[6:] - mixed[number].T @ inverses[number] @ rights[number]
    lens: Array = np.linalg.solve(of_lens, right).astype(np.float64)
    return np.einsum("nij,nj->ni", inverses, rights - mixed @ lens), lens


def gps_errors(places: Mapping[int, Place], gps: Sequence[Array | None]) -> dict[int, Array]:
    """By how much GPS misses the places of images, [3] each."""
    stated = {number: gps[number] for number in places}
    return {number: place - places[number].centre for number, place in stated.items() if place is not None}


def _sound(places: Mapping[int, Place], gps: Sequence[Array | None]) -> dict[int, Place]:
    """Images that meet edges as most do, and lie where GPS has them."""
    if not places:
        return {}
    usual = float(np.median([place.above_chance for place in places.values()]))
    least = max(_ABOVE_CHANCE, 1 + _OF_USUAL * (usual - 1))
    good = {number: place for number, place in places.items() if place.above_chance >= least}
    off = gps_errors(good, gps)
    if len(off) < 4:
        return good
    apart = np.array(list(off.values())) - np.median(list(off.values()), axis=0)
    distance = np.linalg.norm(apart, axis=1)
    far = distance > _OFF_GPS * max(float(np.median(distance)), 1e-9) / 1.538
    wrong = {number for number, is_far in zip(off, far) if is_far}
    return {number: place for number, place in good.items() if number not in wrong}
