"""Image files that share the cameras of a COLMAP model's images."""

from collections.abc import Sequence
from pathlib import Path

from thermosplat.datasets.colmap_model import RegisteredImage
from thermosplat.datasets.frame_files import FrameFiles, Shot
from thermosplat.datasets.image_names import NamedImages, exposures, files_in, frame_names, stated_split


def named_images(images: Sequence[RegisteredImage]) -> NamedImages[RegisteredImage]:
    """Registered images, to be found by the names of files, or by bare file stem where that is unambiguous.

    RGBT-Scenes needs the second: its model may name images of a folder that no longer exists.
    """
    named = [(image.name, image) for image in images]
    return NamedImages("the COLMAP model", named, same_files=True, by_stem=True)


def frames_with_borrowed_cameras(
    rgb_folder: Path, thermal_folder: Path, raw_folder: Path, images: Sequence[RegisteredImage]
) -> tuple[list[FrameFiles], list[str]]:
    """Frames whose RGB and thermal images share the pose and camera of one registered image.

    Args:
        rgb_folder: RGB images; may be absent.
        thermal_folder: Thermal images with the same stems; may be absent.
        raw_folder: Radiometric files with the same stems; may be absent.
        images: The registered images.

    Returns:
        The frames, and notes on images without a pose and poses without an image.

    Raises:
        UserError: Several images have one stem, and nothing tells which of them belong together.
    """
    rgb, thermal, raw = (files_in(folder) for folder in (rgb_folder, thermal_folder, raw_folder))
    if not thermal:
        thermal = raw
    registered = named_images(images)
    found, without_pose = [], []
    for exposure in exposures(rgb, thermal):
        name = registered.find(exposure.name, thermal if exposure.rgb is None else rgb)
        if name is None:
            without_pose.append((thermal if exposure.rgb is None else rgb)[exposure.name])
        else:
            found.append((exposure, registered[name]))
    frames = []
    called = frame_names([exposure.name for exposure, _ in found], rgb.where if rgb else thermal.where)
    for (exposure, image), frame in zip(found, called, strict=True):
        seen = heat = None
        if exposure.rgb is not None:
            seen = Shot(rgb[exposure.rgb], image.lens, image.viewmat)
        if exposure.thermal is not None:
            values = raw.find(exposure.thermal, thermal)
            path = None if values is None else raw[values]
            heat = Shot(thermal[exposure.thermal], image.lens, image.viewmat, path)
        stated = [stated_split(name) for name in (exposure.rgb, exposure.thermal) if name is not None]
        frames.append(FrameFiles(frame, seen, heat, next(filter(None, stated), None)))
    return frames, registration_notes(without_pose, len(registered) - len({image.name for _, image in found}))


def registration_notes(without_pose: Sequence[Path], without_file: int) -> list[str]:
    """Say what was left out because file and model do not meet."""
    notes = []
    if without_pose:
        names = f"first: {without_pose[0].name}"
        notes.append(f"{len(without_pose)} images are not in the COLMAP model and were left out ({names}).")
    if without_file:
        notes.append(f"{without_file} images of the COLMAP model have no file and were left out.")
    return notes
