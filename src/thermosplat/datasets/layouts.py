"""Which layout a folder has, by looking at it."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from thermosplat.datasets.colmap.model import (
    check_reconstruction,
    find_model,
    missing_model,
    read_model,
    with_points,
)
from thermosplat.datasets.colmap.rig import list_colmap_rig, registered_spectra
from thermosplat.datasets.colmap.shared_cameras import list_shared_cameras
from thermosplat.datasets.frame_files import Listing
from thermosplat.datasets.images.image_files import list_images
from thermosplat.datasets.images.image_folders import (
    describe_folder,
    image_folder,
    spectrum_folder,
    values_folder,
)
from thermosplat.datasets.images.unread_formats import unread_note
from thermosplat.datasets.transforms.reader import find_transforms, list_transforms
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig, folder_names


def list_capture(root: Path, spectra: Mapping[str, SpectrumConfig]) -> Listing:
    """Tell the layout of a folder and list its files.

    rgb/ with a COLMAP model is RGBT-Scenes; a transforms file is ThermoScenes or nerfstudio, even if a model lies
    beside it (ThermoScenes ships one of the unprocessed images); images/ or thermal/ with a model is a COLMAP project.
    A model that has images of several spectra is a rig, whatever the folders.

    Raises:
        UserError: No layout fits.
    """
    listing = _list_layout(root, spectra)
    folders = {folder for name, settings in spectra.items() for folder in folder_names(name, settings)}
    inside = [path for path in root.iterdir() if path.name.lower().removesuffix("_raw") in {*folders, "images"}]
    unread = [unread_note(folder) for folder in sorted(inside) if folder.is_dir()]
    return replace(listing, notes=(*listing.notes, *filter(None, unread)))


def _list_layout(root: Path, spectra: Mapping[str, SpectrumConfig]) -> Listing:
    model_folder = find_model(root)
    transforms = find_transforms(root)
    leading, *others = spectra
    usual, *further = folder_names(leading, spectra[leading])
    first, images = image_folder(root, usual), image_folder(root, "images", further)
    if transforms is not None and not (model_folder is not None and first.is_dir()):
        return list_transforms(root, transforms, model_folder, spectra)
    folders = [first, images, *(spectrum_folder(root, name, spectra[name]) for name in others)]
    present = [folder for folder in dict.fromkeys(folders) if folder.is_dir()]
    values = [folder for name in others if (folder := values_folder(root, name, spectra[name])).is_dir()]
    if not present and not values:
        raise _unknown_layout(root, spectra)
    if model_folder is None:
        raise missing_model(root)
    model = read_model(model_folder)
    rig = len(registered_spectra(model, spectra)) > 1
    counted = present if rig else [*present, *values][:1]
    check_reconstruction(model, sum(len(list_images(folder, recursive=True)) for folder in counted), root)
    model, notes = with_points(model)
    if rig:
        listing = list_colmap_rig(root, model, spectra)
    else:
        published = first.is_dir()
        listing = list_shared_cameras(root, first if published else images, model, spectra, published=published)
    return replace(listing, notes=(*listing.notes, *notes))


def _unknown_layout(root: Path, spectra: Mapping[str, SpectrumConfig]) -> UserError:
    found = ", ".join(describe_folder(path) if path.is_dir() else path.name for path in sorted(root.iterdir())[:12])
    first, *others = (f"{folder_names(name, spectrum)[0]}/" for name, spectrum in spectra.items())
    return UserError(
        f"{root} is no capture of a known layout. Looked for {_in_words([first, *others])}, "
        f"{_in_words(['images/', *others])}, and transforms_thermal.json or transforms.json. "
        f"Found: {found or 'nothing'}.",
        "Give the folder that holds them; the layouts are in docs/data-layouts.md. The untouched files of two cameras "
        f"become a capture with thermosplat-prepare {shlex.quote(str(root))}",
    )


def _in_words(folders: Sequence[str]) -> str:
    """ "rgb/, nir/ and thermal/"."""
    return " and ".join(filter(None, (", ".join(folders[:-1]), folders[-1])))
