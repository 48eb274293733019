"""The photographs' model in metres, east, north and up: a similarity to their GPS positions that leaves wrong ones out.

The others are priors of the model's last adjustment.
"""

from dataclasses import dataclass

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.datasets.colmap.similarity import ransac_similarity, similarity_by_weights
from thermosplat.datasets.geo_file import GeoFrame
from thermosplat.prepare.capture_folder import LEADING, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.structure.positions import Positions
from thermosplat.prepare.structure.unregistered import some

FEWEST = 4
"""Photographs with a pose and a position: three of them have a similarity whatever they say."""
_LARGEST_TURN = 0.05
"""Standard deviation [rad] of the turn about the line along which positions lie: 5 m at 100 m. Open choice."""
_WITHIN = (10.0, 5.0, 2.5, 1.2, 0.6, 0.3, 0.1)
"""What first fits call right [m]: GPS alone is good to some metres, an RTK receiver to centimetres."""
_TRIALS = 500
"""Of three places each: where a third is wrong, one in three has none of them."""
_ROUNDS = 30
_WRONG = 5.0
"""Standard deviations from which on a position has no weight: Tukey's biweight, 95% as exact as least squares where all
are right (4.7, Holland and Welsch 1977)."""
_LEAST_SCALE = 0.2
"""Of that deviation, in those that are stated: nothing is wrong that lies as near as a position may be off."""
_TO_DEVIATION = 1.0 / 1.538
"""Standard deviation by axis of the median distance in three dimensions (chi distribution)."""
_LEAST_DEVIATION = 0.01
"""[m] of a position: receivers are not more exact."""
_MOST_WRONG = 0.5
"""Share of wrong positions from which on none is believed."""
_MOST_RESIDUAL = 0.2
"""Median distance, as a share of the positions' own from their middle, from which on they say nothing."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Placed:
    """A model on the Earth, and what is to be said of it.

    Args:
        model: The model; in its own units where ``geo`` is None.
        geo: Where it lies; None where GPS does not say.
        priors: The positions that were not left out, for the model's last adjustment.
    """

    model: pycolmap.Reconstruction
    geo: GeoFrame | None
    sentences: tuple[str, ...]
    priors: tuple[pycolmap.PosePrior, ...] = ()


def placed(model: pycolmap.Reconstruction, photographs: list[FrameRow], positions: Positions) -> Placed:
    """The model where GPS has its cameras.

    Args:
        positions: Their positions, in the same order.
    """
    known = {f"{LEADING}/{row.file}": number for number, row in enumerate(photographs) if positions.known[number]}
    images = [image for _, image in sorted(model.images.items()) if image.has_pose and image.name in known]
    if not known:
        return Placed(model, None, ())
    if not positions.has_height:
        return _unplaced(model, "have no altitude")
    if len(images) < FEWEST:
        return _unplaced(
            model, f"are known of {counted(len(images), 'photograph')} with a pose, and {FEWEST} are needed"
        )
    numbers = [known[image.name] for image in images]
    places, deviations = positions.places[numbers], positions.deviations[numbers]
    centres = np.array([image.projection_center() for image in images])
    fit = robust_similarity(centres, places, deviations)
    extent = float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))
    if fit is None or fit.wrong.mean() > _MOST_WRONG or np.median(fit.residuals) > _MOST_RESIDUAL * extent:
        return _unplaced(model, "do not fit the poses")
    right = ~fit.wrong
    median = float(np.median(fit.residuals[right]))
    aside = np.linalg.svd(places[right] - places[right].mean(axis=0), compute_uv=False)[1]
    if median * _TO_DEVIATION >= _LARGEST_TURN * aside:
        return _unplaced(model, "lie on one line, about which the model could turn")
    result = pycolmap.Reconstruction(model)
    result.transform(fit.similarity)
    latitude, longitude, altitude = positions.origin
    geo = GeoFrame(latitude, longitude, altitude, round(median, 3), int(right.sum()))
    said = [
        f"The model is in metres, x east, y north, z up of {latitude:.7f}°, {longitude:.7f}°, {altitude:.2f} m (UTM "
        f"zone {geo.zone}, EPSG:{geo.epsg}): {counted(geo.cameras, 'camera')} "
        f"{agreeing(geo.cameras, 'lies', 'lie')} {median:.2f} m from where GPS has them, in the median."
    ]
    if fit.wrong.any():
        names = [image.name for image, wrong in zip(images, fit.wrong) if wrong]
        least = float(fit.residuals[fit.wrong].min())
        said.append(
            f"! GPS is wrong by {least:.1f} m or more in {counted(len(names), 'photograph')}, whose positions were "
            f"left out: {some(names)}."
        )
    told = float(np.median(fit.residuals / deviations)) * _TO_DEVIATION
    priors = [
        _prior(image, place, told * deviation)
        for image, place, deviation, wrong in zip(images, places, deviations, fit.wrong)
        if not wrong
    ]
    return Placed(result, geo, tuple(said), tuple(priors))


def _prior(image: pycolmap.Image, place: Array, deviation: float) -> pycolmap.PosePrior:
    """Where a photograph was taken [m], and how exactly."""
    prior = pycolmap.PosePrior()
    prior.pose_prior_id, prior.corr_data_id = image.image_id, image.data_id
    prior.position, prior.position_covariance = place, np.eye(3) * max(deviation, _LEAST_DEVIATION) ** 2
    prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    return prior


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity to positions.

    Args:
        similarity: From the model to the positions.
        residuals: Distances [m], [N].
        wrong: Positions that do not fit, [N].
    """

    similarity: pycolmap.Sim3d
    residuals: Array
    wrong: NDArray[np.bool_]


def robust_similarity(centres: Array, places: Array, deviations: Array) -> Fit | None:
    """The similarity that brings most centres to their places, wherever the others are.

    LO-RANSAC with several limits gives starts, of which that with the least median distance is taken. Tukey's weights
    finish, with a scale that the residuals themselves tell: places that are wrong together by metres draw nothing.

    Args:
        centres: In the model, [N, 3].
        places: Where they are [m], [N, 3].
        deviations: Standard deviations of the places [m], [N].

    Returns:
        None where nothing fits.
    """
    starts = []
    for within in _WITHIN:
        start = ransac_similarity(centres, places, within, (_TRIALS, _TRIALS))
        if start is not None:
            starts.append(start)
    if not starts:
        return None

    def apart(matrix: Array) -> Array:
        return np.asarray(np.linalg.norm(centres @ matrix[:, :3].T + matrix[:, 3] - places, axis=1))

    def far(matrix: Array) -> Array:
        """Distances of which 1 is the farthest that counts."""
        distances = apart(matrix) / deviations
        return np.asarray(distances / (_WRONG * max(float(np.median(distances)) * _TO_DEVIATION, _LEAST_SCALE)))

    matrix = min(starts, key=lambda start: float(np.median(apart(start) / deviations)))
    for _ in range(_ROUNDS):
        weights = np.where(far(matrix) < 1.0, (1.0 - far(matrix) ** 2) ** 2, 0.0) / deviations**2
        matrix = similarity_by_weights(centres, places, weights)
    return Fit(pycolmap.Sim3d(matrix), apart(matrix), far(matrix) >= 1.0)


def _unplaced(model: pycolmap.Reconstruction, why: str) -> Placed:
    said = f"! GPS positions {why}: the model stays in units of its own, and maps in local coordinates."
    return Placed(model, None, (said,))
