"""Image files matched to the images of a COLMAP model, and grouped into exposures."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from thermosplat.datasets.colmap_model import THERMAL_FOLDERS, RegisteredImage
from thermosplat.datasets.frame_files import FrameFiles, Shot, Split
from thermosplat.datasets.image_files import list_images

SPLIT_FOLDERS: tuple[Split, ...] = ("train", "test")
RGB_FOLDERS = frozenset({"rgb", "images", "visible", "vis", "color"})
"""Folders that say nothing but "these are the RGB images"; left out where names are compared."""


def stem_key(name: PurePosixPath) -> str:
    """What identifies an image across folders: its path without modality folders, train/test and ending."""
    skipped = THERMAL_FOLDERS | RGB_FOLDERS | set(SPLIT_FOLDERS)
    folders = [part for part in name.parts[:-1] if part.lower() not in skipped]
    return "/".join([*folders, name.stem])


def frame_name(key: str) -> str:
    """A frame's name from its `stem_key`: without folders, since output files are named after it."""
    return key.replace("/", "_")


class StemIndex:
    """Look-up of images by `stem_key`, or by bare file stem where that is unambiguous.

    RGBT-Scenes needs the second: its model may name images of a folder that no longer exists.
    """

    def __init__(self, images: Iterable[RegisteredImage]) -> None:
        self._images = list(images)
        self._by_key = {stem_key(image.name): image for image in self._images}
        stems = Counter(image.name.stem for image in self._images)
        self._by_stem = {image.name.stem: image for image in self._images if stems[image.name.stem] == 1}

    def find(self, name: PurePosixPath) -> RegisteredImage | None:
        """The registered image of a file, or None."""
        return self._by_key.get(stem_key(name)) or self._by_stem.get(name.stem)

    def __len__(self) -> int:
        return len(self._images)


def files_by_key(folder: Path) -> dict[str, tuple[Path, Split | None]]:
    """Image files below a folder by `stem_key`, with the split its train/ and test/ folders state."""
    found: dict[str, tuple[Path, Split | None]] = {}
    for path in list_images(folder, recursive=True):
        relative = PurePosixPath(path.relative_to(folder).as_posix())
        split = next((split for split in SPLIT_FOLDERS if relative.parts[0] == split and len(relative.parts) > 1), None)
        found[stem_key(relative)] = (path, split)
    return found


def frames_with_borrowed_cameras(
    rgb_folder: Path, thermal_folder: Path, raw_folder: Path, index: StemIndex
) -> tuple[list[FrameFiles], list[str]]:
    """Frames whose RGB and thermal images share the pose and camera of one registered image.

    Args:
        rgb_folder: RGB images; may be absent.
        thermal_folder: Thermal images with the same stems; may be absent.
        raw_folder: Radiometric files with the same stems; may be absent.
        index: The registered images.

    Returns:
        The frames, and notes on images without a pose and poses without an image.
    """
    rgb, thermal, raw = (files_by_key(folder) for folder in (rgb_folder, thermal_folder, raw_folder))
    if not thermal:
        thermal = raw
    frames: list[FrameFiles] = []
    without_pose: list[Path] = []
    used: set[str] = set()
    for key in sorted(rgb.keys() | thermal.keys()):
        path = (rgb.get(key) or thermal[key])[0]
        split = next((files[key][1] for files in (rgb, thermal) if key in files and files[key][1]), None)
        image = index.find(PurePosixPath(key))
        if image is None:
            without_pose.append(path)
            continue
        used.add(image.name.as_posix())
        heat = None
        if key in thermal:
            values = raw[key][0] if key in raw else None
            heat = Shot(thermal[key][0], image.lens, image.viewmat, values)
        seen = Shot(rgb[key][0], image.lens, image.viewmat) if key in rgb else None
        frames.append(FrameFiles(frame_name(key), seen, heat, split))
    return frames, registration_notes(without_pose, len(index) - len(used))


def registration_notes(without_pose: Sequence[Path], without_file: int) -> list[str]:
    """Say what was left out because file and model do not meet."""
    notes = []
    if without_pose:
        names = f"first: {without_pose[0].name}"
        notes.append(f"{len(without_pose)} images are not in the COLMAP model and were left out ({names}).")
    if without_file:
        notes.append(f"{without_file} images of the COLMAP model have no file and were left out.")
    return notes
