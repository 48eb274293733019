"""A COLMAP model of two cameras: the thermal images are registered themselves, with their own intrinsics and poses.

The model's image names say which is which: rgb/0001.png and thermal/0001.png, below the capture's folder or its images/
(COLMAP's arrangement for rigs). Images of one rig frame are one exposure; without a rig, images of one stem are.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from thermosplat.datasets.colmap_images import SPLIT_FOLDERS, files_by_key, frame_name, registration_notes, stem_key
from thermosplat.datasets.colmap_model import ColmapModel, RegisteredImage
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot, Split
from thermosplat.datasets.image_files import list_images


def has_thermal_cameras(model: ColmapModel) -> bool:
    """Some registered images are thermal by their folder, some are not."""
    return len({image.thermal for image in model.images}) == 2


def list_colmap_rig(root: Path, model: ColmapModel) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        root: The capture's folder.
        model: Its COLMAP model.
    """
    raw = files_by_key(root / "thermal_raw")
    frames: list[FrameFiles] = []
    used: set[Path] = set()
    without_file = 0
    for exposure in _exposures(model.images):
        shots: dict[bool, Shot] = {}
        names: dict[bool, str] = {}
        split: Split | None = None
        for image in exposure:
            path = _find_file(root, image.name)
            if path is None:
                without_file += 1
                continue
            values = raw.get(stem_key(image.name)) if image.thermal else None
            shots[image.thermal] = Shot(path, image.lens, image.viewmat, None if values is None else values[0])
            names[image.thermal] = stem_key(image.name)
            split = split or next((s for s in SPLIT_FOLDERS if s in path.parent.parts[len(root.parts) :]), None)
        used.update(shot.path for shot in shots.values())
        if shots:
            name = names.get(False) or names[True]
            frames.append(
                FrameFiles(frame_name(name), shots.get(False), shots.get(True), split, thermal_has_camera=True)
            )
    folders = (root / "images", root / "rgb", root / "thermal")
    unregistered = [path for folder in folders for path in list_images(folder, recursive=True) if path not in used]
    return Listing(
        "colmap-rig",
        tuple(frames),
        model.points,
        model.point_colors,
        notes=tuple(registration_notes(unregistered, without_file)),
    )


def _exposures(images: Sequence[RegisteredImage]) -> list[list[RegisteredImage]]:
    """Images taken together, at most one of each modality: by rig frame if rigs couple the modalities, else by stem."""
    by_frame = _group(images, [image.frame_id for image in images])
    coupled = any(len({image.thermal for image in group}) == 2 for group in by_frame)
    groups = by_frame if coupled else _group(images, [stem_key(image.name) for image in images])
    exposures = []
    for group in groups:
        if len({image.thermal for image in group}) == len(group):
            exposures.append(group)
        else:  # several cameras of one modality: pair within the rig frame by stem, the rest stand alone
            exposures += _group(group, [stem_key(image.name) for image in group])
    return exposures


def _group(images: Sequence[RegisteredImage], keys: Iterable[object]) -> list[list[RegisteredImage]]:
    groups: dict[object, list[RegisteredImage]] = defaultdict(list)
    for image, key in zip(images, keys, strict=True):
        groups[key].append(image)
    return list(groups.values())


def _find_file(root: Path, name: PurePosixPath) -> Path | None:
    """The file of a registered image: below images/ or the capture's folder, perhaps inside train/ or test/."""
    for base in (root / "images", root):
        for folder in ("", *SPLIT_FOLDERS):
            path = base / name.parent / folder / name.name
            if path.is_file():
                return path
    return None
