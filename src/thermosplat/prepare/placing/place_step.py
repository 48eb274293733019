"""Thermal images of another hour in the photographs' scene: the part of registering without pairs."""

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap

from thermosplat.datasets.geo_file import read_geo
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.placing.placed_images import Placement, placed_images
from thermosplat.prepare.placing.thermal_looks import ThermalImage
from thermosplat.prepare.placing.world_edges import photographs_of
from thermosplat.prepare.registration.rig_camera import Array
from thermosplat.prepare.registration.rig_model import is_photograph, with_unpaired
from thermosplat.prepare.registration.thermal_images import thermal_images
from thermosplat.prepare.structure.positions import east_north_up
from thermosplat.prepare.structure.sfm import write_model
from thermosplat.prepare.structure.unregistered import some

FEWEST_PLACED = 12
"""Images that tell one lens and what of a scene is warm. Open choice."""
_LEAST_SHARE = 0.25
"""Of what others show, less what chance shows, that images show in the median; 0.6 on a rendered flight. Open
choice."""


def place_unpaired(capture: CaptureFolder, model: pycolmap.Reconstruction) -> list[str]:
    """Place thermal images and write them into ``sparse/0``.

    Args:
        capture: The capture, whose pairs.csv is empty.
        model: The photographs' model.

    Returns:
        What was found.

    Raises:
        UserError: There are too few images, too few can be placed, or they cannot be read.
    """
    frames = sorted(capture.read_frames(OTHER), key=lambda row: row.file)
    gps = _positions(capture, frames)
    if len(frames) < FEWEST_PLACED:
        raise UserError(
            f"{capture.root} has {counted(len(frames), 'thermal image')} of another hour, and they are placed from "
            f"{FEWEST_PLACED} on.",
            "Import more of them, or pair them with the photographs if they were taken together: "
            f"thermosplat-prepare pair {capture.root}",
        )
    has_gps = np.isfinite(gps.sum(axis=1))
    by_gps = bool(has_gps.sum() >= FEWEST_PLACED)
    rows = [row for row, has in zip(frames, has_gps) if has or not by_gps]
    images = sorted(
        (image for image in model.images.values() if image.has_pose and is_photograph(image)),
        key=lambda image: image.name,
    )
    thermal = thermal_images(capture, [row.file for row in rows], "frames.csv")
    photographs = photographs_of(model, images, capture.root / "images", round(1.5 * thermal[0].shape[1]))
    found = placed_images(photographs, [ThermalImage.of(image) for image in thermal], gps[has_gps] if by_gps else None)
    if len(found.right) < FEWEST_PLACED or found.share < _LEAST_SHARE:
        raise UserError(
            f"The thermal images of {capture.root} cannot be placed among the photographs: an image shows "
            f"{found.share:.0%} of what the others show there, and {_LEAST_SHARE:.0%} are needed.",
            "Do they show the same place, with contours of warm and cold things? GPS positions help, in files or in "
            "a gps.csv beside them (docs/prepare.md#import).",
        )
    poses = {
        rows[number].file: found.known.poses[number].camera(found.known.lens).colmap_pose() for number in found.right
    }
    write_model(with_unpaired(model, found.known.lens, poses), capture.sparse)
    return _said(found, rows, frames, by_gps)


def _positions(capture: CaptureFolder, rows: list[FrameRow]) -> Array:
    """Where GPS has thermal images in the photographs' world, [N, 3]; NaN where it does not say."""
    geo = read_geo(capture.root)
    places = np.full((len(rows), 3), np.nan)
    if geo is not None:
        degrees = np.array([(row.latitude, row.longitude, row.altitude) for row in rows], np.float64).reshape(-1, 3)
        known = np.isfinite(degrees).all(axis=1)
        places[known] = east_north_up(degrees[known], (geo.latitude, geo.longitude, geo.altitude))
    return places


def _said(found: Placement, rows: list[FrameRow], frames: list[FrameRow], by_gps: bool) -> list[str]:
    f, cx, cy, k1, k2 = found.known.lens.lens
    common = " ".join(f"{x:+.1f}" for x in found.known.common_error)
    count = len(found.right)
    said = [
        f"{count} of {counted(len(frames), 'thermal image')} of another hour {agreeing(count, 'is', 'are')} placed "
        f"among the {LEADING} images; one shows {found.share:.0%} of what the others show there, in the median.",
        f"Thermal lens: focal length {f:.1f} px, principal point {cx:.1f}, {cy:.1f}, distortion {k1:.3f}, {k2:.3f}.",
        f"Their GPS positions have a common error of {common} m east, north and up against the photographs', and a "
        f"standard deviation of {found.known.deviation:.2f} m by axis beyond that."
        if by_gps
        else "They have no GPS positions: each was searched near all photographs, along a path in the order of names.",
    ]
    placed = {rows[number].file for number in found.right}
    lost = [row.file for row in frames if row.file not in placed]
    if lost:
        said.append(
            f"! {counted(len(lost), 'thermal image')} could not be placed and {agreeing(len(lost), 'is', 'are')} left "
            f"out: {some(lost)}."
        )
    return said
