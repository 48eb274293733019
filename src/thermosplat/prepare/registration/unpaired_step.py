"""Thermal images of another hour in the photographs' scene: the part of registering without pairs."""

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap

from thermosplat.datasets.geo_file import read_geo
from thermosplat.datasets.lens import Lens
from thermosplat.errors import UserError
from thermosplat.prepare.calibration.calibration_file import read_calibration
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.registration.rig_camera import Array, RigCamera
from thermosplat.prepare.registration.rig_model import is_photograph, with_unpaired
from thermosplat.prepare.registration.stereo_edges import photograph_edges
from thermosplat.prepare.registration.thermal_edges import slopes
from thermosplat.prepare.registration.thermal_images import thermal_images
from thermosplat.prepare.registration.unpaired import Photographs, Placement, gps_errors, placed_images
from thermosplat.prepare.structure.positions import east_north_up
from thermosplat.prepare.structure.sfm import write_model
from thermosplat.prepare.structure.unregistered import some

FEWEST_PLACED = 3
EDGES_PER_PHOTOGRAPH = 1500


def place_unpaired(capture: CaptureFolder, model: pycolmap.Reconstruction) -> list[str]:
    """Place thermal images and write them into ``sparse/0``.

    Args:
        capture: The capture, whose pairs.csv is empty.
        model: The photographs' model.

    Returns:
        What was found.

    Raises:
        UserError: Too few of them can be placed, or they cannot be read.
    """
    rows = sorted(capture.read_frames(OTHER), key=lambda row: row.file)
    images = sorted(
        (image for image in model.images.values() if image.has_pose and is_photograph(image)),
        key=lambda image: image.name,
    )
    thermal = thermal_images(capture, [row.file for row in rows])
    width = round(1.5 * thermal[0].shape[1])
    edges = photograph_edges(model, images, capture.root / "images", width, EDGES_PER_PHOTOGRAPH)
    poses = [image.cam_from_world() for image in images]
    photographs = Photographs(
        np.stack([pose.rotation.matrix() for pose in poses]),
        np.stack([image.projection_center() for image in images]),
        edges,
    )
    gps = _positions(capture, rows)
    calibration = read_calibration(capture.calibration_json)
    lens = None if calibration is None else _of_a_board(calibration.thermal, thermal[0].shape)
    found = placed_images(photographs, [slopes(image) for image in thermal], gps, lens)
    if found is None:
        raise UserError(
            f"The thermal images of {capture.root} do not tell their focal length: flat ground looks the same through "
            "a longer lens from farther away.",
            "Calibrate the thermal camera with a board: thermosplat-prepare calibrate --help",
        )
    if len(found.places) < FEWEST_PLACED:
        raise UserError(
            f"{len(found.places)} of {counted(len(rows), 'thermal image')} of {capture.root} could be placed among the "
            f"photographs, and training needs {FEWEST_PLACED}.",
            "Do they show the same place, with contours of warm and cold things? Positions by GPS help "
            "(docs/prepare.md#thermal-images-of-another-hour).",
        )
    poses_by_file = {
        rows[number].file: pycolmap.Rigid3d(np.column_stack([place.rotation, -place.rotation @ place.centre]))
        for number, place in found.places.items()
    }
    write_model(with_unpaired(model, found.lens, poses_by_file), capture.sparse)
    return _said(found, rows, gps)


def _of_a_board(lens: Lens, shape: tuple[int, ...]) -> RigCamera:
    """The lens that a board showed.

    Raises:
        UserError: It is of images of another size.
    """
    if (lens.height, lens.width) != shape[:2]:
        raise UserError(
            f"calibration.json is for thermal images of {lens.width}x{lens.height} px, and these have "
            f"{shape[1]}x{shape[0]} px.",
            "Calibrate with the settings of the capture, or delete calibration.json.",
        )
    return RigCamera(np.eye(3), np.zeros(3), np.array(lens.params), lens.width, lens.height)


def _positions(capture: CaptureFolder, rows: list[FrameRow]) -> list[Array | None]:
    """Where GPS has thermal images in the photographs' world; None where it does not say, or has no such world."""
    geo = read_geo(capture.root)
    if geo is None:
        return [None] * len(rows)
    origin = geo.latitude, geo.longitude, geo.altitude
    return [
        None
        if row.latitude is None or row.longitude is None or row.altitude is None
        else east_north_up(np.array([[row.latitude, row.longitude, row.altitude]]), origin)[0]
        for row in rows
    ]


def _said(found: Placement, rows: list[FrameRow], gps: list[Array | None]) -> list[str]:
    f, cx, cy, k1, k2 = found.lens.lens
    ratio = float(np.median([place.above_chance for place in found.places.values()]))
    count = len(found.places)
    said = [
        f"{count} of {counted(len(rows), 'thermal image')} without a partner {agreeing(count, 'is', 'are')} placed "
        f"among the {LEADING} images; edges meet {ratio:.1f} times as often as by chance, in the median.",
        f"Thermal lens: focal length {f:.1f} px, principal point {cx:.1f}, {cy:.1f}, distortion {k1:.3f}, {k2:.3f}.",
    ]
    off = list(gps_errors(found.places, gps).values())
    if off:
        common = np.median(off, axis=0)
        apart = float(np.median(np.linalg.norm(off - common, axis=1)))
        said.append(
            f"Their GPS positions have a common error of {' '.join(f'{x:+.1f}' for x in common)} m east, north and up "
            f"of the photographs', and lie {apart:.2f} m from the places beyond that, in the median."
        )
    lost = [row.file for number, row in enumerate(rows) if number not in found.places]
    if lost:
        said.append(
            f"! {counted(len(lost), 'thermal image')} could not be placed and {agreeing(len(lost), 'is', 'are')} left "
            f"out: {some(lost)}."
        )
    return said
