"""How well the thermal focal length is known: by the edges, and by the photographs' own focal length.

The thermal focal length is found relative to that of the photographs, and inherits its error. On scenes with little
depth structure from motion may be off by several percent, and edges meet perfectly all the same.

Edges: the points of a contour lie beside its thermal edge by the same distance in all photographs. So all of them say
no more than those of one. Every unknown counts, also one that was held because the images do not show it.
Photographs: the covariance of the bundle adjustment, for features that are good to a pixel, COLMAP's own unit.

Measured on rendered pairs (2026-11-28): rig_desk states 0.6 px and is 1.0 px off; four walls whose relief is 1 to 20%
of the distance state 110, 32, 34 and 18 px and are 134, 16, 27 and 8 px off.
"""

import math
from collections.abc import Sequence

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.prepare.registration.edge_alignment import Alignment, edge_information, prior_information
from thermosplat.prepare.registration.rig_camera import UNKNOWNS, RigCamera
from thermosplat.prepare.registration.rig_model import with_thermal
from thermosplat.prepare.registration.stereo_edges import EdgePoints

_MOST_PHOTOGRAPHS = 200
"""Photographs of which the covariance is taken: of more, so many that are spread over all."""


def edges_deviation(found: Alignment, edges: EdgePoints, slopes: Sequence[NDArray[np.float32]]) -> float:
    """Standard deviation of the logarithm of the thermal focal length, the photographs' being exact.

    Args:
        slopes: Slopes [H, W, 2] of each frame's thermal image.
    """
    information = edge_information(found.camera, edges, slopes) / max(len(np.unique(edges.frame)), 1)
    inverse = np.linalg.inv(information + np.diag(prior_information(edges, found.camera)))
    place = UNKNOWNS.index("log_f")
    return float(np.sqrt(inverse[place, place]))


def photographs_deviation(model: pycolmap.Reconstruction) -> float:
    """The same of the photographs' focal length, the largest of several cameras'; infinite where nothing tells it.

    Args:
        model: COLMAP model of the photographs; thermal images in it do not count.
    """
    if not model.points3D:
        return math.inf
    # thermal images have no features, and the covariance is not defined for a second image of a frame
    alone = with_thermal(model, RigCamera.looking_along(1, 1, 1.0), {})
    images = [image for _, image in sorted(alone.images.items())]
    chosen = images[:: -(-len(images) // _MOST_PHOTOGRAPHS)]
    config = pycolmap.BundleAdjustmentConfig()
    for image in chosen:
        config.add_image(image.image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, refine_sensor_from_rig=False)
    problem = pycolmap.create_default_ceres_bundle_adjuster(options, config, alone)
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), alone, problem)
    deviations = [0.0]
    for camera_id in {image.camera_id for image in chosen}:
        camera = alone.cameras[camera_id]
        own = None if covariance is None else covariance.get_other_params_cov(camera.params)
        if own is None:
            return math.inf
        places = list(camera.focal_length_idxs())
        deviations.append(math.sqrt(np.diag(own)[places].mean()) / camera.mean_focal_length())
    return max(deviations)
