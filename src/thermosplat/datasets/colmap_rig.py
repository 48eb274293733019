"""A COLMAP model of two cameras: the thermal images are registered themselves, with their own intrinsics and poses.

The model's image names say which is which: rgb/0001.png and thermal/0001.png, below the capture's folder or its images/
(COLMAP's arrangement for rigs). Images of one rig frame are one exposure; without a rig, images of one stem are.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from thermosplat.datasets.colmap_images import registration_notes
from thermosplat.datasets.colmap_model import ColmapModel, RegisteredImage
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot, Split
from thermosplat.datasets.image_files import list_images
from thermosplat.datasets.image_folders import image_folder, thermal_folder
from thermosplat.datasets.image_names import SPLIT_FOLDERS, NamedImages, exposures, files_in, frame_names
from thermosplat.errors import UserError

_MODEL = "the COLMAP model"


def has_thermal_cameras(model: ColmapModel) -> bool:
    """Some registered images are thermal by their folder, some are not."""
    return len({image.thermal for image in model.images}) == 2


def list_colmap_rig(root: Path, model: ColmapModel) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        root: The capture's folder.
        model: Its COLMAP model.

    Raises:
        UserError: Several images have one stem, and nothing tells which of them belong together.
    """
    raw, thermal = files_in(root / "thermal_raw"), _named(model.images)[1]
    frames: list[FrameFiles] = []
    names: list[PurePosixPath] = []
    used: set[Path] = set()
    without_file = 0
    for exposure in _exposures(model.images):
        shots: dict[bool, Shot] = {}
        split: Split | None = None
        for image in exposure:
            path = _find_file(root, image.name)
            if path is None:
                without_file += 1
                continue
            values = raw.find(image.name, thermal) if image.thermal else None
            if not shots:
                names.append(image.name)
            shots[image.thermal] = Shot(path, image.lens, image.viewmat, None if values is None else raw[values])
            folders = [part.lower() for part in path.parent.parts[len(root.parts) :]]
            split = split or next((s for s in SPLIT_FOLDERS if s in folders), None)
        used.update(shot.path.resolve() for shot in shots.values())  # one file may be below several folders by links
        if shots:
            frames.append(FrameFiles("", shots.get(False), shots.get(True), split, thermal_has_camera=True))
    searched = (image_folder(root, "images"), image_folder(root, "rgb"), thermal_folder(root))
    called = frame_names(names, _MODEL)
    files = [path for folder in searched for path in list_images(folder, recursive=True)]
    unregistered = [path for path in files if path.resolve() not in used]
    return Listing(
        "colmap-rig",
        tuple(replace(frame, name=name) for frame, name in zip(frames, called, strict=True)),
        model.points,
        model.point_colors,
        notes=tuple(registration_notes(unregistered, without_file)),
    )


def _exposures(images: Sequence[RegisteredImage]) -> list[list[RegisteredImage]]:
    """Images taken together, RGB first, one of a modality: by rig frame if rigs couple modalities, else by name."""
    by_frame = _by_frame(images)
    coupled = any(len({image.thermal for image in group}) == 2 for group in by_frame)
    together = []
    for group in by_frame if coupled else [images]:
        if coupled and len({image.thermal for image in group}) == len(group):
            together.append(sorted(group, key=lambda image: image.thermal))
            continue
        # several of one modality: pair within the rig frame by name, the rest stand alone
        rgb, thermal = _named(group)
        for exposure in exposures(rgb, thermal):
            seen = [] if exposure.rgb is None else [rgb[exposure.rgb]]
            together.append(seen + ([] if exposure.thermal is None else [thermal[exposure.thermal]]))
    return together


def _named(images: Sequence[RegisteredImage]) -> tuple[NamedImages[RegisteredImage], NamedImages[RegisteredImage]]:
    """RGB and thermal images by name."""
    rgb, thermal = ([(i.name, i) for i in images if i.thermal is wanted] for wanted in (False, True))
    return NamedImages(_MODEL, rgb), NamedImages(_MODEL, thermal)


def _by_frame(images: Sequence[RegisteredImage]) -> list[list[RegisteredImage]]:
    groups: dict[int, list[RegisteredImage]] = defaultdict(list)
    for image in images:
        groups[image.frame_id].append(image)
    return list(groups.values())


def _find_file(root: Path, name: PurePosixPath) -> Path | None:
    """The file of a registered image: below images/ or the capture's folder, perhaps inside train/ or test/."""
    for base in (image_folder(root, "images"), root):
        path, *divided = (base / name.parent / folder / name.name for folder in ("", *SPLIT_FOLDERS))
        if path.is_file():
            return path
        found = [path for path in divided if path.is_file()]
        if len(found) > 1:
            first, second = (path.relative_to(root) for path in found)
            raise UserError(
                f"{first} and {second} of {root} have one stem, and {name} of {_MODEL} may be either.",
                "Remove the one that is not in the model.",
            )
        if found:
            return found[0]
    return None
