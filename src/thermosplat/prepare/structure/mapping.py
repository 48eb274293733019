"""Poses of the photographs from their matches: COLMAP's incremental or global mapping, then one careful adjustment."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap

from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.structure.matching import opened
from thermosplat.prepare.structure.photograph_cameras import CAMERA_MODEL, guessed_anew

Mapper = Literal["auto", "incremental", "global"]
_SMALLEST_MODEL = 3
"""Photographs: two have a pose beside each other, but nothing confirms it."""
_ENOUGH = 0.9
"""Share of the photographs with a pose with which "auto" is content."""
LENS_MODEL = "RADIAL"
"""One focal length, the principal point and two radial terms. Tangential terms trade against the principal point: on
a rendered rig whose principal point is 4 px off, OPENCV with the point held turns all cameras by 0.29°, RADIAL with
the point refined by 0.05°."""
_ENOUGH_FOR_PRINCIPAL_POINT = 12
"""Photographs from which the principal point is refined; with fewer it follows noise."""
_PRINCIPAL_POINT_WITHIN = 0.06
"""Share of the image's width by which it may move from the centre; a larger shift is a sign of weak geometry."""
_LOSSES = ((pycolmap.LossFunctionType.SOFT_L1, 1.0, 1.5), (pycolmap.LossFunctionType.CAUCHY, 0.5, 1.5))
"""Loss, its scale [px] and the largest error [px] of a point that stays, for each round of the last adjustment."""


_TOLERANCE = 1e-6
"""Relative change of the cost at which an adjustment with positions ends, as Ceres has it; COLMAP goes on for 100
rounds. 101 photographs of a flight take a quarter of the time, and poses are the same to 0.0001°."""


def map_photographs(
    database: Path, images: Path, output: Path, mapper: Mapper, fixed_cameras: Sequence[int] = ()
) -> list[pycolmap.Reconstruction]:
    """All models that the photographs make, the one with most photographs first.

    Where "auto" leaves photographs without a pose by adding one after the other, it solves for all at once, without the
    focal lengths that files state. On 29 phone pictures whose EXIF is wrong by a third, the first way finds 2 poses and
    the second 29.

    Args:
        database: Database with verified matches; its guesses of cameras may change.
        mapper: COLMAP's "incremental" or "global" mapping, or "auto".
        fixed_cameras: Ids of cameras whose lens is known from a board.
    """
    output.mkdir(parents=True, exist_ok=True)
    with opened(database) as connection:
        count = connection.num_images()
    if mapper != "global":
        models = _incremental(database, images, output, count, fixed_cameras)
        if mapper == "incremental" or _registered(models) >= _ENOUGH * count:
            return models
        _forget_focal_lengths(database, fixed_cameras)
        return max(models, _global(database, images, output, fixed_cameras), key=_registered)
    return _global(database, images, output, fixed_cameras)


def _registered(models: Sequence[pycolmap.Reconstruction]) -> int:
    return models[0].num_reg_images() if models else 0


def _incremental(
    database: Path, images: Path, output: Path, count: int, fixed_cameras: Sequence[int]
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.min_model_size = _SMALLEST_MODEL
    options.constant_cameras = set(fixed_cameras)
    with progress_bar("poses", count) as advance:
        found = pycolmap.incremental_mapping(
            database,
            images,
            output,
            options=options,
            initial_image_pair_callback=lambda: advance(2),
            next_image_callback=lambda: advance(1),
        )
    return _largest_first(found)


def _global(database: Path, images: Path, output: Path, fixed_cameras: Sequence[int]) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    with opened(database) as connection:
        known = connection.num_cameras() == len(fixed_cameras)
    options.mapper.bundle_adjustment.refine_focal_length = not known
    options.mapper.bundle_adjustment.refine_extra_params = not known
    with progress_bar("poses, all at once", 1):
        return _largest_first(pycolmap.global_mapping(database, images, output, options))


def _largest_first(found: Mapping[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    large = [model for model in found.values() if model.num_reg_images() >= _SMALLEST_MODEL]
    return sorted(large, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _forget_focal_lengths(database: Path, fixed_cameras: Sequence[int]) -> None:
    with opened(database) as connection:
        for camera in connection.read_all_cameras():
            if camera.camera_id not in fixed_cameras:
                connection.update_camera(guessed_anew(camera))


def adjusted(
    model: pycolmap.Reconstruction, fixed_cameras: Sequence[int] = (), priors: Sequence[pycolmap.PosePrior] = ()
) -> pycolmap.Reconstruction:
    """The model with all poses, points and lenses adjusted once more, by a loss on which outliers bear little.

    Lenses get a second radial term. The principal point is refined where there are photographs enough, and held if it
    runs away.

    Args:
        fixed_cameras: Ids of cameras whose lens is known.
        priors: Positions of photographs in the model's world, which keep a long flight from bending.
    """
    free = [camera_id for camera_id in model.cameras if camera_id not in fixed_cameras]
    model = pycolmap.Reconstruction(model)
    for camera_id in (free_id for free_id in free if model.cameras[free_id].model.name == CAMERA_MODEL):
        f, cx, cy, k1 = model.cameras[camera_id].params
        model.cameras[camera_id].model = LENS_MODEL
        model.cameras[camera_id].params = [f, cx, cy, k1, 0.0]
    if free and model.num_reg_images() >= _ENOUGH_FOR_PRINCIPAL_POINT * len(free):
        result = pycolmap.Reconstruction(model)
        _adjust(result, fixed_cameras, priors, principal_point=True)
        if not any(_strayed(result.cameras[camera_id]) for camera_id in free):
            return result
    result = pycolmap.Reconstruction(model)
    _adjust(result, fixed_cameras, priors, principal_point=False)
    return result


def _adjust(
    model: pycolmap.Reconstruction,
    fixed_cameras: Sequence[int],
    priors: Sequence[pycolmap.PosePrior],
    principal_point: bool,
) -> None:
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
        if priors:
            options.ceres.solver_options.function_tolerance = _TOLERANCE
            by_position = pycolmap.PosePriorBundleAdjustmentOptions()
            pycolmap.create_pose_prior_bundle_adjuster(options, by_position, config, priors, model).solve()
        else:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
            pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        pycolmap.ObservationManager(model).filter_all_points3D(largest, 1.5)
    model.update_point_3d_errors()


def _strayed(camera: pycolmap.Camera) -> bool:
    shift = np.array([camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2])
    return bool(np.linalg.norm(shift) > _PRINCIPAL_POINT_WITHIN * camera.width)
