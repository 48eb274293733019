"""Which layout a folder has, by looking at it."""

from dataclasses import replace
from pathlib import Path

from thermosplat.datasets.colmap_folder import list_colmap_folder
from thermosplat.datasets.colmap_model import (
    check_reconstruction,
    describe_folder,
    find_model,
    missing_model,
    read_model,
    with_points,
)
from thermosplat.datasets.colmap_rig import has_thermal_cameras, list_colmap_rig
from thermosplat.datasets.frame_files import Listing
from thermosplat.datasets.image_files import list_images
from thermosplat.datasets.image_folders import image_folder, thermal_folder
from thermosplat.datasets.rgbt_scenes import list_rgbt_scenes
from thermosplat.datasets.transforms import find_transforms, list_transforms
from thermosplat.errors import UserError


def list_capture(root: Path) -> Listing:
    """Tell the layout of a folder and list its files.

    rgb/ with a COLMAP model is RGBT-Scenes; a transforms file is ThermoScenes or nerfstudio, even if a model lies
    beside it (ThermoScenes ships one of the unprocessed images); images/ or thermal/ with a model is a COLMAP project.
    A model that has thermal images of its own is a rig, whatever the folders.

    Raises:
        UserError: No layout fits.
    """
    model_folder = find_model(root)
    transforms = find_transforms(root)
    rgb, images, thermal = image_folder(root, "rgb"), image_folder(root, "images"), thermal_folder(root)
    if transforms is not None and not (model_folder is not None and rgb.is_dir()):
        return list_transforms(root, transforms, model_folder)
    present = [folder for folder in (rgb, images, thermal, root / "thermal_raw") if folder.is_dir()]
    if not present:
        raise _unknown_layout(root)
    if model_folder is None:
        raise missing_model(root, present[0])
    model = read_model(model_folder)
    rig = has_thermal_cameras(model)
    folders = [folder for folder in present if folder.name != "thermal_raw"] if rig else present[:1]
    check_reconstruction(model, sum(len(list_images(folder, recursive=True)) for folder in folders), root)
    model, notes = with_points(model)
    list_layout = list_colmap_rig if rig else list_rgbt_scenes if rgb.is_dir() else list_colmap_folder
    listing = list_layout(root, model)
    return replace(listing, notes=(*listing.notes, *notes))


def _unknown_layout(root: Path) -> UserError:
    found = ", ".join(describe_folder(path) if path.is_dir() else path.name for path in sorted(root.iterdir())[:12])
    return UserError(
        f"{root} is no capture of a known layout. Looked for rgb/ and thermal/, images/ and thermal/, and "
        f"transforms_thermal.json or transforms.json. Found: {found or 'nothing'}.",
        "Give the folder that holds them; the layouts are in docs/data-layouts.md.",
    )
