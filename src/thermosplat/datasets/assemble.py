"""From a listing of files to a capture in memory: read, interpret, rectify, shrink, divide."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import compress
from numbers import Integral
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.config import LensUse
from thermosplat.datasets.cameras import Camera, camera_center
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.capture_notes import distortion_notes, mask_notes, pairing_notes
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.image_size import TrainedSize
from thermosplat.datasets.images.image_folders import shown_path
from thermosplat.datasets.images.jpeg_warnings import check_jpegs
from thermosplat.datasets.images.msx import msx_notes
from thermosplat.datasets.images.pixel_meaning import SpectrumPixels
from thermosplat.datasets.images.spectrum_files import read_spectrum
from thermosplat.datasets.images.spectrum_images import SpectrumReading
from thermosplat.datasets.large_captures import (
    GIGABYTE,
    Headers,
    UnreadPixels,
    allowed_memory,
    read_sample,
    sampled_frames,
    unread_pixels,
)
from thermosplat.datasets.lens import RENDERED, camera_through_lens, rectified_camera
from thermosplat.datasets.pixel_cache import PixelCache
from thermosplat.datasets.placement import Placement
from thermosplat.datasets.plausible_cameras import check_camera, outlying_notes
from thermosplat.datasets.readouts import Readout
from thermosplat.datasets.shutter_file import readouts
from thermosplat.datasets.splits import divide, hold_out_mask
from thermosplat.datasets.stored_pixels import ImagesOnDisk, seen_by
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
    size: TrainedSize,
    test_every: int,
    spectra: Mapping[str, SpectrumConfig],
    lens: LensUse = "undistort",
    image_memory: float | None = None,
) -> Capture:
    """Read the images of a listing, or where they take more memory than they may, what is to be known of them.

    Args:
        root: The capture's folder.
        name: The capture's name.
        listing: Its files, cameras and points.
        size: What makes images smaller.
        test_every: Period of the hold-out rule, where the folders do not divide the frames.
        spectra: The spectra, and how the images of each are read.
        lens: "undistort" resamples distorted images to pinhole images; "direct" leaves them as they were taken.
        image_memory: As of ``TrainConfig``.

    Raises:
        UserError: Files are unreadable, of the wrong size, or not what `spectra` asks for.
    """
    if not isinstance(size.factor, Integral) or size.factor < 1:
        raise UserError(
            f"--data-factor (data_factor) must be a whole number of at least 1, got {size.factor!r}.",
            "1 keeps the images' size, 2 halves width and height.",
        )
    frames = _checked_frames(listing, root)
    mask = hold_out_mask(frames, test_every)
    placement = _placement(frames, listing)
    frames = [_placed(frame, placement) for frame in frames]
    read_by_line, shutter_notes = readouts(root, frames, placement)
    headers, memory = Headers(frames), allowed_memory(image_memory)
    taken = headers.taken_at_once(frames, size)
    if taken <= memory:
        on_disk, read = None, _read_all(root, frames, listing, spectra)
    else:
        on_disk = ImagesOnDisk(memory, PixelCache())
        read = _read_some(root, frames, listing, spectra, headers, on_disk.cache)
    views = []
    for index, frame in enumerate(frames):
        exposures = {spectrum: pixels[index] for spectrum, pixels in read.pixels.items()}
        lines = {spectrum: read_by_line.get((frame.name, spectrum)) for spectrum in exposures}
        views.append(_frame(frame, exposures, lines, listing, root, size, spectra, lens))
    shown = [bool(frame.views) for frame in views]  # a lone file may be of no use
    views, mask = list(compress(views, shown)), list(compress(mask, shown))
    train, test = divide(views, mask)
    with np.errstate(over="ignore"):  # what becomes infinite is left out
        points = placement.to_scene(listing.points).astype(np.float32)
    usable = np.isfinite(points).all(axis=-1)
    notes = [
        *listing.notes,
        *pairing_notes(views, spectra),
        *mask_notes(views, frames, root),
        *distortion_notes(frames, lens),
        *size.notes(headers.sizes(frames)),
        *shutter_notes,
        *outlying_notes(frames, root),
        *placement.note(),
        *(note for reading in read.readings.values() for note in reading.notes),
        *read.notes,
        *_edge_notes(read.readings),
        *([] if on_disk is None else [_on_disk_note(frames, taken, memory)]),
        *_point_notes(usable),
    ]
    return Capture(
        name,
        root,
        listing.layout,
        train,
        test,
        points[usable],
        listing.point_colors[usable],
        {spectrum: reading.scale for spectrum, reading in read.readings.items()},
        tuple(notes),
        listing.not_found,
        dict(spectra),
        on_disk,
        placement,
    )


def _placement(frames: Sequence[FrameFiles], listing: Listing) -> Placement:
    """Where the scene lies in the world of the listing's poses."""
    centers = np.array([camera_center(frame.shots[frame.leading].viewmat) for frame in frames])
    return Placement.of(centers, listing.points)


def _placed(frame: FrameFiles, placement: Placement) -> FrameFiles:
    """A frame with its poses in the scene's frame."""
    shots = {
        spectrum: replace(shot, viewmat=placement.viewmat_to_scene(shot.viewmat))
        for spectrum, shot in frame.shots.items()
    }
    return replace(frame, shots=shots)


def _checked_frames(listing: Listing, root: Path) -> list[FrameFiles]:
    """The frames of a listing by name, with cameras that can be; no file is in two of them."""
    frames = sorted(listing.frames, key=lambda frame: frame.name)
    if not frames:
        message = " ".join([f"No image of {root} has a camera in its model.", *listing.notes])
        raise UserError(message, "Are images and model of the same capture, under the same names?")
    for frame in frames:
        for shot in frame.shots.values():
            check_camera(shot, root)
    _check_files_once(frames, root)
    return frames


@dataclass(frozen=True, eq=False)
class _Read:
    """What is known of the images of a capture: readings by spectrum, and pixels of each frame, read or not."""

    readings: Mapping[str, SpectrumReading]
    pixels: Mapping[str, Sequence[SpectrumPixels | UnreadPixels | None]]
    notes: Sequence[str] = ()


def _read_all(
    root: Path, frames: Sequence[FrameFiles], listing: Listing, spectra: Mapping[str, SpectrumConfig]
) -> _Read:
    """All images, into memory."""
    readings = {}
    with ThreadPoolExecutor(1) as beside:
        jpegs = []
        for spectrum, settings in spectra.items():
            reading = read_spectrum(root, spectrum, settings, frames, listing)
            if reading is not None:
                readings[spectrum] = reading
                jpegs.append(beside.submit(check_jpegs, _files(frames, spectrum)))  # while the next spectrum is read
        for checked in jpegs:
            checked.result()
    return _Read(readings, {spectrum: reading.pixels for spectrum, reading in readings.items()})


def _read_some(
    root: Path,
    frames: Sequence[FrameFiles],
    listing: Listing,
    spectra: Mapping[str, SpectrumConfig],
    headers: Headers,
    cache: PixelCache,
) -> _Read:
    """Headers, and as many images as say what all are."""
    sample = sampled_frames(frames, spectra, headers)
    readings: dict[str, SpectrumReading] = {}
    pixels: dict[str, list[SpectrumPixels | UnreadPixels | None]] = {}
    notes: list[str] = []
    for name, spectrum in spectra.items():
        reading, remarks = read_sample(root, name, spectrum, frames, sample, headers, listing)
        if reading is None:
            continue
        check_jpegs(_files([frames[index] for index in sample], name))
        readings[name] = reading
        notes += remarks
        shots = [frame.shots.get(name) for frame in frames]
        pixels[name] = [
            None if shot is None else unread_pixels(shot, spectrum, reading.meaning, headers, cache) for shot in shots
        ]
    return _Read(readings, pixels, notes)


def _on_disk_note(frames: Sequence[FrameFiles], taken: int, memory: float) -> str:
    count = sum(len(frame.shots) for frame in frames)
    return (
        f"The {count:,} images take {taken / GIGABYTE:,.3g} GB of memory, more than --image-memory allows "
        f"({memory / GIGABYTE:.3g} GB): they stay on the disk and are read when they are needed."
    )


def _point_notes(usable: NDArray[np.bool_]) -> list[str]:
    if usable.all():
        return []
    return [f"{np.sum(~usable):,} of {len(usable):,} starting points are not finite and were left out."]


def _files(frames: Sequence[FrameFiles], spectrum: str) -> list[Path]:
    """The image files of one spectrum."""
    shots = [frame.shots[spectrum] for frame in frames if spectrum in frame.shots]
    return [path for shot in shots for path in shot.files]


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
    pixels: Mapping[str, SpectrumPixels | UnreadPixels | None],
    lines: Mapping[str, Readout | None],
    listing: Listing,
    root: Path,
    size: TrainedSize,
    spectra: Mapping[str, SpectrumConfig],
    lens: LensUse,
) -> Frame:
    """A frame from its files' pixels."""
    views = {}
    lender = pixels[files.leading] if next(iter(spectra)) == files.leading else None
    for spectrum, exposure in pixels.items():
        if exposure is None:
            continue
        shot = files.shots[spectrum]
        if spectrum == next(iter(spectra)) or spectrum in files.own_cameras:
            _check_size(shot, exposure.size, root)
        elif not spectra[spectrum].aligned:
            lent = None if lender is None else lender.size
            _check_borrowed_camera(spectrum, files.leading, shot, exposure.size, lent, listing.registered, root)
        views[spectrum] = _view(spectrum, shot, exposure, lines[spectrum], size, lens)
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


def _check_size(shot: Shot, size: tuple[int, int], root: Path) -> None:
    width, height = size
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
    size: tuple[int, int],
    lender: tuple[int, int] | None,
    registered: bool,
    root: Path,
) -> None:
    """An image without a camera of its own has to show signs that it shows what the image whose camera it has shows."""
    width, height = size
    if lender == size or (shot.lens.fits(width, height) and (registered or lender is None)):
        return
    raise UserError(
        f"{shown_path(shot.path, root)} is {width}x{height}"
        + ("" if lender is None else f", its {label(leading)} image {lender[0]}x{lender[1]},")
        + f" and no {label(spectrum)} camera is in the model or its rig.",
        f"If the {label(spectrum)} images are registered to the {label(leading)} ones: --{spectrum}.aligned. "
        "Else register them in the COLMAP model (colmap rig_configurator).",
    )


def _view(
    spectrum: str,
    shot: Shot,
    exposure: SpectrumPixels | UnreadPixels,
    readout: Readout | None,
    size: TrainedSize,
    lens: LensUse,
) -> View:
    width, height = exposure.size
    if lens == "direct":
        taken_by = _untouched_camera(shot, width, height)
    elif shot.lens.distorted and max(width, height) > LONGEST_RESAMPLED:
        raise UserError(
            f"{shot.path.name} is {width}x{height} and its lens distorted ({shot.lens.model}); images are undistorted "
            f"up to {LONGEST_RESAMPLED:,} px wide and high.",
            "Undistort them before (colmap image_undistorter), or shrink them.",
        )
    else:
        taken_by = rectified_camera(shot.lens, width, height)
    camera = size.shrunk(taken_by)
    if min(camera.width, camera.height) < LEAST_SIDE:
        raise UserError(
            f"{shot.path.name} has {camera.width}x{camera.height} px with --data-factor {size.factor} and --image-size "
            f"{size.longest}; images must be at least {LEAST_SIDE} px wide and high.",
            "Give a smaller --data-factor or a larger --image-size.",
        )
    about = spectrum, shot.path.stem, shot.path, camera, shot.viewmat
    straightened_from = None if lens == "direct" else shot.lens
    if readout is not None:
        if straightened_from is not None and straightened_from.distorted:
            readout = readout.undistorted(straightened_from, exposure.size, taken_by)
        readout = readout.resized(taken_by, camera)
    if isinstance(exposure, UnreadPixels):
        return View(*about, None, stored=exposure.seen_by(camera, straightened_from), readout=readout)
    pixels = seen_by(camera, straightened_from, exposure)
    return View(*about, pixels.image, pixels.values, pixels.mask, readout=readout)


def _untouched_camera(shot: Shot, width: int, height: int) -> Camera:
    """The camera of an image that stays as it was taken."""
    camera = camera_through_lens(shot.lens, width, height)
    if camera is None:
        raise UserError(
            f"The camera of {shot.path.name} is of the model {shot.lens.model}, which --lens direct does not know; it "
            f"knows {', '.join(model for models in RENDERED.values() for model in models)}.",
            "Leave --lens direct out: then images are undistorted.",
        )
    return camera
