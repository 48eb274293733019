"""From a listing of files to a capture in memory: read, interpret, rectify, shrink, divide."""

import os
from collections.abc import Mapping, Sequence
from itertools import compress
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.capture_notes import distortion_notes, pairing_notes
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.images.image_files import resize
from thermosplat.datasets.images.image_folders import shown_path
from thermosplat.datasets.images.jpeg_warnings import check_jpegs
from thermosplat.datasets.images.msx import msx_notes
from thermosplat.datasets.images.spectrum_files import read_spectrum
from thermosplat.datasets.images.spectrum_images import SpectrumPixels, SpectrumReading
from thermosplat.datasets.lens import rectification, shrunk
from thermosplat.datasets.plausible_cameras import check_camera, outlying_notes
from thermosplat.datasets.splits import divide, hold_out_mask
from thermosplat.errors import UserError
from thermosplat.spectra import CELSIUS, SpectrumConfig, label

LEAST_SIDE = 6
"""Least width and height of an image [px]: SSIM's window of 11 px is reflected by 5 at the borders (ssim.py)."""
LONGEST_RESAMPLED = 16_000
"""Most pixels of a side that is undistorted: OpenCV resamples to 32,766, and COLMAP's pinhole image has up to twice
the side."""


def assemble(
    root: Path,
    name: str,
    listing: Listing,
    *,
    data_factor: int,
    test_every: int,
    spectra: Mapping[str, SpectrumConfig],
) -> Capture:
    """Read all images of a listing.

    Args:
        root: The capture's folder.
        name: The capture's name.
        listing: Its files, cameras and points.
        data_factor: Divide the images' sides by this.
        test_every: Period of the hold-out rule, where the folders do not divide the frames.
        spectra: The spectra, and how the images of each are read.

    Raises:
        UserError: Files are unreadable, of the wrong size, or not what `spectra` asks for.
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
    for frame in frames:
        for shot in frame.shots.values():
            check_camera(shot, root)
    _check_files_once(frames, root)
    mask = hold_out_mask(frames, test_every)
    readings = {
        spectrum: reading
        for spectrum, settings in spectra.items()
        if (reading := read_spectrum(root, spectrum, settings, frames, listing)) is not None
    }
    check_jpegs([path for frame in frames for shot in frame.shots.values() for path in (shot.path, shot.raw) if path])
    views = []
    for index, frame in enumerate(frames):
        pixels = {spectrum: reading.pixels[index] for spectrum, reading in readings.items()}
        views.append(_frame(frame, pixels, listing, root, data_factor, spectra))
    shown = [bool(frame.views) for frame in views]  # a lone file may be of no use
    views, mask = list(compress(views, shown)), list(compress(mask, shown))
    train, test = divide(views, mask)
    notes = [
        *listing.notes,
        *pairing_notes(views, spectra),
        *distortion_notes(frames),
        *outlying_notes(frames, root),
    ]
    for reading in readings.values():
        notes += reading.notes
    notes += _edge_notes(readings)
    usable = np.isfinite(listing.points).all(axis=-1)
    if not usable.all():
        notes.append(
            f"{np.sum(~usable):,} of {len(listing.points):,} starting points are not finite and were left out."
        )
    points, colors = listing.points[usable], listing.point_colors[usable]
    scales = {spectrum: reading.scale for spectrum, reading in readings.items()}
    return Capture(
        name,
        root,
        listing.layout,
        train,
        test,
        points,
        colors,
        scales,
        tuple(notes),
        listing.not_found,
        dict(spectra),
    )


def _edge_notes(readings: Mapping[str, SpectrumReading]) -> list[str]:
    """A warning where pseudo-coloured temperatures carry the edges of the photographs."""
    photographs = next((reading for reading in readings.values() if reading.scale.kind == "photograph"), None)
    if photographs is None:
        return []
    return [
        note
        for reading in readings.values()
        if reading.scale.kind == "color" and reading.scale.unit == CELSIUS
        for note in msx_notes(list(zip(photographs.displays, reading.displays, strict=True)))
    ]


def _frame(
    files: FrameFiles,
    pixels: Mapping[str, SpectrumPixels | None],
    listing: Listing,
    root: Path,
    data_factor: int,
    spectra: Mapping[str, SpectrumConfig],
) -> Frame:
    """A frame from its files' pixels."""
    views = {}
    lender = pixels[files.leading] if next(iter(spectra)) == files.leading else None
    for spectrum, exposure in pixels.items():
        if exposure is None:
            continue
        shot = files.shots[spectrum]
        if spectrum == next(iter(spectra)) or spectrum in files.own_cameras:
            _check_size(shot, exposure.image, root)
        elif not spectra[spectrum].aligned:
            _check_borrowed_camera(spectrum, files.leading, shot, exposure.image, lender, listing.registered, root)
        views[spectrum] = _view(spectrum, shot, exposure, data_factor)
    return Frame(files.name, views)


def _check_files_once(frames: Sequence[FrameFiles], root: Path) -> None:
    """A file of two frames could be trained on and held out, under two names."""
    owners: dict[str, tuple[Path, str]] = {}
    for frame in frames:
        for shot in frame.shots.values():
            path, owner = owners.setdefault(os.path.realpath(shot.path), (shot.path, frame.name))
            if owner != frame.name:
                raise UserError(
                    f"{shown_path(path, root)} and {shown_path(shot.path, root)} of two frames are one file.",
                    "Remove one of the two frames, or give it an image of its own.",
                )


def _check_size(shot: Shot, image: NDArray[Any], root: Path) -> None:
    height, width = image.shape[:2]
    if not shot.lens.fits(width, height):
        raise UserError(
            f"{shown_path(shot.path, root)} is {width}x{height} but its camera was calibrated at "
            f"{shot.lens.width}x{shot.lens.height}, another aspect.",
            "Is it the right image folder? Images may be scaled, not cropped, after colmap has seen them.",
        )


def _check_borrowed_camera(
    spectrum: str,
    leading: str,
    shot: Shot,
    image: NDArray[Any],
    lender: SpectrumPixels | None,
    registered: bool,
    root: Path,
) -> None:
    """An image without a camera of its own has to show signs that it shows what the image whose camera it has shows."""
    height, width = image.shape[:2]
    same_size = lender is not None and lender.image.shape[:2] == image.shape[:2]
    if same_size or (shot.lens.fits(width, height) and (registered or lender is None)):
        return
    raise UserError(
        f"{shown_path(shot.path, root)} is {width}x{height}"
        + ("" if lender is None else f", its {label(leading)} image {lender.image.shape[1]}x{lender.image.shape[0]},")
        + f" and no {label(spectrum)} camera is in the model or its rig.",
        f"If the {label(spectrum)} images are registered to the {label(leading)} ones: --{spectrum}.aligned. "
        "Else register them in the COLMAP model (colmap rig_configurator).",
    )


def _view(spectrum: str, shot: Shot, exposure: SpectrumPixels, data_factor: int) -> View:
    image, values = exposure.image, exposure.values
    height, width = image.shape[:2]
    if shot.lens.distorted and max(width, height) > LONGEST_RESAMPLED:
        raise UserError(
            f"{shot.path.name} is {width}x{height} and its lens distorted ({shot.lens.model}); images are undistorted "
            f"up to {LONGEST_RESAMPLED:,} px wide and high.",
            "Undistort them before (colmap image_undistorter), or shrink them.",
        )
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
    if values is not None:
        values = resize(ideal.apply(values), camera.width, camera.height)
    return View(spectrum, shot.path.stem, shot.path, camera, shot.viewmat, image, values)
