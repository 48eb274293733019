"""Poses of the photographs from their matches: COLMAP's incremental or global mapping, then one careful adjustment."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap

from thermosplat.prepare.progress import progress_bar

Mapper = Literal["incremental", "global"]
_SMALLEST_MODEL = 3
_ENOUGH_FOR_PRINCIPAL_POINT = 12
"""Photographs from which the principal point is refined; with fewer it follows noise."""
_PRINCIPAL_POINT_WITHIN = 0.06
"""Share of the image's width by which it may move from the centre; a larger shift is a sign of weak geometry."""
_LOSSES = ((pycolmap.LossFunctionType.SOFT_L1, 1.0, 1.5), (pycolmap.LossFunctionType.CAUCHY, 0.5, 1.5))
"""Loss, its scale [px] and the largest error [px] of a point that stays, for each round of the last adjustment."""


@dataclass(frozen=True)
class MappingOptions:
    """How poses are found.

    Args:
        mapper: "incremental" adds one photograph after the other; "global" solves for all at once.
        fixed_cameras: Ids of cameras whose lens is known from a board.
    """

    mapper: Mapper = "incremental"
    fixed_cameras: Sequence[int] = ()


def map_photographs(
    database: Path, images: Path, output: Path, count: int, options: MappingOptions
) -> list[pycolmap.Reconstruction]:
    """All models that the photographs make, the one with most photographs first.

    Args:
        database: Database with verified matches.
        images: Folder that the photographs' names are relative to.
        output: Folder for what COLMAP writes on its way.
        count: Number of photographs, for the progress bar.
        options: How.
    """
    output.mkdir(parents=True, exist_ok=True)
    if options.mapper == "global":
        pipeline = pycolmap.GlobalPipelineOptions()
        pipeline.random_seed = 0
        found = pycolmap.global_mapping(database, images, output, pipeline)
    else:
        incremental = pycolmap.IncrementalPipelineOptions()
        incremental.random_seed = 0
        incremental.min_model_size = _SMALLEST_MODEL
        incremental.constant_cameras = set(options.fixed_cameras)
        with progress_bar("poses", count) as advance:
            found = pycolmap.incremental_mapping(
                database,
                images,
                output,
                options=incremental,
                initial_image_pair_callback=lambda: advance(2),
                next_image_callback=lambda: advance(1),
            )
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def adjusted(model: pycolmap.Reconstruction, fixed_cameras: Sequence[int] = ()) -> pycolmap.Reconstruction:
    """The model with all poses, points and lenses adjusted once more, by a loss on which outliers bear little.

    The principal point is refined where there are photographs enough, and held if it runs away.

    Args:
        model: The model.
        fixed_cameras: Ids of cameras whose lens is known.
    """
    free = [camera_id for camera_id in model.cameras if camera_id not in fixed_cameras]
    if free and model.num_reg_images() >= _ENOUGH_FOR_PRINCIPAL_POINT * len(free):
        result = pycolmap.Reconstruction(model)
        _adjust(result, fixed_cameras, principal_point=True)
        if not any(_strayed(result.cameras[camera_id]) for camera_id in free):
            return result
    result = pycolmap.Reconstruction(model)
    _adjust(result, fixed_cameras, principal_point=False)
    return result


def _adjust(model: pycolmap.Reconstruction, fixed_cameras: Sequence[int], principal_point: bool) -> None:
    for loss, scale, largest in _LOSSES:
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary = False
        options.refine_principal_point = principal_point
        options.ceres.loss_function_type = loss
        options.ceres.loss_function_scale = scale
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in model.reg_image_ids():
            config.add_image(image_id)
        for camera_id in fixed_cameras:
            config.set_constant_cam_intrinsics(camera_id)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        pycolmap.ObservationManager(model).filter_all_points3D(largest, 1.5)
    model.update_point_3d_errors()


def _strayed(camera: pycolmap.Camera) -> bool:
    shift = np.array([camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2])
    return bool(np.linalg.norm(shift) > _PRINCIPAL_POINT_WITHIN * camera.width)
