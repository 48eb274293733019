"""A frame of a capture, of its files' pixels: each image held against its camera, rectified and shrunk."""

from collections.abc import Mapping
from pathlib import Path

from thermosplat.config import LensUse
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Frame, View
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.image_size import TrainedSize
from thermosplat.datasets.images.image_folders import shown_path
from thermosplat.datasets.images.pixel_meaning import SpectrumPixels
from thermosplat.datasets.large_captures import UnreadPixels
from thermosplat.datasets.lens import RENDERED, camera_through_lens, rectified_camera
from thermosplat.datasets.readouts import Readout
from thermosplat.datasets.stored_pixels import seen_by
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig, label

LEAST_SIDE = 6
"""Least width and height of an image [px]: SSIM's window of 11 px is reflected by 5 at the borders (ssim.py)."""
LONGEST_RESAMPLED = 16_000
"""Most pixels of a side that is undistorted: OpenCV resamples to 32,766, and COLMAP's pinhole image has up to twice
the side."""


def assembled_frame(
    files: FrameFiles,
    pixels: Mapping[str, SpectrumPixels | UnreadPixels | None],
    lines: Mapping[str, Readout | None],
    listing: Listing,
    root: Path,
    size: TrainedSize,
    spectra: Mapping[str, SpectrumConfig],
    lens: LensUse,
) -> Frame:
    """A frame from its files' pixels; without views where no file is of use.

    Args:
        files: Its files, with cameras in the scene's frame.
        pixels: By spectrum, what is in its files; None: there is none.
        lines: By spectrum, how lines were read out one after the other; None: all at once.
        listing: The capture's, root its folder.
        root: As of ``assemble``, as what follows.

    Raises:
        UserError: An image does not fit its camera, or is too small or too large.
    """
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
