"""A COLMAP model of several cameras: images of each spectrum are registered, with intrinsics and poses of their own.

The model's image names say which is which: rgb/0001.png and thermal/0001.png, below the capture's folder or its images/
(COLMAP's arrangement for rigs). Images of one rig frame are one exposure; without a rig, images of one stem are. Images
of a spectrum that is not in the model have the stems of the first ones and share their camera.
"""

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from thermosplat.datasets.colmap.model import ColmapModel, RegisteredImage
from thermosplat.datasets.colmap.shared_cameras import registration_notes
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot, Split
from thermosplat.datasets.images.image_files import list_images
from thermosplat.datasets.images.image_folders import image_folder, spectrum_folder, values_folder
from thermosplat.datasets.images.image_names import (
    SPLIT_FOLDERS,
    NamedImages,
    exposures,
    files_in,
    folders_of,
    frame_names,
)
from thermosplat.datasets.images.masks import masks_by_spectrum
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig, folder_names, label

_MODEL = "the COLMAP model"


def registered_spectra(model: ColmapModel, spectra: Mapping[str, SpectrumConfig]) -> set[str]:
    """The spectra whose images are in a model, by their folders; several make it a rig."""
    return set(_spectra_of(model.images, spectra))


def list_colmap_rig(root: Path, model: ColmapModel, spectra: Mapping[str, SpectrumConfig]) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Raises:
        UserError: Several images have one stem, and nothing tells which of them belong together.
    """
    named, skipped = _named(model.images, spectra), folders_of(spectra)
    values = {
        name: files_in(values_folder(root, name, spectrum), folders=skipped) for name, spectrum in spectra.items()
    }
    masks = masks_by_spectrum(root, spectra)
    others = {
        name: files_in(spectrum_folder(root, name, spectrum), spectrum.source, folders=skipped) or values[name]
        for name, spectrum in spectra.items()
        if not named[name]
    }
    frames: list[FrameFiles] = []
    names: list[PurePosixPath] = []
    used: set[Path] = set()
    without_file = 0
    for exposure in _exposures(model.images, spectra):
        shots: dict[str, Shot] = {}
        called = None
        split: Split | None = None
        for spectrum, image in exposure.items():
            path = _find_file(root, image.name)
            if path is None:
                without_file += 1
                continue
            called = called or (spectrum, image.name)
            raw, mask = (found[spectrum].get(image.name, named[spectrum]) for found in (values, masks))
            shots[spectrum] = Shot(path, image.lens, image.viewmat, raw, mask)
            folders = [part.lower() for part in path.parent.parts[len(root.parts) :]]
            split = split or next((s for s in SPLIT_FOLDERS if s in folders), None)
        used.update(shot.path.resolve() for shot in shots.values())  # one file may be below several folders by links
        if called is not None:
            own = frozenset(shots)
            for spectrum, files in others.items():
                if (other := files.find(called[1], named[called[0]])) is not None:
                    lead = shots[called[0]]
                    raw, mask = (found[spectrum].get(other, files) for found in (values, masks))
                    shots[spectrum] = Shot(files[other], lead.lens, lead.viewmat, raw, mask)
            names.append(called[1])
            ordered = {spectrum: shots[spectrum] for spectrum in spectra if spectrum in shots}
            frames.append(FrameFiles("", ordered, split, own_cameras=own))
    in_model = [name for name in spectra if named[name]]
    searched = [image_folder(root, "images"), *(spectrum_folder(root, name, spectra[name]) for name in in_model)]
    files_below = [path for folder in dict.fromkeys(searched) for path in list_images(folder, recursive=True)]
    unregistered = [path for path in files_below if path.resolve() not in used]
    names_of_frames = frame_names(names, _MODEL, skipped)
    return Listing(
        "colmap-rig",
        tuple(replace(frame, name=name) for frame, name in zip(frames, names_of_frames, strict=True)),
        model.points,
        model.point_colors,
        registered=False,
        notes=(*registration_notes(unregistered, without_file), *_strangers(model.images, spectra)),
    )


def _strangers(images: Sequence[RegisteredImage], spectra: Mapping[str, SpectrumConfig]) -> list[str]:
    """A note on images that are of the first spectrum only because their folder is none's, where others have one."""
    leading = next(iter(spectra))
    taken = [image for name, image in zip(_spectra_of(images, spectra), images) if name == leading]
    lone = [image for image in taken if not _folders_above(image) & _folders(leading, spectra)]
    if not lone or len(lone) == len(taken):
        return []
    return [
        f"{len(lone)} images of the COLMAP model are taken for {label(leading)} images, although they do not lie in "
        f"{folder_names(leading, spectra[leading])[0]}/ (first: {lone[0].name}). Are they of a further spectrum? "
        "Then define it in a configuration file (docs/spectra.md)."
    ]


def _exposures(
    images: Sequence[RegisteredImage], spectra: Mapping[str, SpectrumConfig]
) -> list[dict[str, RegisteredImage]]:
    """Images taken together, one per spectrum: by rig frame if rigs couple spectra, else by name."""
    by_frame = _by_frame(images)
    coupled = any(len(set(_spectra_of(group, spectra))) > 1 for group in by_frame)
    together = []
    for group in by_frame if coupled else [images]:
        of_spectrum = dict(zip(_spectra_of(group, spectra), group))
        if coupled and len(of_spectrum) == len(group):
            together.append({name: of_spectrum[name] for name in spectra if name in of_spectrum})
            continue
        # several of one spectrum: pair within the rig frame by name, the rest stand alone
        named = _named(group, spectra)
        together += [
            {spectrum: named[spectrum][name] for spectrum, name in exposure.names.items()}
            for exposure in exposures(named)
        ]
    return together


def _spectra_of(images: Sequence[RegisteredImage], spectra: Mapping[str, SpectrumConfig]) -> list[str]:
    """The spectrum of each image: the one whose folder it lies below, else the first."""
    leading, *others = spectra
    return [
        next(
            (name for name in others if _folders_above(image) & _folders(name, spectra)),
            leading,
        )
        for image in images
    ]


def _folders_above(image: RegisteredImage) -> set[str]:
    return {part.lower() for part in image.name.parts[:-1]}


def _folders(name: str, spectra: Mapping[str, SpectrumConfig]) -> set[str]:
    return set(folder_names(name, spectra[name]))


def _named(
    images: Sequence[RegisteredImage], spectra: Mapping[str, SpectrumConfig]
) -> dict[str, NamedImages[RegisteredImage]]:
    """Images by spectrum and name."""
    every, skipped = list(zip(_spectra_of(images, spectra), images)), folders_of(spectra)
    return {
        name: NamedImages(
            _MODEL, [(image.name, image) for spectrum, image in every if spectrum == name], folders=skipped
        )
        for name in spectra
    }


def _by_frame(images: Sequence[RegisteredImage]) -> list[list[RegisteredImage]]:
    groups: dict[int, list[RegisteredImage]] = defaultdict(list)
    for image in images:
        groups[image.frame_id].append(image)
    return list(groups.values())


def _find_file(root: Path, name: PurePosixPath) -> Path | None:
    """The file of a registered image: below images/ or the capture's folder, perhaps inside train/ or test/."""
    for base in (image_folder(root, "images"), root):
        path, *divided = (base / name.parent / folder / name.name for folder in ("", *SPLIT_FOLDERS))
        if os.path.isfile(path):  # False also for a name that is too long
            return path
        found = [path for path in divided if os.path.isfile(path)]
        if len(found) > 1:
            first, second = (path.relative_to(root) for path in found)
            raise UserError(
                f"{first} and {second} of {root} have one stem, and {name} of {_MODEL} may be either.",
                "Remove the one that is not in the model.",
            )
        if found:
            return found[0]
    return None
