"""From a listing of files to a capture in memory: read, interpret, rectify, shrink, divide."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.cameras import Camera
from thermosplat.config import ThermalConfig
from thermosplat.datasets.capture import Capture, Frame, Modality, View
from thermosplat.datasets.capture_palette import choose_palette
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.image_files import read_images, resize
from thermosplat.datasets.lens import rectification, shrunk
from thermosplat.datasets.msx import msx_note
from thermosplat.datasets.splits import divide, hold_out_mask
from thermosplat.datasets.temperature_units import RadiometricStatement, read_statement
from thermosplat.datasets.thermal_images import ThermalFile, ThermalReading, interpret, is_radiometric
from thermosplat.errors import UserError


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
    if data_factor < 1:
        raise UserError(f"--data-factor must be at least 1, got {data_factor}.")
    frames = sorted(listing.frames, key=lambda frame: frame.name)
    if not frames:
        raise UserError(f"No image of {root} has a camera in its model.", "Are images and model of the same capture?")
    mask = hold_out_mask(frames, test_every)
    rgb_images = _read_each([frame.rgb for frame in frames])
    thermal_files = _read_thermal(frames)
    reading = _interpret(root, thermal_files, listing, thermal)
    views: list[Frame] = []
    for index, frame in enumerate(frames):
        rgb_view = thermal_view = None
        image = rgb_images[index]
        if frame.rgb is not None and image is not None:
            _check_size(frame.rgb, image, root)
            rgb_view = _view("rgb", frame.rgb, _as_rgb(frame.rgb.path, image), None, data_factor)
        pixels = None if reading is None else reading.pixels[index]
        if frame.thermal is not None and pixels is not None:
            _check_thermal_camera(frame, pixels.image, image, listing, thermal, root)
            thermal_view = _view("thermal", frame.thermal, pixels.image, pixels.celsius, data_factor)
        views.append(Frame(frame.name, rgb_view, thermal_view))
    train, test = divide(views, mask)
    notes = [*listing.notes, *_pairing_notes(views), *([] if reading is None else reading.notes)]
    notes += _distortion_note(frames)
    notes += msx_note(
        [(image, file.display) for image, file in zip(rgb_images, thermal_files, strict=True) if file is not None]
    )
    scale = None if reading is None else reading.scale
    return Capture(name, root, listing.layout, train, test, listing.points, listing.point_colors, scale, tuple(notes))


def _read_each(shots: Sequence[Shot | None]) -> list[NDArray[Any] | None]:
    """Images of the shots there are."""
    images = iter(read_images([shot.path for shot in shots if shot is not None]))
    return [None if shot is None else next(images) for shot in shots]


def _read_thermal(frames: Sequence[FrameFiles]) -> list[ThermalFile | None]:
    """Thermal files of each frame: the displayable image, the radiometric values, or both."""
    shown = _read_each([frame.thermal for frame in frames])
    raw_paths = [
        frame.thermal.raw if frame.thermal is not None and frame.thermal.raw != frame.thermal.path else None
        for frame in frames
    ]
    raws = iter(read_images([path for path in raw_paths if path is not None]))
    files: list[ThermalFile | None] = []
    for frame, image, raw_path in zip(frames, shown, raw_paths, strict=True):
        beside = None if raw_path is None else next(raws)
        if frame.thermal is None or image is None:
            files.append(None)
            continue
        if beside is not None and not is_radiometric(beside):
            raise UserError(
                f"{raw_path} is an 8-bit image; radiometric values are 16-bit or floating-point with one channel."
            )
        path = frame.thermal.path
        if is_radiometric(image):
            files.append(
                ThermalFile(path, None, image, path) if beside is None else ThermalFile(path, None, beside, raw_path)
            )
        else:
            files.append(ThermalFile(path, _as_8bit(path, image), beside, raw_path))
    return files


def _interpret(
    root: Path, files: Sequence[ThermalFile | None], listing: Listing, config: ThermalConfig
) -> ThermalReading | None:
    """`interpret` for the frames that have a thermal file; None if none has."""
    present = [file for file in files if file is not None]
    if not present:
        return None
    statement = RadiometricStatement()
    for folder in ("thermal_raw", "thermal"):
        if (root / folder / "units.json").is_file():
            statement = read_statement(root / folder / "units.json")
            break
    palette = choose_palette(root, config, [file.path for file in present])
    reading = interpret(present, config, palette=palette, statement=statement, grey_range=listing.celsius_range)
    pixels = iter(reading.pixels)
    return ThermalReading(reading.scale, tuple(None if file is None else next(pixels) for file in files), reading.notes)


def _check_size(shot: Shot, image: NDArray[Any], root: Path) -> None:
    height, width = image.shape[:2]
    if not shot.lens.fits(width, height):
        raise UserError(
            f"{shot.path.relative_to(root)} is {width}x{height} but its camera was calibrated at "
            f"{shot.lens.width}x{shot.lens.height}, another aspect.",
            "Is it the right image folder? Images may be scaled, not cropped, after colmap has seen them.",
        )


def _check_thermal_camera(
    frame: FrameFiles,
    image: NDArray[Any],
    rgb: NDArray[Any] | None,
    listing: Listing,
    config: ThermalConfig,
    root: Path,
) -> None:
    """A thermal image needs a camera of its own, or signs that it shows what the RGB image shows."""
    shot = frame.thermal
    if shot is None or config.aligned:
        return
    if frame.thermal_has_camera:
        _check_size(shot, image, root)
        return
    height, width = image.shape[:2]
    same_size = rgb is not None and rgb.shape[:2] == image.shape[:2]
    if same_size or (shot.lens.fits(width, height) and (listing.registered or rgb is None)):
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
    camera: Camera = shrunk(ideal.camera, data_factor)
    channels = image.shape[2]
    image = resize(ideal.apply(image), camera.width, camera.height).reshape(camera.height, camera.width, channels)
    if celsius is not None:
        celsius = resize(ideal.apply(celsius), camera.width, camera.height)
    return View(modality, shot.path.stem, shot.path, camera, shot.viewmat, image, celsius)


def _as_8bit(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.dtype != np.uint8:
        raise UserError(
            f"{path} has {image.dtype} colour; 8-bit colour or one-channel radiometric images are expected."
        )
    return image


def _as_rgb(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit RGB of an RGB file: 16 bits are reduced, grey is repeated."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    image = _as_8bit(path, image)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)


def _pairing_notes(frames: Sequence[Frame]) -> list[str]:
    """Say how many frames lack a partner, where some have one."""
    notes = []
    if any(frame.rgb is not None for frame in frames) and any(frame.thermal is not None for frame in frames):
        for lacking, present in (("thermal", "RGB"), ("RGB", "thermal")):
            lone = [frame for frame in frames if (frame.thermal if lacking == "thermal" else frame.rgb) is None]
            if lone:
                total = sum((frame.rgb if present == "RGB" else frame.thermal) is not None for frame in frames)
                notes.append(
                    f"{len(lone)} of {total} {present} images have no {lacking} partner (first: {lone[0].name}); "
                    f"they are trained as {present} alone. Pairs are matched by file stem."
                )
    return notes


def _distortion_note(frames: Sequence[FrameFiles]) -> list[str]:
    models = {
        shot.lens.model
        for frame in frames
        for shot in (frame.rgb, frame.thermal)
        if shot is not None and shot.lens.distorted
    }
    if not models:
        return []
    return [f"Images of {' and '.join(sorted(models))} cameras were undistorted to pinhole images in memory."]
