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
from thermosplat.datasets.assembled_frame import assembled_frame
from thermosplat.datasets.cameras import camera_center
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.capture_notes import distortion_notes, mask_notes, pairing_notes
from thermosplat.datasets.frame_files import FrameFiles, Listing
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
from thermosplat.datasets.pixel_cache import PixelCache
from thermosplat.datasets.placement import Placement
from thermosplat.datasets.plausible_cameras import check_camera, outlying_notes
from thermosplat.datasets.shutter_file import readouts
from thermosplat.datasets.splits import divide, hold_out_mask
from thermosplat.datasets.stored_pixels import ImagesOnDisk
from thermosplat.errors import UserError
from thermosplat.spectra import CELSIUS, STACKS, SpectrumConfig, label


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
        test_every: Period of the hold-out rule, where the folders do not divide the frames.
        lens: "undistort" resamples distorted images to pinhole images; "direct" leaves them as they were taken.

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
        _check_no_stacks(spectra, memory)
        on_disk = ImagesOnDisk(memory, PixelCache())
        read = _read_some(root, frames, listing, spectra, headers, on_disk.cache)
    views = []
    for index, frame in enumerate(frames):
        exposures = {spectrum: pixels[index] for spectrum, pixels in read.pixels.items()}
        lines = {spectrum: read_by_line.get((frame.name, spectrum)) for spectrum in exposures}
        views.append(assembled_frame(frame, exposures, lines, listing, root, size, spectra, lens))
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


def _check_no_stacks(spectra: Mapping[str, SpectrumConfig], memory: float) -> None:
    """Stacks have to be read at once: their basis is that of all."""
    for name, spectrum in spectra.items():
        if spectrum.source in STACKS:
            raise UserError(
                f"The images take more memory than {memory / GIGABYTE:.3g} GB, and {label(name)} ({spectrum.source}) "
                "cannot stay on the disk.",
                "Allow more (--image-memory), train on smaller images (--data-factor 2), or without "
                f"them: --without {name}.",
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
