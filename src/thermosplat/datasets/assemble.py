"""From a listing of files to a capture in memory: read, interpret, rectify, shrink, divide."""

from itertools import compress
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config import ThermalConfig
from thermosplat.datasets.capture import Capture, Frame, Modality, View
from thermosplat.datasets.capture_notes import distortion_notes, pairing_notes
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.image_files import resize
from thermosplat.datasets.lens import rectification, shrunk
from thermosplat.datasets.msx import msx_notes
from thermosplat.datasets.splits import divide, hold_out_mask
from thermosplat.datasets.thermal_files import interpret_thermal, read_each, read_thermal, require_8bit
from thermosplat.datasets.thermal_images import ThermalPixels
from thermosplat.errors import UserError

LEAST_SIDE = 6
"""Least width and height of an image [px]: SSIM's window of 11 px is reflected by 5 at the borders (ssim.py)."""


def assemble(
    root: Path, name: str, listing: Listing, *, data_factor: int, test_every: int, thermal: ThermalConfig
) -> Capture:
    """Read all images of a listing.

    Args:
        root: The capture's folder.
        name: The capture's name.
        listing: Its files, cameras and points.
        data_factor: Divide the images' sides by this.
        test_every: Period of the hold-out rule, where the folders do not divide the frames.
        thermal: How thermal images are read.

    Raises:
        UserError: Files are unreadable, of the wrong size, or not what `thermal` asks for.
    """
    if not isinstance(data_factor, Integral) or data_factor < 1:
        raise UserError(
            f"--data-factor (data_factor) must be a whole number of at least 1, got {data_factor!r}.",
            "1 keeps the images' size, 2 halves width and height.",
        )
    frames = sorted(listing.frames, key=lambda frame: frame.name)
    if not frames:
        message = " ".join([f"No image of {root} has a camera in its model.", *listing.notes])
        raise UserError(message, "Are images and model of the same capture, under the same names?")
    for shot in (shot for frame in frames for shot in (frame.rgb, frame.thermal) if shot is not None):
        _check_camera(shot, root)
    mask = hold_out_mask(frames, test_every)
    rgb_images = read_each([frame.rgb for frame in frames])
    thermal_files = read_thermal(frames)
    reading = interpret_thermal(root, thermal_files, listing, thermal)
    views = []
    for index, frame in enumerate(frames):
        pixels = None if reading is None else reading.pixels[index]
        views.append(_frame(frame, rgb_images[index], pixels, listing, root, data_factor, thermal.aligned))
    shown = [frame.rgb is not None or frame.thermal is not None for frame in views]  # a lone file may be of no use
    views, mask = list(compress(views, shown)), list(compress(mask, shown))
    train, test = divide(views, mask)
    notes = [*listing.notes, *pairing_notes(views), *distortion_notes(frames)]
    notes += [] if reading is None else reading.notes
    notes += msx_notes(
        [(image, file.display) for image, file in zip(rgb_images, thermal_files, strict=True) if file is not None]
    )
    scale = None if reading is None else reading.scale
    usable = np.isfinite(listing.points).all(axis=-1)
    if not usable.all():
        notes.append(
            f"{np.sum(~usable):,} of {len(listing.points):,} starting points are not finite and were left out."
        )
    points, colors = listing.points[usable], listing.point_colors[usable]
    return Capture(name, root, listing.layout, train, test, points, colors, scale, tuple(notes), listing.not_found)


def _frame(
    files: FrameFiles,
    rgb: NDArray[Any] | None,
    thermal: ThermalPixels | None,
    listing: Listing,
    root: Path,
    data_factor: int,
    aligned: bool,
) -> Frame:
    """A frame from its files' pixels."""
    rgb_view = thermal_view = None
    if files.rgb is not None and rgb is not None:
        _check_size(files.rgb, rgb, root)
        rgb_view = _view("rgb", files.rgb, _as_rgb(files.rgb.path, rgb), None, data_factor)
    if files.thermal is not None and thermal is not None:
        if files.thermal_has_camera:
            _check_size(files.thermal, thermal.image, root)
        elif not aligned:
            _check_borrowed_camera(files.thermal, thermal.image, rgb, listing.registered, root)
        thermal_view = _view("thermal", files.thermal, thermal.image, thermal.celsius, data_factor)
    return Frame(files.name, rgb_view, thermal_view)


def _check_camera(shot: Shot, root: Path) -> None:
    """No render looks like an image whose camera has no focal length or no place."""
    focal = shot.lens.focal_lengths()
    if not (np.isfinite(shot.lens.params).all() and min(focal) > 0 and min(shot.lens.width, shot.lens.height) > 0):
        raise UserError(
            f"The camera of {shot.path.relative_to(root)} is impossible: {shot.lens.model} of "
            f"{shot.lens.width}x{shot.lens.height} px with the parameters {list(shot.lens.params)}.",
            "Focal lengths are positive and in pixels. Calibrate it anew (colmap), or correct the file that states it.",
        )
    if not np.isfinite(shot.viewmat).all():
        raise UserError(
            f"The pose of {shot.path.relative_to(root)} is not finite.", "Register the images anew (colmap mapper)."
        )


def _check_size(shot: Shot, image: NDArray[Any], root: Path) -> None:
    height, width = image.shape[:2]
    if not shot.lens.fits(width, height):
        raise UserError(
            f"{shot.path.relative_to(root)} is {width}x{height} but its camera was calibrated at "
            f"{shot.lens.width}x{shot.lens.height}, another aspect.",
            "Is it the right image folder? Images may be scaled, not cropped, after colmap has seen them.",
        )


def _check_borrowed_camera(
    shot: Shot, image: NDArray[Any], rgb: NDArray[Any] | None, registered: bool, root: Path
) -> None:
    """A thermal image without a camera of its own has to show signs that it shows what the RGB image shows."""
    height, width = image.shape[:2]
    same_size = rgb is not None and rgb.shape[:2] == image.shape[:2]
    if same_size or (shot.lens.fits(width, height) and (registered or rgb is None)):
        return
    raise UserError(
        f"{shot.path.relative_to(root)} is {width}x{height}"
        + ("" if rgb is None else f", its RGB image {rgb.shape[1]}x{rgb.shape[0]},")
        + " and no thermal camera is in the model or its rig.",
        "If the thermal images are registered to the RGB ones: --thermal.aligned. "
        "Else register them in the COLMAP model (colmap rig_configurator).",
    )


def _view(
    modality: Modality, shot: Shot, image: NDArray[Any], celsius: NDArray[np.float32] | None, data_factor: int
) -> View:
    height, width = image.shape[:2]
    ideal = rectification(shot.lens, width, height)
    camera = shrunk(ideal.camera, data_factor)
    if min(camera.width, camera.height) < LEAST_SIDE:
        raise UserError(
            f"{shot.path.name} has {camera.width}x{camera.height} px with --data-factor {data_factor}; "
            f"images must be at least {LEAST_SIDE} px wide and high.",
            "Give a smaller --data-factor.",
        )
    channels = image.shape[2]
    image = resize(ideal.apply(image), camera.width, camera.height).reshape(camera.height, camera.width, channels)
    if celsius is not None:
        celsius = resize(ideal.apply(celsius), camera.width, camera.height)
    return View(modality, shot.path.stem, shot.path, camera, shot.viewmat, image, celsius)


def _as_rgb(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit RGB of an RGB file: 16 bits are reduced, grey is repeated."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    image = require_8bit(path, image)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)
